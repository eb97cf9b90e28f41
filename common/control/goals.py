"""Goals: what one asks of the arm from where it is, and by their ids what became of them, so that none acts twice."""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from pydantic import BaseModel

from common.control.limiter import SLACK
from common.control.trajectory import Trajectory
from common.errors import Refused
from common.hardware.interface import Limits, Vector
from common.hardware.pace import Pace

S = TypeVar("S", bound=BaseModel)
V = TypeVar("V", float, Vector)

REMEMBERED = 1000  # goals that were followed, and as many that were refused; older requests are refused for their age
BLEND_TIME = 0.3  # the difference between the robot's and the trajectory's start fades in this time [s]
BLEND_SHARE = 0.5  # of the limits is for that difference at most; else it takes longer
SLOWEST = 0.01  # of its speed, at which a trajectory is refused instead of being followed so slowly
MOST_SAMPLES = 20_000  # of a trajectory, when it is looked for how fast it can be followed


@dataclass
class Goal:
    """The goal that moves the robot. `time` is on the trajectory's own time axis [s], which passes at the pace's rate.

    The difference `offset` to where the robot was fades in the time `blend` [s]. `share` is the speed at which the
    limits can be kept, 1 for a trajectory that is as it should be.
    """

    id: str
    trajectory: Trajectory
    offset: Vector
    blend: float
    last: float  # cell time of the newest set-point
    pace: Pace
    share: float = 1.0
    time: float = 0.0
    behind: float = 0.0  # the newest set-point, of the path [rad]
    stopping: bool = False
    reason: str = ""
    error: str = ""  # why it is stopped, where nobody asked for it
    source: str = ""
    plan: str = ""  # id of the plan request that it answers
    scene_stamp: int = 0  # of the planning scene that it was planned on
    ended: float | None = None  # cell time at which the set-points came to rest
    _told: float = 0.0  # progress so far
    _newest: tuple[float, tuple[Vector, Vector]] | None = None  # time and answer: most are asked for three times

    @property
    def duration(self) -> float:
        """Time at which the trajectory is over, and the robot on it [s]."""
        return max(self.trajectory.duration, self.blend)

    def at(self, time: float) -> tuple[Vector, Vector]:
        """Positions [rad] and their change per second of the trajectory (dof,), blended from where the robot was."""
        if self._newest is None or self._newest[0] != time:
            self._newest = time, self._blended(time)
        return self._newest[1]

    def _blended(self, time: float) -> tuple[Vector, Vector]:
        q, dq = self.trajectory.at(time)
        if time >= self.blend:
            return q, dq
        u = time / self.blend
        slope = -30 * u**2 * (1 - u) ** 2 / self.blend
        return q + _left(u) * self.offset, dq + slope * self.offset

    def positions_at(self, times: Vector) -> Vector:
        """Positions (N, dof) at times (N,), blended as well."""
        u = np.clip(times / self.blend, 0.0, 1.0) if self.blend > 0 else np.ones_like(times)
        return self.trajectory.positions_at(times) + _left(u)[:, None] * self.offset

    def progress(self, delay: float) -> float:
        """The share of the trajectory that is behind an arm which is a delay [s] behind its set-points."""
        behind = self.time - delay * self.pace.rate
        self._told = max(self._told, min(behind / self.duration, 1.0))  # a delay that is measured grows at times
        return self._told


def _left(u: V) -> V:
    return 1 - u**3 * (10 - 15 * u + 6 * u**2)


def blend_time(offset: Vector, duration: float, limits: Limits) -> float:
    """Time [s] in which an offset (dof,) [rad] from a trajectory of this duration [s] fades; 0 when there is none."""
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
    """The share of its speed, at most 1, at which set-points of a goal every `period` [s] keep the limits.

    Raises:
        Refused: there is none that is worth the name.
    """
    share, most = 1.0, 1 + SLACK
    while share >= SLOWEST:
        step = share * period / 2  # of trajectory's time: differences over two, from every second one on
        count = min(int(goal.duration / step) + 1, MOST_SAMPLES)
        q = goal.positions_at(np.arange(-6.0, count + 6) * step)
        v = (q[2:] - q[:-2]) / period
        a = (v[2:] - v[:-2]) / period
        j = (a[2:] - a[:-2]) / period
        over = max(float((np.abs(v) / limits.velocity).max()) / most,
                   math.sqrt(float((np.abs(a) / limits.acceleration).max()) / most),
                   float(np.cbrt((np.abs(j) / limits.jerks).max() / most)))
        if over <= 1.0:
            return share
        share /= 1.01 * over
    raise Refused("contradiction", "its points are too far apart for their times: it could only be followed at less "
                                   f"than {SLOWEST:.0%} of its speed")


@dataclass(frozen=True)
class Judged:
    """What was found out about a trajectory, for an arm that begins at `begin` (dof,) [rad]: how it can be followed."""

    begin: Vector
    trajectory: Trajectory | None = None
    share: float = 1.0
    refusal: Refused | None = None


class GoalMemory(Generic[S]):
    """The newest states of the last goals; those that were refused push out none that was followed.

    All but the newest are kept as JSON, a sixth of the memory: that of an arm that works is full for all of its time.
    """

    def __init__(self, most: int = REMEMBERED) -> None:
        """Remember at most so many goals of either kind; the one heard of longest ago is forgotten first."""
        self._most = most
        self._followed: OrderedDict[str, S | _Packed[S]] = OrderedDict()
        self._refused: OrderedDict[str, S | _Packed[S]] = OrderedDict()
        self._newest = "", self._followed

    def get(self, goal: str) -> S | None:
        """The state of a goal, or None for an id that was never heard of."""
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
