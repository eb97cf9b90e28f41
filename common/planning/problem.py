"""What a planner is asked, and what it answers."""

from __future__ import annotations

import ctypes
import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from common.messages import PlanAttempt
from common.planning.collision import CollisionWorld, Pair
from common.planning.retiming import RetimingFailed, TimedPath, TooLong
from common.robot.model import RobotModel
from common.time_source import monotonic

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Region:
    """Where the TCP may end: about T_world_tcp (4, 4), within half sides (3,) [m], tilt and yaw [rad]."""

    T_world_tcp: Array
    half_sides: Array
    tilt: float
    yaw: float


@dataclass(frozen=True)
class ToolPath:
    """Poses that the TCP passes in straight lines, from the first, at which it is at the start.

    Attributes:
        poses: (N, 4, 4) T_world_tcp.
        step: way between IK solutions [m]; min_fraction: of the way that must be possible; None: the planner's.
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
class Part:
    """One motion of a sequence; the corner to the next is rounded off within `blend_radius` [m] of the goal."""

    goal: Array | Region | Arc | GoalChoice
    straight: bool = False
    blend_radius: float = 0.0


@dataclass(frozen=True)
class GoalSequence:
    """Goals to reach one after the other."""

    parts: tuple[Part, ...]


@dataclass(frozen=True)
class GoalChoice:
    """Goals of which any will do."""

    goals: tuple[Array | Region, ...]


Goal = Array | Region | ToolPath | Arc | GoalSequence | GoalChoice


@dataclass(frozen=True)
class Problem:
    """One checked request: the start is free and within limits.

    Attributes:
        start: (dof,) [rad].
        goal: (dof,) [rad] for a joint goal, else a region for the TCP, a path that it follows, several goals one after
            the other, or several of which any will do.
        beyond: (dof,) [rad] where the robot stands, beyond a limit; it moves straight to the start first.
        failed: of several goals those, by their numbers from 1, whose lines were found but not good in the end.
        straight: only a straight line of the TCP will do.
        velocity, acceleration, jerk: scaled limits (dof,).
        attempts: how many tries a sampling planner has.
        deadline: of the search; latest: when a path that was found in time is timed and checked. Both are on the
            monotonic clock of common.time_source [s].
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
    beyond: Array | None = None
    failed: dict[int, Result] = field(default_factory=dict)

    @property
    def sequence(self) -> tuple[Part, ...] | None:
        """Goals to reach one after the other, where there are such."""
        return self.goal.parts if isinstance(self.goal, GoalSequence) else None

    @property
    def tool_speed(self) -> float:
        """That the TCP may move with [m/s]."""
        constraints = self.world.constraints
        return (constraints and constraints.tool_speed) or math.inf

    @property
    def seconds_left(self) -> float:
        """Wall time left for planning [s]."""
        return self.deadline - monotonic()


class Cancel:
    """A flag that another thread may set; planners look at it and at the time that is left."""

    def __init__(self, word: ctypes.c_int | None = None) -> None:
        """Not set; `word` is not 0 once it is, and compiled code looks there. It may lie in memory that is shared."""
        self.word = ctypes.c_int(0) if word is None else word

    def set(self) -> None:
        """Ask the planner to give up."""
        self.word.value = 1

    @property
    def is_set(self) -> bool:
        """Whether somebody asked."""
        return self.word.value != 0

    def reason(self, problem: Problem) -> str:
        """Why planning must end now: cancelled, timeout, or nothing."""
        if self.is_set:
            return "cancelled"
        return "timeout" if problem.seconds_left <= 0 else ""


@dataclass(frozen=True)
class ToolWay:
    """How the TCP moves between waypoints that lie close together.

    Attributes:
        lengths: (N - 1,) its way between them [m].
        cuts: (N,) how much of the way before and after each may be rounded off [m].
        speed: wanted along the way [m/s], or None.
    """

    lengths: Array
    cuts: Array
    speed: float | None = None


@dataclass(frozen=True)
class Result:
    """A path or a trajectory, or the error of a planner; what it tried is in `attempts`.

    `not_applicable` as error says that the planner is not for this kind of goal.

    Attributes:
        waypoints: (N, dof) [rad], to be retimed.
        dense: the waypoints lie close together: smooth through all of them; else blend at the corners.
        tool_line: the TCP follows a straight line (its speed scale applies).
        cuts: (N,) how much of the edges before and after each waypoint may be rounded off [rad]; None: as is usual.
        way: the TCP follows a path with corners, at a speed of its own: rounds them and times its way.
        trajectory: already timed; then there are no waypoints.
        fraction: how much of the way is covered.
        waypoint, colliding: where and between what a failure was found.
        planner: which found the way, where others were asked for it.
        goal: number from 1 of the one of several goals to which its line leads; another may be tried in its place.
    """

    waypoints: Array | None = None
    dense: bool = False
    cuts: Array | None = None
    tool_line: bool = False
    way: ToolWay | None = None
    trajectory: TimedPath | None = None
    fraction: float = 0.0
    error: str = ""
    message: str = ""
    waypoint: int | None = None
    colliding: Pair | None = None
    goal: int | None = None
    planner: str = ""
    attempts: list[PlanAttempt] = field(default_factory=list)


NOT_APPLICABLE = "not_applicable"
MOST_STEPS = 25_000  # poses of the tool for which joint positions are solved


def not_timed(error: RetimingFailed | TooLong) -> Result:
    """The failure of a planner that times its paths itself."""
    if isinstance(error, TooLong):
        return Result(error=error.code, message=str(error))
    return Result(error="retiming_failed", message=f"retiming: {error}")


def too_fine(steps: float) -> Result | None:
    """The refusal of a way of the tool in so many steps, or None for one that can be followed."""
    if steps <= MOST_STEPS:
        return None
    return Result(error="too_long", message=f"the way takes {steps:.3g} steps of the tool, {MOST_STEPS} are the most")
