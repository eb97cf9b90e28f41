"""How far the tool gets: the outermost places of its centre point, wherever it points, whatever is in the way."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from common import topics
from common.robot.model import RobotModel
from common.topics import Topic
from page.layers import Layer
from page.nodes import Rgb, matrix_wxyz

Array = NDArray[np.float64]

COLOR: Rgb = (150, 130, 255)
_SAMPLES = 40_000  # configurations that are looked at
_AT_AN_END = 0.3  # share of the joints that stand at an end of their range, or in its middle: extremes lie there
_BINS = 24  # directions of the outline
_MERIDIANS, _SIDES = 8, 64  # lines of the shell
_PLACES = 5  # circles


@dataclass(frozen=True, eq=False)
class Shell:
    """A surface about the axis of the first joint.

    Attributes:
        T_world_axis: (4, 4) its frame: z along the axis.
        profile: (n, 2) distance from the axis and place along it [m], from the lowest to the highest.
    """

    T_world_axis: Array
    profile: Array

    def lines(self) -> Array:
        """(n, 2, 3) segments in the frame of the axis [m]: outlines from pole to pole, and circles."""
        angles = np.linspace(0, 2 * np.pi, _MERIDIANS, endpoint=False)
        arcs = np.linspace(0, 2 * np.pi, _SIDES + 1)
        r, z = self.profile.T
        curves = [np.column_stack([r * np.cos(a), r * np.sin(a), z]) for a in angles]
        for index in np.unique(np.linspace(0, len(r) - 1, _PLACES + 2).round().astype(int))[1:-1]:
            curves.append(np.column_stack([r[index] * np.cos(arcs), r[index] * np.sin(arcs),
                                           np.full(len(arcs), z[index])]))
        return np.concatenate([np.stack([curve[:-1], curve[1:]], axis=1) for curve in curves])


def shell_of(robot: RobotModel, samples: int = _SAMPLES) -> Shell | None:
    """How far the tool centre point of a robot gets, from so many configurations; None if its first joint slides.

    What it reaches lies inside, taken all the way round; what lies inside need not be reached. Takes a moment.
    """
    model, data = robot.model, robot.model.createData()
    if not model.joints[1].shortname().startswith("JointModelR"):
        return None
    rng = np.random.default_rng(0)
    lower, upper = np.maximum(robot.lower, -2 * np.pi), np.minimum(robot.upper, 2 * np.pi)
    q = rng.uniform(lower, upper, (samples, robot.dof))
    special = np.stack([lower, upper, np.clip(0.0, lower, upper)])
    chosen = special[rng.integers(0, 3, q.shape), np.arange(robot.dof)]
    q = np.where(rng.random(q.shape) < _AT_AN_END, chosen, q)
    pin.forwardKinematics(model, data, q[0])
    turned = np.array(data.oMi[1].rotation)
    axis = turned @ _axis_of(model)
    placed = np.array(model.jointPlacements[1].homogeneous)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = _upright(axis, placed[:3, 0]), placed[:3, 3]
    seen = np.empty((samples, 3))
    for number, each in enumerate(q):
        pin.forwardKinematics(model, data, each)
        seen[number] = pin.updateFramePlacement(model, data, robot.tcp_frame).translation
    local = (seen - T[:3, 3]) @ T[:3, :3]
    return Shell(T, _profile(np.hypot(local[:, 0], local[:, 1]), local[:, 2]))


def _profile(distance: Array, along: Array) -> Array:
    """(n, 2) the outline of points beside an axis: the farthest from their middle in each direction, pole to pole."""
    middle = (along.min() + along.max()) / 2
    angle, far = np.arctan2(along - middle, distance), np.hypot(along - middle, distance)
    edges = np.linspace(-np.pi / 2, np.pi / 2, _BINS + 1)
    which = np.clip(np.digitize(angle, edges) - 1, 0, _BINS - 1)
    farthest = np.array([far[which == i].max(initial=0.0) for i in range(_BINS)])
    centres = (edges[1:] + edges[:-1]) / 2
    points = np.column_stack([farthest * np.cos(centres), middle + farthest * np.sin(centres)])
    ends = [[0.0, along.min()], [0.0, along.max()]]
    return np.concatenate([ends[:1], points[farthest > 0], ends[1:]])


def _axis_of(model: pin.Model) -> Array:
    """Unit vector of the first joint in its own frame."""
    data = model.createData()
    q = pin.neutral(model)
    pin.computeJointJacobians(model, data, q)
    return np.asarray(pin.getJointJacobian(model, data, 1, pin.LOCAL)[3:, 0])


def _upright(z: Array, towards: Array) -> Array:
    """(3, 3) rotation whose z axis is that unit vector, and whose x axis lies towards another."""
    x = towards - (towards @ z) * z
    if np.linalg.norm(x) < 1e-6:
        x = np.cross(z, [0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [1.0, 0.0, 0.0])
    x = x / np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


class Reach(Layer):
    """The shell that the tool centre point does not leave."""

    LABEL = "Reach of the tool"
    ON = False
    TOPICS = (topics.JOINT_STATES,)
    LEGEND = (("how far the tool gets", COLOR),)

    def build(self) -> None:
        """Start without: few look at it, and it takes a moment."""
        self.node: Any = None
        self._begun = False

    def show(self, topic: Topic[Any], message: Any) -> None:
        """Find it, the first time."""
        if not self._begun:
            self._begun = True
            self.stage.console.put(self._load)

    async def _load(self) -> None:
        shell = await asyncio.to_thread(shell_of, self.stage.robot)
        if shell is not None:
            self.node = self.scene.add_line_segments(
                f"{self.root}/shell", shell.lines(), COLOR, thickness=1.0, thickness_units="screen",
                position=shell.T_world_axis[:3, 3], wxyz=matrix_wxyz(shell.T_world_axis))
