"""The robot: its visual and collision shapes, and the workspace that its tool can reach."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin
import viser
from numpy.typing import NDArray

from common import topics
from common.robot.model import RobotModel
from common.topics import Topic
from page.layers import Layer
from page.nodes import Rgb, matrix_wxyz

if TYPE_CHECKING:
    from page.figure import Figure

Array = NDArray[np.float64]

COLLISION: Rgb = (255, 120, 90)
REACH: Rgb = (150, 130, 255)
_SAMPLES = 40_000  # configurations
_SPECIAL_SHARE = 0.3  # of joint values that are set to a limit or the middle of the range, where extremes lie
_BINS = 24  # directions of the profile
_MERIDIANS, _SIDES = 8, 64  # lines of the drawn workspace
_CIRCLES = 5


class Robot(Layer):
    """The robot's visual shapes."""

    LABEL = "Robot"
    TOPICS = (topics.JOINT_STATES,)

    def build(self) -> None:
        """Add the meshes at the home pose."""
        from page.figure import Figure  # slow to import, and needed with a scene only

        self.figure = Figure(self.scene, f"{self.root}/links", self.stage.pieces, self.stage.poses)

    def show(self, topic: Topic[Any], message: Any) -> None:
        """Follow the joint states."""
        self.figure.follow()


class CollisionShapes(Layer):
    """The shapes that are used for collision checking."""

    LABEL = "Robot collision shapes"
    ON = False
    TOPICS = (topics.JOINT_STATES,)
    LEGEND = (("collision shape of the robot", COLLISION),)

    def build(self) -> None:
        """Add nothing: the meshes are loaded when the layer is shown first."""
        self.figure: Figure | None = None
        self._loading = False

    def show(self, topic: Topic[Any], message: Any) -> None:
        """Follow the joint states."""
        if self.figure is not None:
            self.figure.follow()
        elif not self._loading:
            self._loading = True
            self.stage.console.put(self._load)

    async def _load(self) -> None:
        from common.robot.visual_meshes import collision_pieces
        from page.figure import Figure

        pieces = await asyncio.to_thread(collision_pieces, self.stage.robot)
        self.figure = Figure(self.scene, f"{self.root}/links", pieces, self.stage.poses, color=COLLISION, opacity=0.5)


class Reach(Layer):
    """The surface that the tool center point never leaves."""

    LABEL = "Reachable workspace"
    ON = False
    TOPICS = (topics.JOINT_STATES,)
    LEGEND = (("limit of the reachable workspace", REACH),)

    def build(self) -> None:
        """Add nothing: the surface is computed when the layer is shown first."""
        self.node: viser.LineSegmentsHandle | None = None
        self._loading = False

    def show(self, topic: Topic[Any], message: Any) -> None:
        """Compute the surface, once."""
        if not self._loading:
            self._loading = True
            self.stage.console.put(self._load)

    async def _load(self) -> None:
        workspace = await asyncio.to_thread(sample_workspace, self.stage.robot)
        if workspace is not None:
            self.node = self.scene.add_line_segments(
                f"{self.root}/shell", workspace.lines(), REACH, thickness=1.0, thickness_units="screen",
                position=workspace.T_world_axis[:3, 3], wxyz=matrix_wxyz(workspace.T_world_axis))


@dataclass(frozen=True, eq=False)
class Workspace:
    """A surface of revolution about the axis of the first joint.

    Attributes:
        T_world_axis: (4, 4) its frame: z along the axis.
        profile: (n, 2) distance from the axis and position along it [m], from the lowest to the highest point.
    """

    T_world_axis: Array
    profile: Array

    def lines(self) -> Array:
        """Return segments (n, 2, 3) in the frame of the axis [m]: meridians and circles."""
        angles = np.linspace(0, 2 * np.pi, _MERIDIANS, endpoint=False)
        arcs = np.linspace(0, 2 * np.pi, _SIDES + 1)
        r, z = self.profile.T
        curves = [np.column_stack([r * np.cos(a), r * np.sin(a), z]) for a in angles]
        for index in np.unique(np.linspace(0, len(r) - 1, _CIRCLES + 2).round().astype(int))[1:-1]:
            curves.append(np.column_stack([r[index] * np.cos(arcs), r[index] * np.sin(arcs),
                                           np.full(len(arcs), z[index])]))
        return np.concatenate([np.stack([curve[:-1], curve[1:]], axis=1) for curve in curves])


def sample_workspace(robot: RobotModel, samples: int = _SAMPLES) -> Workspace | None:
    """Return the reachable workspace of the tool center point; None if the first joint is prismatic.

    Every reachable position lies inside, for any orientation and ignoring obstacles; not every position inside is
    reachable. Takes a moment.
    """
    model, data = robot.model, robot.model.createData()
    if not model.joints[1].shortname().startswith("JointModelR"):
        return None
    rng = np.random.default_rng(0)
    lower, upper = np.maximum(robot.lower, -2 * np.pi), np.minimum(robot.upper, 2 * np.pi)
    q = rng.uniform(lower, upper, (samples, robot.dof))
    special = np.stack([lower, upper, np.clip(0.0, lower, upper)])
    chosen = special[rng.integers(0, 3, q.shape), np.arange(robot.dof)]
    q = np.where(rng.random(q.shape) < _SPECIAL_SHARE, chosen, q)
    pin.forwardKinematics(model, data, q[0])
    axis = np.array(data.oMi[1].rotation) @ _first_axis(model)
    placement = np.array(model.jointPlacements[1].homogeneous)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = _rotation_with_z(axis, placement[:3, 0]), placement[:3, 3]
    positions = np.empty((samples, 3))
    for number, each in enumerate(q):
        pin.forwardKinematics(model, data, each)
        positions[number] = pin.updateFramePlacement(model, data, robot.tcp_frame).translation
    local = (positions - T[:3, 3]) @ T[:3, :3]
    return Workspace(T, _profile(np.hypot(local[:, 0], local[:, 1]), local[:, 2]))


def _profile(distance: Array, along: Array) -> Array:
    """Return (n, 2) the outline of points next to an axis: the farthest from their center in each direction."""
    middle = (along.min() + along.max()) / 2
    angle, radius = np.arctan2(along - middle, distance), np.hypot(along - middle, distance)
    edges = np.linspace(-np.pi / 2, np.pi / 2, _BINS + 1)
    which = np.clip(np.digitize(angle, edges) - 1, 0, _BINS - 1)
    farthest = np.array([radius[which == i].max(initial=0.0) for i in range(_BINS)])
    centers = (edges[1:] + edges[:-1]) / 2
    points = np.column_stack([farthest * np.cos(centers), middle + farthest * np.sin(centers)])
    ends = [[0.0, along.min()], [0.0, along.max()]]
    return np.concatenate([ends[:1], points[farthest > 0], ends[1:]])


def _first_axis(model: pin.Model) -> Array:
    """Return the unit vector of the first joint in its own frame."""
    data = model.createData()
    pin.computeJointJacobians(model, data, pin.neutral(model))
    return np.asarray(pin.getJointJacobian(model, data, 1, pin.LOCAL)[3:, 0])


def _rotation_with_z(z: Array, towards: Array) -> Array:
    """Return the (3, 3) rotation with this z axis and an x axis as close as possible to `towards`."""
    x = towards - (towards @ z) * z
    if np.linalg.norm(x) < 1e-6:
        x = np.cross(z, [0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [1.0, 0.0, 0.0])
    x = x / np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])
