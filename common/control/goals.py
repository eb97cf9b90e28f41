"""Goals of the arm: how a trajectory is followed from where the arm is, and the reported state of each goal id."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np
from pydantic import BaseModel

from common.control.limiter import SLACK, Limiter
from common.control.trajectory import Trajectory
from common.control.wrench import Wrenches
from common.errors import Refused
from common.hardware.interface import Limits, Vector
from common.hardware.pace import CATCH_UP, Pace
from common.messages import GoalState, Holder, Interlock, MotionStatus

S = TypeVar("S", bound=BaseModel)
V = TypeVar("V", float, Vector)

REMEMBERED = 1000  # goals that were followed, and as many that were refused; older requests are refused for their age
BLEND_TIME = 0.3  # [s] in which the difference between the robot's and the trajectory's start fades
BLEND_SHARE = 0.5  # of the limits is for that difference at most; else it takes longer
SLOWEST = 0.01  # share of its speed below which a trajectory is refused
ON_TIME, CATCH_UP_TIME = 1e-3, 0.3  # [s] of lag that is none, and in which a goal would catch up with the rest
LATE_START, LONGEST_WAIT = 0.02, 30.0  # [s] for a goal with a time to start
MAX_SAMPLES = 20_000  # of a trajectory, to find how fast it can be followed


class ForceControl(Protocol):
    """What moves the arm in a force motion: `common.control.force_follower`.

    Attributes:
        end: how the motion ends, from when it is known; the arm comes to rest first.
        zeroing: whether the arm stays at rest until the wrench is zeroed.
    """

    end: Outcome | None
    zeroing: bool

    @property
    def result(self) -> tuple[float, float]:
        """Force of the tool along the direction [N], and distance in it [m]."""

    def sense(self, measured: Vector, wrench: Wrenches | None) -> None:
        """Take the reading of a cycle: joint positions (dof,) [rad], and the wrench, None while it is unknown."""

    def resume(self, position: Vector) -> None:
        """Continue from rest at a position (dof,) [rad]."""

    def set_points(
        self, goal: Goal, now: float, elapsed: float, limiter: Limiter, share: float, held: bool
    ) -> tuple[Vector, Vector]:
        """Return set-points (dof,) [rad], [rad/s] after a cycle."""


@dataclass
class Goal:
    """The goal that moves the robot. `time` is on the trajectory's own time axis [s], which passes at the pace's rate.

    The difference `offset` to where the robot was fades in the time `blend` [s]. `share` is the speed at which the
    limits hold, 1 for a valid trajectory.
    """

    id: str
    trajectory: Trajectory
    offset: Vector
    blend: float
    last: float  # cell time of the newest set-point
    pace: Pace
    share: float = 1.0
    time: float = 0.0  # negative: it waits for its start
    start_at: float = -math.inf  # cell time at which it is to start: it catches up with that [s]
    fastest: float = 1.0  # rate at which it may catch up
    begin: float = 0.0  # time at which the trajectory of the request starts: later than 0 if it joined another goal
    behind: float = 0.0  # distance of the newest set-point from the path [rad]
    stopping: bool = False
    reason: str = ""
    error: str = ""  # of an abort; empty for a requested stop
    source: str = ""
    plan: str = ""  # id of the plan request behind it
    scene_stamp: int = 0  # of the planning scene that it was planned on
    force: ForceControl | None = None  # follows a force motion; None: the trajectory is followed
    ended: float | None = None  # cell time at which the set-points came to rest
    _reported: float = 0.0  # progress so far
    _newest: tuple[float, tuple[Vector, Vector]] | None = None  # cached time and result: most are read three times

    @property
    def duration(self) -> float:
        """Time at which the trajectory is over, and the robot on it [s]."""
        return max(self.trajectory.duration, self.blend)

    def at(self, time: float) -> tuple[Vector, Vector]:
        """Return positions [rad] and their derivative by the trajectory's time (dof,), with the blend."""
        time = max(time, 0.0)  # it is negative before the start
        if self._newest is None or self._newest[0] != time:
            self._newest = time, self._blended(time)
        return self._newest[1]

    def _blended(self, time: float) -> tuple[Vector, Vector]:
        q, dq = self.trajectory.at(time)
        if time >= self.blend:
            return q, dq
        u = time / self.blend
        slope = -30 * u**2 * (1 - u) ** 2 / self.blend
        return q + _remaining(u) * self.offset, dq + slope * self.offset

    def positions_at(self, times: Vector) -> Vector:
        """Return positions (N, dof) at times (N,), with the blend."""
        u = np.clip(times / self.blend, 0.0, 1.0) if self.blend > 0 else np.ones_like(times)
        return self.trajectory.positions_at(times) + _remaining(u)[:, None] * self.offset

    def rate_on_schedule(self, now: float) -> float:
        """Return the rate, 1 to `fastest`, at which the goal follows or reaches its schedule."""
        lag = now - self.start_at - self.time
        return min(1.0 + max(lag - ON_TIME, 0.0) / CATCH_UP_TIME, self.fastest)

    def progress(self, delay: float) -> float:
        """Return the progress of an arm that follows its set-points after a delay [s]; it never decreases."""
        done = self.time - delay * self.pace.rate
        self._reported = max(self._reported, min(done / self.duration, 1.0))  # a measured delay may grow
        return self._reported


def _remaining(u: V) -> V:
    return 1 - u**3 * (10 - 15 * u + 6 * u**2)


def blend_time(offset: Vector, duration: float, limits: Limits) -> float:
    """Return the time [s] in which an offset (dof,) [rad] from a trajectory of this duration [s] fades; 0 for none."""
    off = np.abs(offset)
    if not off.any():
        return 0.0
    least = max(  # peaks of 1 - 10 u^3 + 15 u^4 - 6 u^5
        float((1.875 * off / (BLEND_SHARE * limits.velocity)).max()),
        float(np.sqrt(5.774 * off / (BLEND_SHARE * limits.acceleration)).max()),
        float(np.cbrt(60 * off / (BLEND_SHARE * limits.jerks)).max()),
    )
    return max(min(BLEND_TIME, duration), least)


def possible_share(goal: Goal, limits: Limits, period: float) -> float:
    """Return the share of its speed, at most 1, at which the rest of a goal keeps the limits, every `period` [s].

    Raises:
        Refused: it is below SLOWEST.
    """
    share = 1.0
    while share >= SLOWEST:
        over = _excess(goal, limits, period, share, 1 + SLACK)
        if over <= 1.0:
            return share
        share /= 1.01 * over
    raise Refused("contradiction", "its points are too far apart for their times: it could only be followed at less "
                                   f"than {SLOWEST:.0%} of its speed")


def possible_rate(goal: Goal, limits: Limits, period: float) -> float:
    """Return the rate, 1 to CATCH_UP, at which a goal may catch up with its schedule: all of it keeps the limits."""
    return min(max(1 / max(_excess(goal, limits, period, 1.0, 1.0), 1e-9), 1.0), CATCH_UP)


def _excess(goal: Goal, limits: Limits, period: float, share: float, most: float) -> float:
    """Return the factor by which the rest of a goal, at a share of its speed, is faster than `most` of the limits."""
    step = share * period / 2  # of the trajectory's time: differences over two, starting at every second one
    count = min(int((goal.duration - goal.time) / step) + 1, MAX_SAMPLES)
    q = goal.positions_at(goal.time + np.arange(-6.0, count + 6) * step)
    v = (q[2:] - q[:-2]) / period
    a = (v[2:] - v[:-2]) / period
    j = (a[2:] - a[:-2]) / period
    return max(float((np.abs(v) / limits.velocity).max()) / most,
               math.sqrt(float((np.abs(a) / limits.acceleration).max()) / most),
               float(np.cbrt((np.abs(j) / limits.jerks).max() / most)))


def time_at(now: float, start_at: float) -> float:
    """Return the time on a trajectory at a cell time, if it is to start at another one, both [s].

    Raises:
        Refused: that is over, or too far ahead.
    """
    wait = start_at - now
    if wait < -LATE_START:
        raise Refused("too_late", f"the trajectory was to start {-wait:.3f} s ago")
    if wait > LONGEST_WAIT:
        raise Refused("bad_times", f"the trajectory is to start in {wait:.3g} s; at most {LONGEST_WAIT:g} s ahead")
    return min(-wait, 0.0)


class Outcome(NamedTuple):
    """State of a goal, with its error code, message and source."""

    state: GoalState
    error: str = ""
    message: str = ""
    source: str = ""


@dataclass(frozen=True)
class Assessment:
    """Whether and how a trajectory can be followed by an arm that starts at `start` (dof,) [rad]."""

    start: Vector
    trajectory: Trajectory | None = None
    share: float = 1.0
    refusal: Refused | None = None

    @staticmethod
    def of(trajectory: Trajectory, start: Vector, limits: Limits, period: float) -> Assessment:
        """Assess a checked trajectory.

        Raises:
            Refused: it can only be followed far too slowly.
        """
        trial = Assessment(start, trajectory).goal("", start, 0.0, 0.0, limits)
        return Assessment(start, trajectory, possible_share(trial, limits, period))

    def goal(self, name: str, start: Vector, now: float, rate: float, limits: Limits) -> Goal:
        """Create the goal that follows the trajectory from `start` (dof,) [rad], at first at a rate, 0 to 1."""
        assert self.trajectory is not None
        offset = start - self.trajectory.positions[0]
        blend = blend_time(offset, self.trajectory.duration, limits)
        return Goal(name, self.trajectory, offset, blend, now, Pace(rate, 0.0 * start), self.share)


class GoalMemory(Generic[S]):
    """The newest states of the last goals; refused goals do not displace followed ones.

    All but the newest are stored as JSON, which takes a sixth of the memory.
    """

    def __init__(self, most: int = REMEMBERED) -> None:
        """Remember at most so many goals of either kind; the least recently updated is forgotten first."""
        self._most = most
        self._followed: OrderedDict[str, S | _Packed[S]] = OrderedDict()
        self._refused: OrderedDict[str, S | _Packed[S]] = OrderedDict()
        self._newest = "", self._followed

    def get(self, goal: str) -> S | None:
        """Return the state of a goal, or None for an unknown id."""
        state = self._followed.get(goal) or self._refused.get(goal)
        return state.unpacked() if isinstance(state, _Packed) else state

    def put(self, goal: str, state: S, *, refused: bool = False) -> S:
        """Remember and return the state of a goal."""
        states = self._refused if refused else self._followed
        before, among = self._newest
        if before != goal or among is not states:
            last = among.get(before)
            if last is not None and not isinstance(last, _Packed):
                among[before] = _Packed(type(last), last.model_dump_json().encode())
            self._newest = goal, states
        states[goal] = state
        states.move_to_end(goal)
        while len(states) > self._most:
            states.popitem(last=False)
        return state


class _Packed(NamedTuple, Generic[S]):
    """A state as JSON."""

    kind: type[S]
    text: bytes

    def unpacked(self) -> S:
        return self.kind.model_validate_json(self.text)


class GoalReports:
    """The status of the newest goal and of remembered ones, with the holds in force.

    Attributes:
        newest: status of the newest goal, without the holds.
        holds: reasons by holder.
        interlocks, speed_scaling, fault: reported with every status.
    """

    def __init__(self, source: str, remember: int) -> None:
        """Report for a controller of this name."""
        self._source = source
        self.memory: GoalMemory[MotionStatus] = GoalMemory(remember)
        self.newest = MotionStatus()
        self.holds: dict[Holder, str] = {}
        self.interlocks: list[Interlock] = []
        self.speed_scaling = 1.0
        self.fault = ""

    @property
    def current(self) -> MotionStatus:
        """The status of the newest goal."""
        return self._with_holds(self.newest)

    @property
    def key(self) -> tuple[object, ...]:
        """All that `current` consists of except the progress."""
        return self.newest, *self.holds.items(), self.speed_scaling, self.interlocks, self.fault

    def get(self, goal: str) -> MotionStatus | None:
        """Return the status of a goal, or None for an unknown id."""
        known = self.memory.get(goal)
        return None if known is None else self._with_holds(known)

    def unknown(self, goal: str) -> MotionStatus:
        """Return the answer about an unknown goal."""
        return self._with_holds(MotionStatus(
            id=goal, error="unknown_goal", message=f"no goal {goal!r} is known", source=self._source))

    def reject(self, goal: str, refusal: Refused) -> MotionStatus:
        """Remember and return that a goal was rejected."""
        rejected = MotionStatus(
            id=goal, state="rejected", error=refusal.code, message=str(refusal), source=self._source)
        return self._with_holds(self.memory.put(goal, rejected, refused=True))

    def report(self, goal: Goal, delay: float, outcome: Outcome) -> MotionStatus:
        """Set, remember and return the status of the goal, whose arm has a delay [s]."""
        progress = 1.0 if outcome.state == "succeeded" else goal.progress(delay)
        force, distance = (0.0, 0.0) if goal.force is None else goal.force.result
        self.newest = MotionStatus(
            id=goal.id, state=outcome.state, progress=progress, error=outcome.error, message=outcome.message,
            source=outcome.source or self._source, plan=goal.plan, scene_stamp=goal.scene_stamp,
            path_time=goal.time - goal.begin, force=force, distance=distance,
        )
        return self._with_holds(self.memory.put(goal.id, self.newest))

    def update_active(self, goal: Goal, delay: float) -> None:
        """Update progress and message of the goal in progress."""
        message = self.hold_message(goal)
        if message == self.newest.message:
            self.newest.progress = goal.progress(delay)  # the rest of it has not changed
            self.newest.path_time = goal.time - goal.begin
            self.memory.put(goal.id, self.newest)
        else:
            self.report(goal, delay, Outcome("active", message=message))

    def set_message(self, message: str) -> None:
        """Change the message unless a goal is active."""
        if self.newest.state != "active":
            self.newest = self.newest.model_copy(update={"message": message})

    def hold_message(self, goal: Goal) -> str:
        """Return the message of a held goal; empty without a hold."""
        if not self.holds:
            return ""
        return _with_reasons("held" if goal.pace.rate == 0.0 else "coming to rest", self.holds.values())

    def _with_holds(self, status: MotionStatus) -> MotionStatus:
        current: dict[str, object] = {  # all of it is part of `key`
            "held": bool(self.holds), "held_by": sorted(self.holds), "speed_scaling": self.speed_scaling,
            "interlocks": self.interlocks, "fault": self.fault,
        }
        if status.state != "active" and not status.message:
            if self.fault:
                current["message"] = f"hardware fault: {self.fault}"
            elif self.holds:
                current["message"] = _with_reasons("held", self.holds.values())
        return status.model_copy(update=current)


def _with_reasons(what: str, reasons: Iterable[str]) -> str:
    return ": ".join([what, *filter(None, ["; ".join(filter(None, reasons))])])
