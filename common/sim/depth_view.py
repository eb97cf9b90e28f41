"""What a depth camera sees of the simulated world: fixtures, objects and the arm before them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from common.config import Surroundings
from common.messages import JointState, WorldObject
from common.perception.pinhole import Pinhole
from common.robot.model import RobotModel
from common.sim.objects import object_mesh
from common.sim.ray_caster import Mesh, View, cast, empty_view
from common.sim.robot_shapes import robot_shapes
from common.sim.solids import fixture_mesh, placed

Depth = npt.NDArray[np.float32]

GROUND = (178 / 255, 178 / 255, 178 / 255)
ARM = (0.55, 0.55, 0.55)
STILL = 1e-4  # joints that moved by less [rad] leave the picture as it is


class DepthView:
    """Casts rays only for what changed: at what stands still once, at the arm when it moved."""

    def __init__(self, around: Surroundings, robot: RobotModel) -> None:
        """Load the shapes of the robot.

        Raises:
            ConfigError: one of its meshes is not there.
        """
        self.camera = Pinhole.from_config(around.camera)
        self._fixtures = [fixture_mesh(fixture) for fixture in around.fixtures]
        self._robot = robot
        self._shapes = robot_shapes(robot)
        self._objects: list[WorldObject] | None = None
        self._still = empty_view(self.camera, GROUND)
        self._joints: npt.NDArray[np.float64] | None = None
        self._seen = self._still

    def see(self, objects: Sequence[WorldObject], joints: JointState | None) -> View:
        """The view of the objects and of the arm in that state; without a complete state, of the objects alone."""
        changed = self._objects is None or list(objects) != self._objects
        if changed:
            self._objects = list(objects)
            meshes = self._fixtures + [object_mesh(thing) for thing in objects]
            self._still = cast(meshes, self.camera, empty_view(self.camera, GROUND))
        positions = None if joints is None else np.array(joints.position)
        if changed or not _same(positions, self._joints):
            self._joints = positions
            self._seen = cast(self._arm(joints), self.camera, self._still)
        return self._seen

    def _arm(self, joints: JointState | None) -> list[Mesh]:
        q = None if joints is None else self._robot.order(joints.name, joints.position)
        if joints is None or q is None:
            return []
        others = {name: value for name, value in zip(joints.name, joints.position, strict=True)
                  if name in self._robot.config.locked_joints}
        poses = self._robot.link_poses(q, others)
        return [Mesh(placed(corners, poses[link]), ARM) for link, corners in self._shapes.items()]


def _same(a: npt.NDArray[np.float64] | None, b: npt.NDArray[np.float64] | None) -> bool:
    if a is None or b is None:
        return a is b
    return a.shape == b.shape and bool(np.all(np.abs(a - b) < STILL))


def disturbed(depth: Depth, rng: np.random.Generator, noise_std: float, dropout: float) -> Depth:
    """The depth image with Gaussian noise [m], and with NaN in a part of its pixels."""
    measured = depth
    if noise_std > 0:
        measured = measured + np.float32(noise_std) * rng.standard_normal(depth.shape, dtype=np.float32)
    if dropout > 0:
        measured = np.where(rng.random(depth.shape, dtype=np.float32) < dropout, np.float32(np.nan), measured)
    return measured
