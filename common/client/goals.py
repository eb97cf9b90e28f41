"""Where a motion is to go, as a program says it, and what was planned."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from common.config import check
from common.errors import ConfigError
from common.messages import (
    AnyGoal,
    ArcGoal,
    GoalSet,
    JointGoal,
    PathGoal,
    PlanResponse,
    Pose,
    PoseGoal,
    SequenceGoal,
    Vector3,
)
from common.robot.transforms import pose_fields, rpy_to_matrix, transform

Array = NDArray[np.float64]
GoalLike = AnyGoal | Pose | str | Sequence[float] | Array
Point = Sequence[float] | Array

SAYS = ("must be the name of a pose, joint positions, a pose as a matrix (4, 4) or `Pose`, or a goal such as "
        "`PoseGoal`, `any_of(...)` or `through(...)`")


def pose(x: float, y: float, z: float, *, rpy: Sequence[float] = (np.pi, 0.0, 0.0)) -> Array:
    """A pose (4, 4) in world: position [m], and roll, pitch, yaw [rad] about fixed x, y, z. Left out: straight down."""
    roll, pitch, yaw = numbers("rpy", rpy)
    return transform(rpy_to_matrix(roll, pitch, yaw), numbers("x, y, z", (x, y, z)))


def region(
    at: Pose | Array, *, size: Point = (0.0, 0.0, 0.0), tilt: float = 0.0, yaw: float = 0.0
) -> PoseGoal:
    """Anywhere in a box about a pose.

    Args:
        at: the middle.
        size: sides of the box [m], along the axes of world.
        tilt: at most so far may the tool lean [rad].
        yaw: at most so far may it be turned about its axis [rad].
    """
    return check(PoseGoal, {"pose": _pose(at), "position_tolerance": _vector("size", size), "tilt_tolerance": tilt,
                            "yaw_tolerance": yaw}, "region")


def any_of(*goals: GoalLike) -> GoalSet:
    """Whichever of the goals is reached best: names, joint positions, poses and regions."""
    return check(GoalSet, {"goals": [goal_of(each) for each in goals]}, "any_of")


@dataclass(frozen=True)
class WaypointPath:
    """Poses to pass in straight lines of the tool; see `through`."""

    poses: tuple[Pose, ...]
    tool_speed: float | None

    def starting_at(self, start: Array) -> PathGoal:
        """The path from a pose (4, 4) of the tool."""
        return check(PathGoal, {"waypoints": [_pose(start), *self.poses], "tool_speed": self.tool_speed}, "through")


def through(*poses: Pose | Array, tool_speed: float | None = None) -> WaypointPath:
    """Straight lines of the tool through poses, from where it is to the last, at a speed [m/s] where there is room."""
    return WaypointPath(tuple(_pose(each) for each in poses), tool_speed)


def goal_of(to: GoalLike, *, via: Point | None = None, around: Point | None = None) -> AnyGoal:
    """What is asked of the planner.

    Args:
        to: where to.
        via: a point that the tool passes on an arc [m].
        around: the centre of that arc [m].

    Raises:
        ConfigError: it is no goal.
    """
    if via is not None or around is not None:
        return check(ArcGoal, {"pose": _pose(to), "via": None if via is None else _vector("via", via),
                               "center": None if around is None else _vector("around", around)}, "to")
    if isinstance(to, JointGoal | PoseGoal | PathGoal | ArcGoal | SequenceGoal | GoalSet):
        return to
    if isinstance(to, str):
        return check(JointGoal, {"named": to}, "to")
    if isinstance(to, Pose):
        return PoseGoal(pose=to)
    values = array_of("to", to)
    if values.shape == (4, 4):
        return PoseGoal(pose=_pose(values))
    if values.ndim == 1 and values.size:
        return check(JointGoal, {"positions": values.tolist()}, "to")
    raise ConfigError("to", to, SAYS)


def array_of(name: str, given: object) -> Array:
    """Finite numbers, of any shape.

    Raises:
        ConfigError: it is something else.
    """
    try:
        values = np.array(given, dtype=float)
    except (TypeError, ValueError):
        raise ConfigError(name, given, SAYS if name == "to" else "must be numbers") from None
    if not np.all(np.isfinite(values)):
        raise ConfigError(name, given, "must be finite")
    return values


def _pose(at: Any, name: str = "to") -> Pose:
    if isinstance(at, Pose):
        return at
    T = array_of(name, at)
    if T.shape != (4, 4):
        raise ConfigError(name, at, "must be a pose here: a matrix (4, 4) or `Pose`")
    if not np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-3) or np.linalg.det(T[:3, :3]) < 0:
        raise ConfigError(name, at, "has no rotation in its first three rows and columns")
    return check(Pose, pose_fields(T), name)


def place(name: str, at: Pose | Point) -> Pose:
    """The pose that a pose, a matrix (4, 4) or a point (3,) [m] says: turned like world where nothing else is said."""
    if isinstance(at, Pose) or array_of(name, at).shape != (3,):
        return _pose(at, name)
    return Pose(position=_vector(name, at))


def numbers(name: str, given: object) -> Array:
    """Three finite numbers (3,).

    Raises:
        ConfigError: it is something else.
    """
    values = array_of(name, given)
    if values.shape != (3,):
        raise ConfigError(name, given, "must be three numbers")
    return values


def _vector(name: str, given: Point) -> Vector3:
    x, y, z = numbers(name, given)
    return check(Vector3, {"x": x, "y": y, "z": z}, name)


@dataclass(frozen=True)
class Plan:
    """A trajectory that was planned and not followed yet: positions [rad or m] of `joints` at `times` [s].

    Attributes:
        joints: names, in the order of the columns.
        times: (n,), from 0.
        positions: (n, dof).
        velocities: (n, dof).
        planner: who planned it.
        seconds: how long that took.
        response: all that the planner said.
    """

    joints: tuple[str, ...]
    times: Array = field(repr=False)
    positions: Array = field(repr=False)
    velocities: Array = field(repr=False)
    planner: str
    seconds: float
    response: PlanResponse = field(repr=False)

    @property
    def duration(self) -> float:
        """Cell time that the motion takes at full speed [s]."""
        return float(self.times[-1])

    @classmethod
    def of(cls, response: PlanResponse) -> Plan:
        """What a planner answered, which has a trajectory."""
        assert response.trajectory is not None
        points = response.trajectory.points
        return cls(
            tuple(response.trajectory.joint_names), np.array([point.time_from_start for point in points]),
            np.array([point.positions for point in points]), np.array([point.velocities for point in points]),
            response.planner, response.seconds, response)
