"""Set-points that come ahead of time, as a function of it, for an arm that wants one more often than they are made.

They are played `ahead` late, so that the next one is there when it is needed; between two of them the curve is the
quintic with their velocities, and accelerations that are found from their neighbours: with a cubic an arm that asks
each millisecond for what is sent each 10 ms would be 6 % over its acceleration. When they cease in the middle of a
motion it comes to rest by itself within the limits.

Who plays them may be held up. The arm slows down meanwhile, as it gets nothing new: the curve goes on where it was, as
slow as the arm is then, and comes back to its speed by a ramp; the time is caught up with where limits leave room, and
at the next rest.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import ruckig

from common.hardware.interface import Limits, Vector
from common.hardware.pace import QUICKEST, Pace

STALL = 0.09  # [s] without being asked where to be, in which an arm's own program has ended, or is about to
JITTER = 1e-3  # [s] that being asked may be late without being held up
SMOOTHING = 0.03  # [s] in which an arm without new set-points loses 63 % of its speed
FASTER = 1.1  # of their speed, at which late set-points are played where there is room
UNHURRIED = 1.0  # [s] in which that speed would rise from 0 to 1
CAUGHT_UP = 2e-3  # [s] that they may be late for good
RAMP_SHARE = 0.4  # of the limits of jerk is for ramps: the rest is the motion's
HOPELESS = 0.3  # [s] that they are late at most: a stop would come as late
REST = 1e-6  # [rad/s] slower, a set-point is at rest
JUMP = 1e-3  # [rad] by which a step may be longer than the velocity limit allows: numbers are rounded, cycles jitter
MOST = 1000  # set-points that wait; a sender that is so far ahead is broken


@dataclass(slots=True)
class Point:
    """A set-point (dof,) [rad], [rad/s], and how much faster one may come to it than it was sent.

    Its acceleration [rad/s^2] is known once the next one has come, or its turn.
    """

    time: float
    q: Vector
    dq: Vector
    faster: float = FASTER
    ddq: Vector | None = None


class SetPointStream:
    """What is played of the set-points that came; times are [s] of one clock, whichever.

    Attributes:
        period: see below; an arm may want set-points less often for a while.
        ceased: why nothing is taken until the next `begin`; empty while all is well.
    """

    def __init__(self, limits: Limits, ahead: float, period: float = 0.002) -> None:
        """Nothing is played before `begin`; `ahead` is the time [s] between a set-point's own and its turn.

        The arm takes what it is told every `period` [s] for where it has to be a period later.
        """
        self._limits, self._ahead, self.period = limits, ahead, period
        self._points: deque[Point] = deque(maxlen=MOST)
        self._braking: tuple[float, ruckig.Trajectory] | None = None
        self._last = np.zeros(0)  # acceleration at the end of the newest piece (dof,) [rad/s^2]
        self._came = Piece(math.inf, np.zeros(0), np.zeros(0))  # up to the newest set-point that came
        self._asked = self._time = 0.0  # when, and of the set-points' time, how far they were played
        self._pace = Pace(1.0, np.zeros(0))
        self._played = np.zeros(0), np.zeros(0)
        self.ceased = ""

    @property
    def behind(self) -> float:
        """How much later than they should be set-points are played [s]."""
        return max(0.0, self._asked - self._ahead - self._time)

    def begin(self, q: Vector, now: float) -> None:
        """Rest at q (dof,) [rad], and take set-points again that begin there."""
        rest = np.zeros_like(q)
        self._points.clear()
        self._points.append(Point(now - self._ahead, q.copy(), rest, ddq=rest))
        self._braking, self.ceased = None, ""
        self._last, self._came = rest, Piece(math.inf, rest, rest)
        self._asked, self._time, self._pace = now, now - self._ahead, Pace(1.0, rest)
        self._played = q.copy(), rest

    def put(self, time: float, q: Vector, dq: Vector) -> None:
        """Take a set-point (dof,) [rad], [rad/s] for `time`; one that nobody could follow ends the motion instead."""
        if self.ceased or not self._points:
            return
        newest = self._points[-1]
        before, q0, dq0 = newest.time, newest.q, newest.dq
        step = time - before
        if step <= 0:
            return
        off = np.abs(q - q0) - self._limits.velocity * step - JUMP
        if not np.all(off <= 0):  # also when it is not finite
            j = int(np.argmax(np.where(np.isfinite(off), off, np.inf)))
            self.ceased = f"{self._limits.names[j]} would jump by {abs(q[j] - q0[j]):.4g} rad in {step * 1e3:.1f} ms"
            return
        if not np.isfinite(dq).all():
            self.ceased = f"the velocity of {self._limits.names[int(np.argmin(np.isfinite(dq)))]} is no finite number"
            return
        gap = step > STALL  # nobody who makes them takes so long; who plays them may have been held up as long
        if gap and np.any(np.abs(dq0) > REST):
            self._cease(f"set-points ceased to come for {step * 1e3:.0f} ms")
            return
        piece = Piece(step, *accelerations(step, q0, dq0, q, dq))
        if np.all(np.abs(dq0) <= REST) and np.all(q == q0):
            self._points.pop()  # rests: a later motion begins where the rest ends
            if self._points and (np.any(self._points[-1].dq) or np.any(self._points[-1].q != q0)):
                self._points.append(Point(before, q0, 0 * q0, ddq=0 * q0))
            piece = Piece(math.inf, 0 * q0, 0 * q0)
        elif newest.ddq is None:
            newest.ddq = 0 * q0 if gap else between(self._came, piece)  # in so long a time it has come to rest
        a0, a1 = piece.begins, piece.ends
        jerk = np.maximum(np.abs(a0 - self._came.ends), np.abs(a1 - a0)) / step
        self._came = piece
        over = max(
            float((np.maximum(np.abs(dq0), np.abs(dq)) / self._limits.velocity).max()),
            math.sqrt(float((np.maximum(np.abs(a0), np.abs(a1)) / self._limits.acceleration).max())),
            float(np.cbrt((jerk / (RAMP_SHARE * self._limits.jerks)).max())),
        )
        self._points.append(Point(time, q.copy(), dq.copy(), min(max(1 / max(over, 1e-9), 1.0), FASTER)))
        if piece.step == math.inf:
            self._points[-1].ddq = piece.ends
        elif before <= self._time and np.all(np.abs(dq) <= REST):  # on the way there before the next one comes
            self._points[-1].ddq = 0 * q

    def at(self, now: float) -> tuple[Vector, Vector]:
        """Where to be (dof,) [rad], and how fast [rad/s], at a time that does not go back.

        Who asks far too seldom in the middle of a motion finds the arm at rest where it was sent last: there it stays.

        Raises:
            IndexError: before `begin`.
        """
        elapsed, self._asked = now - self._asked, now
        q, dq = self._played
        if elapsed > STALL and np.any(np.abs(dq) > REST):
            self._cease(f"the driver was held up for {elapsed * 1e3:.0f} ms")
            self._brake(q, 0 * q, 0 * q)
        self._advance(elapsed, now - self._ahead)
        self._played = self._now()
        if self.behind > HOPELESS and self._braking is None:
            self._cease(f"the driver was held up too often: it is {self.behind * 1e3:.0f} ms late")
        return self._played

    def _cease(self, why: str) -> None:
        self.ceased = self.ceased or why

    def _advance(self, elapsed: float, wanted: float) -> None:
        """Play on for so long [s], where the set-points' time should be the one that is wanted."""
        pace, held_up = self._pace, elapsed > self.period + JITTER
        rests = self._rests_until()
        if self._time < min(rests, wanted):
            self._time = min(rests, wanted)
            pace.rate, pace.slope = 1.0, 0.0
            elapsed = wanted - self._time
            held_up = elapsed > self.period + JITTER
        elif held_up:
            pace.rate, pace.slope = pace.rate * math.exp(-(elapsed - self.period) / SMOOTHING), 0.0
        step = self.period if held_up else elapsed
        late = wanted - self._time - step
        target = 1.0
        if self._braking is None and self.ceased:
            target = 0.0  # along what came of the path
        elif self._braking is None and late > (CAUGHT_UP if pace.rate <= 1.0 else 0.0):
            target = min(point.faster for point in self._points)
        if pace.rate == target == 1.0 and pace.slope == 0.0:
            self._time += step
            pace.acceleration = 0 * pace.acceleration
            return
        pace.gentle = QUICKEST if pace.rate < 1.0 else UNHURRIED
        if held_up or not np.any(pace.acceleration):  # how it would go on
            dq = self._path(self._time)[1]
            pace.acceleration = (self._path(self._time + pace.rate * self.period)[1] - dq) * pace.rate / self.period
        most = self._limits.braking if self.ceased else self._limits.acceleration
        self._time = pace.advance(self._path, self._time, target, step, most, RAMP_SHARE * self._limits.jerks)

    def _rests_until(self) -> float:
        """The time [s] until which the arm is to be where it rests now; minus infinity while it moves."""
        if self._braking is not None:
            began, motion = self._braking
            return math.inf if self._time >= began + motion.duration else -math.inf
        end = -math.inf
        for n, point in enumerate(self._points):
            if np.any(np.abs(point.dq) > REST) or (n and np.any(point.q != self._points[0].q)):
                return end
            end = point.time
        return math.inf

    def _now(self) -> tuple[Vector, Vector]:
        while self._braking is None and len(self._points) > 1 and self._points[1].time <= self._time:
            self._last = _ending(self._points.popleft(), self._points[0])
        time, q, dq = (newest := self._points[0]).time, newest.q, newest.dq
        moves = self._pace.rate > 0.0 and np.any(np.abs(dq) > REST)
        if self._braking is None and len(self._points) == 1 and moves:
            over = (self._time - time) / self._pace.rate
            self._cease(f"set-points ceased to come {(over + self._ahead) * 1e3:.0f} ms ago")
            rate, self._time = self._pace.rate, time + over
            self._brake(q, dq * rate, self._last * rate**2, time)
        q, dq = self._path(self._time)
        return q, dq * self._pace.rate

    def _brake(self, q: Vector, dq: Vector, ddq: Vector, began: float | None = None) -> None:
        self._braking = self._time if began is None else began, braking(self._limits, q, dq, ddq)
        self._pace = Pace(1.0, 0 * q)

    def _path(self, time: float) -> tuple[Vector, Vector]:
        """Where to be (dof,) [rad], and its change per second of the set-points' time."""
        if self._braking is not None:
            began, motion = self._braking
            q, dq, _ = motion.at_time(min(max(time - began, 0.0), motion.duration))
            return np.array(q), np.array(dq)
        before = self._points[0]
        if time <= before.time:
            return before.q, before.dq
        for n in range(1, len(self._points)):
            after = self._points[n]
            ddq = _ending(before, after)
            if time < after.time:
                return quintic(time - before.time, before, after, ddq)
            before = after
        return before.q + (time - before.time) * before.dq, before.dq


class Piece(NamedTuple):
    """The cubic between two set-points: its duration [s], and accelerations (dof,) [rad/s^2] where it begins and ends.

    Rest, before which there is nothing, lasts for ever.
    """

    step: float
    begins: Vector
    ends: Vector


def accelerations(step: float, q0: Vector, dq0: Vector, q1: Vector, dq1: Vector) -> tuple[Vector, Vector]:
    """Accelerations (dof,) at both ends of the cubic with these at its ends, a step [s] apart."""
    moved = 6 * (q1 - q0)
    return (moved - 2 * step * (2 * dq0 + dq1)) / step**2, (2 * step * (dq0 + 2 * dq1) - moved) / step**2


def between(before: Piece, after: Piece) -> Vector:
    """Acceleration (dof,) [rad/s^2] where two cubics meet, of the motion that both are taken from.

    A cubic's second derivative is short of the motion's by h^2 / 12 of its fourth one at the ends, which the change of
    the third from cubic to cubic tells: what is left is of the fourth order in h.
    """
    if before.step == math.inf:
        return 0 * after.begins  # a motion begins from rest
    h0, h1 = before.step, after.step
    fourth = ((after.ends - after.begins) / h1 - (before.ends - before.begins) / h0) / ((h0 + h1) / 2)
    return (before.ends + after.begins) / 2 + (h0**2 + h1**2) / 24 * fourth


def _ending(before: Point, after: Point) -> Vector:
    """Acceleration (dof,) [rad/s^2] with which the curve comes to a set-point: it is that from then on."""
    if after.ddq is None:
        after.ddq = accelerations(after.time - before.time, before.q, before.dq, after.q, after.dq)[1]
    return after.ddq


def quintic(since: float, before: Point, after: Point, ends: Vector) -> tuple[Vector, Vector]:
    """Positions and velocities (dof,) a time [s] after a set-point, on the way to the next, where it `ends` so."""
    assert before.ddq is not None
    h = after.time - before.time
    v0, a0 = before.dq * h, before.ddq * (h**2 / 2)
    rest, slope = after.q - before.q - v0 - a0, after.dq * h - v0 - 2 * a0
    bend = ends * h**2 - 2 * a0
    c3, c4, c5 = 10 * rest - 4 * slope + bend / 2, 7 * slope - 15 * rest - bend, 6 * rest - 3 * slope + bend / 2
    u = since / h
    q = before.q + u * (v0 + u * (a0 + u * (c3 + u * (c4 + u * c5))))
    return q, (v0 + u * (2 * a0 + u * (3 * c3 + u * (4 * c4 + u * 5 * c5)))) / h


def braking(limits: Limits, q: Vector, dq: Vector, ddq: Vector) -> ruckig.Trajectory:
    """The fastest way to rest from q, dq, ddq (dof,) within braking and jerk limits, each joint for itself."""
    given = ruckig.InputParameter(len(q))
    given.control_interface = ruckig.ControlInterface.Velocity
    given.synchronization = ruckig.Synchronization.No
    given.current_position, given.current_velocity = q.tolist(), dq.tolist()
    given.current_acceleration = ddq.tolist()
    given.target_velocity = [0.0] * len(q)
    given.max_acceleration, given.max_jerk = limits.braking.tolist(), limits.jerks.tolist()
    motion = ruckig.Trajectory(len(q))
    result = ruckig.Ruckig(len(q)).calculate(given, motion)
    if result not in (ruckig.Result.Working, ruckig.Result.Finished):
        raise RuntimeError(f"no way to rest from {dq.tolist()}: {result}")
    return motion
