"""Goals of motions as a program writes them, and planned motions."""

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

GOAL_CHOICES = ("must be the name of a pose, joint positions, a pose as a matrix (4, 4) or `Pose`, or a goal such as "
                "`PoseGoal`, `any_of(...)` or `through(...)`")


def pose(x: float, y: float, z: float, *, rpy: Sequence[float] = (np.pi, 0.0, 0.0)) -> Array:
    """Return a pose (4, 4) in world from position [m] and roll, pitch, yaw [rad] about fixed axes; default: down."""
    roll, pitch, yaw = numbers("rpy", rpy)
    return transform(rpy_to_matrix(roll, pitch, yaw), numbers("x, y, z", (x, y, z)))


def region(
    at: Pose | Array, *, size: Point = (0.0, 0.0, 0.0), tilt: float = 0.0, yaw: float = 0.0
) -> PoseGoal:
    """Return a goal that is reached anywhere in a box around a pose.

    Args:
        at: centre of the box.
        size: sides of the box [m], along the axes of world.
        tilt: largest tilt of the tool axis [rad].
        yaw: largest rotation of the tool about its axis [rad].
    """
    return check(PoseGoal, {"pose": _pose(at), "position_tolerance": _vector("size", size), "tilt_tolerance": tilt,
                            "yaw_tolerance": yaw}, "region")


def any_of(*goals: GoalLike) -> GoalSet:
    """Return a goal that is reached at the best of several: names, joint positions, poses and regions."""
    return check(GoalSet, {"goals": [goal_of(each) for each in goals]}, "any_of")


@dataclass(frozen=True)
class WaypointPath:
    """Poses that the tool passes in straight lines; see `through`."""

    poses: tuple[Pose, ...]
    tool_speed: float | None

    def starting_at(self, start: Array) -> PathGoal:
        """Return the path from a pose (4, 4) of the tool."""
        return check(PathGoal, {"waypoints": [_pose(start), *self.poses], "tool_speed": self.tool_speed}, "through")


def through(*poses: Pose | Array, tool_speed: float | None = None) -> WaypointPath:
    """Return a path of straight lines from the current pose of the tool to the last pose, at a tool speed [m/s]."""
    return WaypointPath(tuple(_pose(each) for each in poses), tool_speed)


def goal_of(to: GoalLike, *, via: Point | None = None, around: Point | None = None) -> AnyGoal:
    """Return the goal of a plan request.

    Args:
        to: where to move.
        via: a point that the tool passes on an arc [m].
        around: the centre of that arc [m].

    Raises:
        ConfigError: it is not a goal.
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
    raise ConfigError("to", to, GOAL_CHOICES)


def array_of(name: str, given: object) -> Array:
    """Return finite numbers of any shape as an array.

    Raises:
        ConfigError: they are not.
    """
    try:
        values = np.array(given, dtype=float)
    except (TypeError, ValueError):
        raise ConfigError(name, given, GOAL_CHOICES if name == "to" else "must be numbers") from None
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
        raise ConfigError(name, at, "must have a rotation in its first three rows and columns")
    return check(Pose, pose_fields(T), name)


def pose_of(name: str, at: Pose | Point) -> Pose:
    """Return a pose from a pose, a matrix (4, 4) or a point (3,) [m]; a point has the orientation of world."""
    if isinstance(at, Pose) or array_of(name, at).shape != (3,):
        return _pose(at, name)
    return Pose(position=_vector(name, at))


def numbers(name: str, given: object) -> Array:
    """Return three finite numbers (3,).

    Raises:
        ConfigError: they are not.
    """
    values = array_of(name, given)
    if values.shape != (3,):
        raise ConfigError(name, given, "must be three numbers")
    return values


def number(name: str, given: object) -> float:
    """Return one finite number.

    Raises:
        ConfigError: it is not.
    """
    value = array_of(name, given)
    if value.shape:
        raise ConfigError(name, given, "must be one number")
    return float(value)


def _vector(name: str, given: Point) -> Vector3:
    x, y, z = numbers(name, given)
    return check(Vector3, {"x": x, "y": y, "z": z}, name)


@dataclass(frozen=True)
class Plan:
    """A planned trajectory: positions [rad or m] of `joints` at `times` [s].

    Attributes:
        joints: names, in the order of the columns.
        times: (n,), from 0 [s].
        positions: (n, dof) [rad or m].
        velocities: (n, dof) [rad/s or m/s].
        planner: name of the planner.
        seconds: planning time [s].
        response: complete response of the planner.
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
        """Duration of the motion at full speed [s, cell time]."""
        return float(self.times[-1])

    @classmethod
    def of(cls, response: PlanResponse) -> Plan:
        """Return the plan in a response with a trajectory."""
        assert response.trajectory is not None
        points = response.trajectory.points
        return cls(
            tuple(response.trajectory.joint_names), np.array([point.time_from_start for point in points]),
            np.array([point.positions for point in points]), np.array([point.velocities for point in points]),
            response.planner, response.seconds, response)
