"""Proof that two arms keep a clearance while each follows its trajectory, in spite of an error in time.

The state of two arms is a point (s, t): how far each is along its own trajectory. While both keep their schedules it
follows a line through the rectangle of all points; arms that are held, slowed or late leave the line. The proof covers
every point whose schedules differ by at most a band. It divides the rectangle: in the middle of a cell all distances
are measured, and a cell is free if each of them exceeds the clearance by more than the two links can move within the
cell. No point is sampled: what is called free is free at all times.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from common.planning.arms.pair_world import PairWorld
from common.planning.trajectory import TimedPath, cubics

Array = NDArray[np.float64]
Cell = tuple[float, float, float, float]  # from, to [s] on the first trajectory, from, to [s] on the second

_PIECE = 0.025  # [s] longest piece of a cubic whose speed is bounded at once
_INSTANT = 1e-6  # [s]
_FINEST = 0.002  # [m] cells in which no link moves farther are not divided
SPEEDING_UP = 0.08  # [s] of a motion that an arm may be ahead, as it speeds up to the rate of its schedule
NOT_AT_REST = -1e9
MAX_CELLS = 20_000  # of one proof: then it fails


class ArmMotion:
    """A path of the joints over its own time, from rest to rest; before and after it the arm is at its ends.

    Attributes:
        duration: [s].
        start, end: (dof,) [rad].
    """

    def __init__(self, path: TimedPath, offset: Array | None = None) -> None:
        """Bound the speed along the cubics of a path; the arm may be `offset` (dof,) [rad] away from all of it."""
        spans, pieces = np.diff(path.times), cubics(path)
        counts = np.maximum(1, np.ceil(spans / _PIECE - 1e-9)).astype(int)
        owners = np.repeat(np.arange(len(counts)), counts)
        number = np.arange(len(owners)) - np.repeat(np.cumsum(counts) - counts, counts)
        r0, r1 = number / counts[owners], (number + 1) / counts[owners]
        _, c1, c2, c3 = pieces[owners].transpose(1, 0, 2)
        first, last = (c1 + r * (2 * c2 + 3 * r * c3) for r in (r0[:, None], r1[:, None]))
        between = c1 + (r0 + r1)[:, None] * c2 + 3 * (r0 * r1)[:, None] * c3  # Bezier point of the derivative
        fastest = np.maximum(np.maximum(np.abs(first), np.abs(last)), np.abs(between))
        self._travel = np.concatenate([np.zeros((1, pieces.shape[2])), np.cumsum(
            fastest / counts[owners, None], axis=0)])
        self._at = [*(path.times[owners] + r0 * spans[owners]).tolist(), float(path.times[-1])]
        self._times, self._pieces = path.times.tolist(), pieces
        self.path, self.duration = path, float(path.times[-1])
        self.start, self.end = path.positions[0], path.positions[-1]
        self._offset = np.zeros(pieces.shape[2]) if offset is None else np.abs(offset)

    @classmethod
    def resting(cls, q: Array) -> ArmMotion:
        """Return a motion that stays at q (dof,) [rad]."""
        still = np.zeros((2, len(q)))
        return cls(TimedPath(np.array([0.0, 1e-3]), np.array([q, q], dtype=float), still, still))

    @property
    def rests(self) -> bool:
        """Whether it stays where it is."""
        return not self._travel[-1].any()

    def at(self, time: float) -> Array:
        """Return the positions (dof,) [rad] at its own time [s]."""
        index = min(max(bisect_right(self._times, time) - 1, 0), len(self._pieces) - 1)
        r = (time - self._times[index]) / (self._times[index + 1] - self._times[index])
        c0, c1, c2, c3 = self._pieces[index]
        r = min(max(r, 0.0), 1.0)
        return np.asarray(c0 + r * (c1 + r * (c2 + r * c3)))

    def reach(self, begin: float, middle: float, end: float) -> Array:
        """Return (dof,) [rad] how far each joint gets at most from where it is at `middle`, from begin to end [s]."""
        low, mid, high = (self._travelled(time) for time in (begin, middle, end))
        return np.asarray(np.maximum(mid - low, high - mid) + self._offset)

    def _travelled(self, time: float) -> Array:
        """Return (dof,) an upper bound of the length of each joint's path up to a time [rad]."""
        index = min(max(bisect_right(self._at, time) - 1, 0), len(self._at) - 2)
        share = min(max((time - self._at[index]) / (self._at[index + 1] - self._at[index]), 0.0), 1.0)
        return np.asarray(self._travel[index] + share * (self._travel[index + 1] - self._travel[index]))


@dataclass(frozen=True)
class Schedule:
    """When a motion is followed: its own time 0 is at `start` [s], and passes at `rate`.

    Attributes:
        done: own time [s] before which the arm will not be any more.
        begin: own time [s] at which the arm waits for its schedule; NOT_AT_REST for an arm in motion.
    """

    start: float
    rate: float = 1.0
    done: float = 0.0
    begin: float = 0.0

    def time(self, own: float) -> float:
        """Return when the motion is at its own time [s]."""
        return self.start + own / self.rate

    def is_starting(self, own: float) -> bool:
        """Return whether the arm may be there at any earlier time, too: it waits there, or just speeds up."""
        return own <= self.begin + SPEEDING_UP


@dataclass(frozen=True)
class Clash:
    """Own times [s] of two motions at which no clearance could be proved, and between which shapes.

    `certain`: the distance there is below the clearance; otherwise it is not proved.
    """

    one: float
    other: float
    pair: tuple[str, str]
    certain: bool


@dataclass
class Effort:
    """How many more cells may be measured; a proof that runs out of it is continued by the next call."""

    left: float = math.inf


class _Measured(NamedTuple):
    slack: float  # [m] of the whole cell; negative: not proved
    excess: float  # [m] of the middle alone; negative: too close
    move_one: float  # [m] that the links move most in half the cell
    move_other: float
    pair: int


@dataclass
class PairProof:
    """What is known about two motions: cells are measured once for all schedules.

    Attributes:
        world: the two arms; one, other: their motions; clearance: to keep [m].
        effort: shared with other proofs.
        allowed: arm, 0 or 1, from, to [s] of its motion, and the pairs (pairs,) that may touch meanwhile.
        evaluations: how many cells were measured.
    """

    world: PairWorld
    one: ArmMotion
    other: ArmMotion
    clearance: float
    effort: Effort = field(default_factory=Effort)
    allowed: Sequence[tuple[int, float, float, NDArray[np.bool_]]] = ()
    evaluations: int = 0
    _measured: dict[Cell, _Measured] = field(default_factory=dict)
    _last: tuple[Cell, Clash] | None = None

    def in_time(self, one: Schedule, other: Schedule, band: float) -> Clash | None:
        """Return where the arms may come too close while their schedules differ by at most `band` [s], or None."""
        def relevant(cell: Cell) -> bool:
            a0, a1, b0, b1 = cell
            if a1 < one.done or b1 < other.done:
                return False
            first = -math.inf if one.is_starting(a0) else one.time(a0)
            last = math.inf if a1 >= self.one.duration else one.time(a1)
            return first - band <= (math.inf if b1 >= self.other.duration else other.time(b1)) and (
                -math.inf if other.is_starting(b0) else other.time(b0)) - band <= last

        return self._clash(relevant)

    def anywhere(self, one: tuple[float, float], other: tuple[float, float]) -> Clash | None:
        """Return where the arms may come too close in these ranges of their own times [s], in any order, or None."""
        def relevant(cell: Cell) -> bool:
            return cell[0] <= one[1] and cell[1] >= one[0] and cell[2] <= other[1] and cell[3] >= other[0]

        return self._clash(relevant)

    def _clash(self, relevant: Callable[[Cell], bool]) -> Clash | None:
        if self._last is not None and relevant(self._last[0]):
            return self._last[1]
        stack, count = [(0.0, self.one.duration, 0.0, self.other.duration)], 0
        while stack:
            cell = stack.pop()
            if not relevant(cell):
                continue
            found = self._measured.get(cell)
            if found is None and self.effort.left <= 0:
                return Clash(cell[0], cell[2], ("not", "proved yet"), certain=False)
            found = found or self._measure(cell)
            if found.slack >= 0.0:
                continue
            a0, a1, b0, b1 = cell
            a, b = (a0 + a1) / 2, (b0 + b1) / 2
            inside = relevant((a, a, b, b))
            count += 1
            certain = found.excess < 0.0 and inside
            if certain or max(found.move_one, found.move_other) < _FINEST or count > MAX_CELLS:
                clash = Clash(a, b, self.world.names(found.pair), certain)
                self._last = (a, a, b, b) if certain else cell, clash
                return clash
            if found.move_one >= found.move_other:
                stack += [(a, a1, b0, b1), (a0, a, b0, b1)]
            else:
                stack += [(a0, a1, b, b1), (a0, a1, b0, b)]
        return None

    def _measure(self, cell: Cell) -> _Measured:
        a0, a1, b0, b1 = cell
        a, b = (a0 + a1) / 2, (b0 + b1) / 2
        self.evaluations += 1
        self.effort.left -= 1
        above, below = self.world.distances(self.one.at(a), self.other.at(b))
        for arm, begin, end, pairs in self.allowed:
            if begin <= (a, b)[arm] <= end:
                above[pairs] = np.inf
            if begin <= cell[2 * arm] and cell[2 * arm + 1] <= end + _INSTANT:
                below[pairs] = np.inf
        one = self.world.one_levers @ self.one.reach(a0, a, a1)
        other = self.world.other_levers @ self.other.reach(b0, b, b1)
        slack = below - one - other - self.clearance
        worst = int(slack.argmin())
        nearest = int(above.argmin())
        excess = float(above[nearest]) - self.clearance
        found = _Measured(float(slack[worst]), excess, float(one.max()), float(other.max()),
                          nearest if excess < 0 else worst)
        self._measured[cell] = found
        return found
