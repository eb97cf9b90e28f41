"""What is around an arm that follows a policy: collision and workspace region along motions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from common.errors import ZencellError
from common.messages import Box, PathConstraints, PlanningScene
from common.planning.collision import CollisionWorld
from common.planning.constraints import ToolConstraints
from common.planning.contact_rules import PERCEIVED, Pair
from common.planning.obstacles import ObstacleCache
from common.planning.point_obstacles import PointObstacle
from common.planning.robot_geometry import RobotGeometry
from common.robot.model import RobotModel

Array = NDArray[np.float64]

_SHARES = (0.0, 0.5)  # of the tolerance of a region that states may use, and that is proved between them
_STEP = 0.005  # [rad] between states where the kernel cannot check what an attached object touches


class ProverUnavailable(ZencellError):
    """The compiled kernel, which proves that motions are free, is missing or does not support the robot or a shape."""


class Found(NamedTuple):
    """Where cubics (N, 4, dof) fail first: number of the cubic plus its share; a name; what would happen there."""

    where: float
    what: str
    message: str


class Space:
    """The planning scene, points that cameras saw, and the region of the TCP."""

    def __init__(self, robot: RobotModel, region: Box | None, clearance: float) -> None:
        """Check motions in a region, poses in world [m], and at a clearance [m], after `set_scene`."""
        self.clearance = clearance
        self._robot = robot
        self._cache = ObstacleCache(RobotGeometry(robot))
        self._world: CollisionWorld | None = None
        self._attached: tuple[tuple[str, ...], Array] | None = None  # ids, and where the arm was then
        self.set_region(region)

    def set_region(self, region: Box | None) -> None:
        """Check that the TCP stays in a box from now on; None: anywhere."""
        self._region = ToolConstraints(self._robot, PathConstraints(region=region), np.zeros(self._robot.dof))
        if self._world is not None and self._world.kernel is not None:
            self._region.attach_to_kernel(self._world.kernel)

    def set_scene(
        self, scene: PlanningScene, positions: ArrayLike, points: Sequence[PointObstacle], width: float | None
    ) -> None:
        """Check motions among these solids and points from now on; see `ChunkProver.set_scene`."""
        names = tuple(item.object.id for item in scene.attached)
        if self._attached is None or self._attached[0] != names:
            self._attached = names, np.array(positions, dtype=float)
        gripper = self._robot.config.gripper
        touchable = [item.id for item in scene.objects if item.role in PERCEIVED]
        allowed = [(link, name) for link in (gripper.links if gripper else []) for name in touchable]
        world = CollisionWorld(
            self._robot, scene, start=self._attached[1], clearance=self.clearance, allowed=allowed,
            cache=self._cache, points=points, width=width)
        if world.kernel is None:
            raise ProverUnavailable("the planning kernel is not built, or does not support a shape of this cell")
        self._region.attach_to_kernel(world.kernel)
        self._world = world

    @property
    def world(self) -> CollisionWorld:
        """The robot among the solids.

        Raises:
            RuntimeError: no scene was set.
        """
        if self._world is None:
            raise RuntimeError("set_scene() must be called before prove()")
        return self._world

    def leaves_region(self, pieces: Array) -> Found | None:
        """Return where the TCP leaves its region first along cubics (N, 4, dof); None if it is proved inside."""
        outside = self._region.first_violation(pieces, _SHARES) if len(pieces) else None
        if outside is None:
            return None
        piece, share = outside
        at = self._robot.fk(share ** np.arange(4) @ pieces[piece])[:3, 3]
        axis, upper = divmod(int(np.argmin(self._region.bounds.n @ at - self._region.bounds.least)), 2)
        side = f"{'+' if upper else '-'}{'xyz'[axis]}"
        return Found(piece + share, side, f"the TCP would leave its region at {side}")

    def hit(self, pieces: Array) -> Found | None:
        """Return the first cubic (N, 4, dof) that is not proved free, and the pair of names; None if all are."""
        if not len(pieces):
            return None
        world = self.world
        assert world.kernel is not None
        index, where = world.kernel.cubics_collision(pieces)
        if index >= 0:
            where = min(where, len(pieces) - 1e-9)
            at = (where - int(where)) ** np.arange(4) @ pieces[int(where)]
            return _touching(where, world.colliding_pair(at) or world.pair(index))
        if world.check_cubics(pieces[:1])[0]:
            return None
        for number, piece in enumerate(pieces):  # an attached object touches something, which only coal can check
            count = max(1, int(np.ceil(np.abs(piece[1:]).sum(axis=0).max() / _STEP)))
            r = np.linspace(0.0, 1.0, count + 1)[:, None]
            touched = world.first_collision(piece[0] + r * (piece[1] + r * (piece[2] + r * piece[3])))
            if touched is not None:
                return _touching(number + touched.index / (count + 1), touched.pair)
        return None

    def hit_at(self, states: Array) -> Found | None:
        """Return the first of positions (N, dof) that is not free, and the pair of names; None if all are."""
        touched = self.world.first_collision(states) if len(states) else None
        return None if touched is None else _touching(float(touched.index), touched.pair)


def _touching(where: float, pair: Pair) -> Found:
    return Found(where, " - ".join(pair), f"{pair[0]} would touch {pair[1]}")
