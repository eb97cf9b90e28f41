"""The input and the output of a planner."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from common.messages import PlanAttempt
from common.planning.collision import CollisionWorld
from common.planning.contact_rules import Pair
from common.planning.retiming import RetimingFailed
from common.planning.trajectory import TimedPath, TooLong
from common.robot.model import RobotModel
from common.time_source import monotonic

Array = NDArray[np.float64]

NOT_APPLICABLE = "not_applicable"
MAX_STEPS = 25_000  # poses of the tool for which joint positions are solved


@dataclass(frozen=True)
class Region:
    """Allowed poses of the TCP: about T_world_tcp (4, 4), within half sides (3,) [m], tilt and yaw [rad]."""

    T_world_tcp: Array
    half_sides: Array
    tilt: float
    yaw: float


@dataclass(frozen=True)
class ToolPath:
    """Poses that the TCP passes in straight lines; it is at the first of them at the start.

    Attributes:
        poses: (N, 4, 4) T_world_tcp.
        step: travel between IK solutions [m]; min_fraction: of the path that must be possible; None: the planner's.
        speed: of the TCP where limits and corners allow it [m/s]; None: as fast as they allow.
    """

    poses: Array
    step: float | None = None
    min_fraction: float | None = None
    speed: float | None = None


@dataclass(frozen=True)
class Arc:
    """A pose T_world_tcp (4, 4) at the end of a circular arc through `via`, or about `center` (3,) [m]."""

    T_world_tcp: Array
    via: Array | None = None
    center: Array | None = None


@dataclass(frozen=True)
class SequenceItem:
    """One motion of a sequence; the corner to the next is rounded off within `blend_radius` [m] of the goal."""

    goal: Array | Region | Arc | GoalChoice
    straight: bool = False
    blend_radius: float = 0.0


@dataclass(frozen=True)
class GoalSequence:
    """Goals to reach one after the other."""

    items: tuple[SequenceItem, ...]


@dataclass(frozen=True)
class GoalChoice:
    """Alternative goals: the planner may end at any of them."""

    goals: tuple[Array | Region, ...]


@dataclass(frozen=True)
class Moving:
    """A target that moves evenly.

    Attributes:
        T_world_tcp: (4, 4) of the tool at the target at the start of the arm.
        velocity: (3,) of the target [m/s].
        begin: cell time at which the arm starts [s]; lead: since the target was observed [s].
        approach: height above the target at which it is met [m].
        dwell: for which the tool stays at the target [s].
        travel: most way of the target since it was observed [m].
    """

    T_world_tcp: Array
    velocity: Array
    begin: float
    lead: float
    approach: float
    dwell: float
    travel: float

    @property
    def speed(self) -> float:
        """Speed of the target [m/s]."""
        return float(np.linalg.norm(self.velocity))

    def at(self, time: float) -> Array:
        """Return the position of the tool at the target (3,) a time [s] after the start."""
        return np.asarray(self.T_world_tcp[:3, 3] + time * self.velocity)


Goal = Array | Region | ToolPath | Arc | GoalSequence | GoalChoice | Moving


@dataclass(frozen=True)
class Problem:
    """One checked request: the start is free and within limits.

    Attributes:
        start: (dof,) [rad].
        goal: (dof,) [rad] for a joint goal, else a region for the TCP, a path that it follows, a sequence of goals, or
            alternative goals.
        straight: only a straight line of the TCP is accepted.
        velocity, acceleration, jerk: scaled limits (dof,).
        attempts: how many attempts a sampling planner has.
        deadline: of the search; latest: after which a path that was found in time is no longer timed and checked. Both
            are on the monotonic clock [s].
        outside_start: (dof,) [rad] where the robot is, outside a limit; it moves straight to the start first.
        moving: returns the collision world with moving objects where they will be at a cell time [s]; or None.
        failed_goals: alternative goals, by their numbers from 1, whose lines were found but rejected later.
    """

    robot: RobotModel
    world: CollisionWorld
    start: Array
    goal: Goal
    straight: bool
    velocity: Array
    acceleration: Array
    jerk: Array
    attempts: int
    deadline: float
    latest: float
    rng: np.random.Generator
    outside_start: Array | None = None
    moving: Callable[[float], CollisionWorld] | None = None
    failed_goals: dict[int, Result] = field(default_factory=dict)

    @property
    def sequence(self) -> tuple[SequenceItem, ...] | None:
        """The items of a sequence of goals, None for any other goal."""
        return self.goal.items if isinstance(self.goal, GoalSequence) else None

    @property
    def tool_speed(self) -> float:
        """Speed limit of the TCP [m/s]."""
        constraints = self.world.constraints
        return (constraints and constraints.tool_speed) or math.inf

    @property
    def seconds_left(self) -> float:
        """Wall time left for planning [s]."""
        return self.deadline - monotonic()


class Cancel:
    """A flag that another thread may set; planners check it and the time that is left."""

    def __init__(self, word: ctypes.c_int | None = None) -> None:
        """Start unset. Compiled code reads `word`, which is 0 until then and may lie in shared memory."""
        self.word = ctypes.c_int(0) if word is None else word

    def set(self) -> None:
        """Request that the planner gives up."""
        self.word.value = 1

    @property
    def is_set(self) -> bool:
        """Whether the planner was requested to give up."""
        return self.word.value != 0

    def reason(self, problem: Problem) -> str:
        """Return why planning must end now: cancelled, timeout, or ""."""
        if self.is_set:
            return "cancelled"
        return "timeout" if problem.seconds_left <= 0 else ""


@dataclass(frozen=True)
class ToolTravel:
    """How the TCP moves between waypoints that lie close together.

    Attributes:
        lengths: (N - 1,) travel between them [m].
        cuts: (N,) how much of the travel before and after each waypoint may be rounded off [m].
        speed: requested along the path [m/s], or None.
    """

    lengths: Array
    cuts: Array
    speed: float | None = None


@dataclass(frozen=True)
class Result:
    """A path or a trajectory, or the error of a planner; `attempts` records what it tried.

    The error `not_applicable` means that the planner does not handle this kind of goal.

    Attributes:
        waypoints: (N, dof) [rad], to be retimed.
        dense: the waypoints lie close together: smooth through all of them; otherwise blend at the corners.
        tool_line: the TCP follows a straight line (its speed scale applies).
        cuts: (N,) how much of the edges before and after each waypoint may be rounded off [rad]; None: the default.
        tool_travel: the TCP follows a path with corners at its own speed: round them and time the path by its travel.
        trajectory: already timed; then there are no waypoints.
        fraction: how much of the path is covered.
        waypoint, colliding: where and between what a failure was found.
        planner: which found the path, if it called others.
        meet: time at which the tool is at a moving target [s].
        goal: number from 1 of the alternative goal that the line leads to; another may be tried instead.
    """

    waypoints: Array | None = None
    dense: bool = False
    cuts: Array | None = None
    tool_line: bool = False
    tool_travel: ToolTravel | None = None
    trajectory: TimedPath | None = None
    fraction: float = 0.0
    error: str = ""
    message: str = ""
    waypoint: int | None = None
    colliding: Pair | None = None
    goal: int | None = None
    meet: float = 0.0
    planner: str = ""
    attempts: list[PlanAttempt] = field(default_factory=list)


def timing_failure(error: RetimingFailed | TooLong) -> Result:
    """Return the failure of a planner that times its paths itself."""
    if isinstance(error, TooLong):
        return Result(error=error.code, message=str(error))
    return Result(error="retiming_failed", message=f"retiming: {error}")


def check_step_count(steps: float) -> Result | None:
    """Return the refusal of a tool path with too many steps, or None."""
    if steps <= MAX_STEPS:
        return None
    return Result(error="too_long", message=f"the path takes {steps:.3g} steps of the tool; the limit is {MAX_STEPS}")
