"""Set-points sent ahead of time, as a function of time, for an arm that needs them more often than they are sent.

They are played `ahead` [s] late, so that the next one has arrived when it is needed. Between two of them the curve is
the quintic with their velocities, and accelerations computed from their neighbours: with a cubic, an arm that reads
each millisecond what is sent each 10 ms would exceed its acceleration by 6 %. When set-points cease during a motion,
the arm comes to rest by itself within the limits.

The player may be held up. The arm slows down meanwhile, as it receives nothing: the curve continues where it was, as
slow as the arm is then, and ramps up to its speed. The delay is made up where the limits leave room, and at the next
rest.

An arm whose own speed slider slows it would fall behind, and jump once the slider is raised: set-points that were sent
at a larger share of the speed than the slider allows now are played more slowly by that ratio.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import ruckig

from common.hardware.interface import Limits, Vector
from common.hardware.pace import SHORTEST_STOP, Pace

STALL = 0.09  # [s] without a call of `at`, after which an arm's own program has ended, or is about to
JITTER = 1e-3  # [s] of delay of a call that does not count as a hold-up
SMOOTHING = 0.03  # [s] in which an arm without new set-points loses 63 % of its speed
FASTER = 1.1  # share of their speed at which late set-points are played where there is room
SLOW_RAMP = 1.0  # [s] in which that speed would rise from 0 to 1
CAUGHT_UP = 2e-3  # [s] of delay that may remain
RAMP_SHARE = 0.4  # of the jerk limits is for ramps; the rest is for the motion
LONGEST_DELAY = 0.3  # [s] of set-points: a stop would come as late
REST = 1e-6  # [rad/s] a slower set-point is at rest
JUMP = 1e-3  # [rad] by which a step may exceed the velocity limit: numbers are rounded, cycles jitter
MOST = 1000  # set-points in the queue; a sender that is so far ahead is broken


@dataclass(slots=True)
class Point:
    """A set-point (dof,) [rad], [rad/s], and how much faster than it was sent the arm may move to it.

    Its acceleration [rad/s^2] is known once the next one has arrived, or its time has come. It was computed for an arm
    at this `share` of the full speed.
    """

    time: float
    q: Vector
    dq: Vector
    faster: float = FASTER
    ddq: Vector | None = None
    share: float = 1.0


class SetPointStream:
    """The curve through the set-points that have arrived; times are [s] of any one clock.

    Attributes:
        period: see `__init__`; an arm may want set-points less often for a while.
        ceased: why set-points are ignored until the next `begin`; empty in normal operation.
        resumable: whether the motion may continue then, from where the arm has come to rest.
    """

    def __init__(self, limits: Limits, ahead: float, period: float = 0.002) -> None:
        """Play nothing before `begin`; a set-point is played `ahead` [s] after its own time.

        The arm reads a set-point every `period` [s] and reaches it a period later.
        """
        self._limits, self._ahead, self.period = limits, ahead, period
        self._points: deque[Point] = deque(maxlen=MOST)
        self._braking: tuple[float, ruckig.Trajectory] | None = None
        self._last = np.zeros(0)  # acceleration at the end of the newest piece (dof,) [rad/s^2]
        self._newest = Piece(math.inf, np.zeros(0), np.zeros(0))  # up to the newest set-point
        self._called = self._time = 0.0  # times [s] of the last call, and up to which set-points were played
        self._pace = Pace(1.0, np.zeros(0))
        self._played = np.zeros(0), np.zeros(0)
        self.ceased, self.resumable = "", False

    @property
    def behind(self) -> float:
        """Delay with which set-points are played [s]."""
        return max(0.0, self._called - self._ahead - self._time)

    def begin(self, q: Vector, now: float) -> None:
        """Rest at q (dof,) [rad], and accept set-points that start there."""
        rest = np.zeros_like(q)
        self._points.clear()
        self._points.append(Point(now - self._ahead, q.copy(), rest, ddq=rest))
        self._braking, self.ceased, self.resumable = None, "", False
        self._last, self._newest = rest, Piece(math.inf, rest, rest)
        self._called, self._time, self._pace = now, now - self._ahead, Pace(1.0, rest)
        self._played = q.copy(), rest

    def put(self, time: float, q: Vector, dq: Vector, share: float = 1.0) -> None:
        """Accept a set-point (dof,) [rad], [rad/s] for `time`; one that no arm could follow ends the motion instead.

        `share` is the share of the full speed at which it moves the arm, 0 to 1.
        """
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
        gap = step > STALL  # no sender takes so long; the player may have been held up for as long
        if gap and np.any(np.abs(dq0) > REST):
            self._cease(f"set-points ceased to come for {step * 1e3:.0f} ms", resumable=True)
            return
        piece = Piece(step, *accelerations(step, q0, dq0, q, dq))
        if np.all(np.abs(dq0) <= REST) and np.all(q == q0):
            self._points.pop()  # at rest: a later motion starts where the rest ends
            if self._points and (np.any(self._points[-1].dq) or np.any(self._points[-1].q != q0)):
                self._points.append(Point(before, q0, 0 * q0, ddq=0 * q0))
            piece = Piece(math.inf, 0 * q0, 0 * q0)
        elif newest.ddq is None:
            newest.ddq = 0 * q0 if gap else acceleration_between(self._newest, piece)  # after a gap it is at rest
        a0, a1 = piece.start, piece.end
        jerk = np.maximum(np.abs(a0 - self._newest.end), np.abs(a1 - a0)) / step
        self._newest = piece
        over = max(
            float((np.maximum(np.abs(dq0), np.abs(dq)) / self._limits.velocity).max()),
            math.sqrt(float((np.maximum(np.abs(a0), np.abs(a1)) / self._limits.acceleration).max())),
            float(np.cbrt((jerk / (RAMP_SHARE * self._limits.jerks)).max())),
        )
        self._points.append(Point(time, q.copy(), dq.copy(), min(max(1 / max(over, 1e-9), 1.0), FASTER), share=share))
        if piece.step == math.inf:
            self._points[-1].ddq = piece.end
        elif before <= self._time and np.all(np.abs(dq) <= REST):  # the arm moves to it before the next one arrives
            self._points[-1].ddq = 0 * q

    def at(self, now: float, slider: float = 1.0) -> tuple[Vector, Vector]:
        """Return the position (dof,) [rad] and velocity [rad/s] at a time that never decreases.

        `slider` is the share of its set-points' speed at which the arm moves, 0 to 1.

        After a long time without a call during a motion, the arm is at rest at its last position and stays there.

        Raises:
            IndexError: before `begin`.
        """
        elapsed, self._called = now - self._called, now
        q, dq = self._played
        if elapsed > STALL and np.any(np.abs(dq) > REST):
            self._cease(f"the driver was held up for {elapsed * 1e3:.0f} ms")
            self._brake(q, 0 * q, 0 * q)
        self._advance(elapsed, now - self._ahead, slider)
        self._played = self._now()
        if self.behind > LONGEST_DELAY and self._braking is None:
            why = "the driver was held up too often" if slider == 1.0 else f"the speed slider is at {slider:.0%}"
            self._cease(f"{why}: it is {self.behind * 1e3:.0f} ms late", resumable=True)
        return self._played

    def _cease(self, why: str, resumable: bool = False) -> None:
        if not self.ceased:
            self.ceased, self.resumable = why, resumable

    def _possible_rate(self, slider: float) -> float:
        """Return the rate at which the next set-point can be played, 0 to 1."""
        share = next((point for point in self._points if point.time > self._time), self._points[-1]).share
        return 1.0 if share <= slider else slider / share

    def _advance(self, elapsed: float, nominal: float, slider: float) -> None:
        """Play on for `elapsed` [s]; without delay the set-point time would be `nominal` [s] then."""
        pace, held_up = self._pace, elapsed > self.period + JITTER
        still_until = self._at_rest_until()
        if self._time < min(still_until, nominal):
            self._time = min(still_until, nominal)
            pace.rate, pace.slope = 1.0, 0.0
            elapsed = nominal - self._time
            held_up = elapsed > self.period + JITTER
        elif held_up:
            pace.rate, pace.slope = pace.rate * math.exp(-(elapsed - self.period) / SMOOTHING), 0.0
        step = self.period if held_up else elapsed
        late = nominal - self._time - step
        target = 1.0
        if self._braking is None and self.ceased:
            target = 0.0  # along the path as far as it has arrived
        elif self._braking is None and late > (CAUGHT_UP if pace.rate <= 1.0 else 0.0):
            target = min(point.faster for point in self._points)
        if self._braking is None and (possible := self._possible_rate(slider)) < 1.0:
            fastest = possible * max(target, 1.0)
            target = min(target, fastest)
            if pace.rate > fastest:  # the arm slows down by itself
                pace.rate, pace.slope, pace.acceleration = fastest, 0.0, 0 * pace.acceleration
        if pace.rate == target == 1.0 and pace.slope == 0.0:
            self._time += step
            pace.acceleration = 0 * pace.acceleration
            return
        pace.ramp_up = SHORTEST_STOP if pace.rate < 1.0 else SLOW_RAMP
        if held_up or not np.any(pace.acceleration):  # that of continuing at this rate
            dq = self._curve(self._time)[1]
            pace.acceleration = (self._curve(self._time + pace.rate * self.period)[1] - dq) * pace.rate / self.period
        most = self._limits.braking if self.ceased else self._limits.acceleration
        self._time = pace.advance(self._curve, self._time, target, step, most, RAMP_SHARE * self._limits.jerks)

    def _at_rest_until(self) -> float:
        """Return the set-point time [s] until which the arm stays at rest; minus infinity while it moves."""
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
            self._last = _final_acceleration(self._points.popleft(), self._points[0])
        time, q, dq = (newest := self._points[0]).time, newest.q, newest.dq
        moves = self._pace.rate > 0.0 and np.any(np.abs(dq) > REST)
        if self._braking is None and len(self._points) == 1 and moves:
            over = (self._time - time) / self._pace.rate
            self._cease(f"set-points ceased to come {(over + self._ahead) * 1e3:.0f} ms ago", resumable=True)
            rate, self._time = self._pace.rate, time + over
            self._brake(q, dq * rate, self._last * rate**2, time)
        q, dq = self._curve(self._time)
        return q, dq * self._pace.rate

    def _brake(self, q: Vector, dq: Vector, ddq: Vector, began: float | None = None) -> None:
        self._braking = self._time if began is None else began, stopping_motion(self._limits, q, dq, ddq)
        self._pace = Pace(1.0, 0 * q)

    def _curve(self, time: float) -> tuple[Vector, Vector]:
        """Return the position (dof,) [rad] at a set-point time [s], and its derivative by that time."""
        if self._braking is not None:
            began, motion = self._braking
            q, dq, _ = motion.at_time(min(max(time - began, 0.0), motion.duration))
            return np.array(q), np.array(dq)
        before = self._points[0]
        if time <= before.time:
            return before.q, before.dq
        for n in range(1, len(self._points)):
            after = self._points[n]
            ddq = _final_acceleration(before, after)
            if time < after.time:
                return quintic(time - before.time, before, after, ddq)
            before = after
        return before.q + (time - before.time) * before.dq, before.dq


class Piece(NamedTuple):
    """The cubic between two set-points: duration [s], and accelerations (dof,) [rad/s^2] at its start and end.

    A rest before the first motion has an infinite duration.
    """

    step: float
    start: Vector
    end: Vector


def accelerations(step: float, q0: Vector, dq0: Vector, q1: Vector, dq1: Vector) -> tuple[Vector, Vector]:
    """Return the accelerations (dof,) at both ends of the cubic with these ends, a step [s] apart."""
    moved = 6 * (q1 - q0)
    return (moved - 2 * step * (2 * dq0 + dq1)) / step**2, (2 * step * (dq0 + 2 * dq1) - moved) / step**2


def acceleration_between(before: Piece, after: Piece) -> Vector:
    """Return the acceleration (dof,) [rad/s^2], where two cubics meet, of the motion that both approximate.

    At its ends a cubic's second derivative differs from that of the motion by h^2 / 12 of the fourth derivative, which
    is estimated by the change of the third one from cubic to cubic: the remaining error is of fourth order in h.
    """
    if before.step == math.inf:
        return 0 * after.start  # a motion starts from rest
    h0, h1 = before.step, after.step
    fourth = ((after.end - after.start) / h1 - (before.end - before.start) / h0) / ((h0 + h1) / 2)
    return (before.end + after.start) / 2 + (h0**2 + h1**2) / 24 * fourth


def _final_acceleration(before: Point, after: Point) -> Vector:
    """Return the acceleration (dof,) [rad/s^2] of the curve at a set-point, and fix it there."""
    if after.ddq is None:
        after.ddq = accelerations(after.time - before.time, before.q, before.dq, after.q, after.dq)[1]
    return after.ddq


def quintic(since: float, before: Point, after: Point, final: Vector) -> tuple[Vector, Vector]:
    """Return positions and velocities (dof,) `since` [s] after a set-point, on the quintic to the next one.

    `final` is the acceleration (dof,) [rad/s^2] at the next one.
    """
    assert before.ddq is not None
    h = after.time - before.time
    v0, a0 = before.dq * h, before.ddq * (h**2 / 2)
    rest, slope = after.q - before.q - v0 - a0, after.dq * h - v0 - 2 * a0
    bend = final * h**2 - 2 * a0
    c3, c4, c5 = 10 * rest - 4 * slope + bend / 2, 7 * slope - 15 * rest - bend, 6 * rest - 3 * slope + bend / 2
    u = since / h
    q = before.q + u * (v0 + u * (a0 + u * (c3 + u * (c4 + u * c5))))
    return q, (v0 + u * (2 * a0 + u * (3 * c3 + u * (4 * c4 + u * 5 * c5)))) / h


def stopping_motion(limits: Limits, q: Vector, dq: Vector, ddq: Vector) -> ruckig.Trajectory:
    """Return the fastest motion to rest from q, dq, ddq (dof,) within braking and jerk limits, joint by joint."""
    problem = ruckig.InputParameter(len(q))
    problem.control_interface = ruckig.ControlInterface.Velocity
    problem.synchronization = ruckig.Synchronization.No
    problem.current_position, problem.current_velocity = q.tolist(), dq.tolist()
    problem.current_acceleration = ddq.tolist()
    problem.target_velocity = [0.0] * len(q)
    problem.max_acceleration, problem.max_jerk = limits.braking.tolist(), limits.jerks.tolist()
    motion = ruckig.Trajectory(len(q))
    result = ruckig.Ruckig(len(q)).calculate(problem, motion)
    if result not in (ruckig.Result.Working, ruckig.Result.Finished):
        raise RuntimeError(f"ruckig finds no motion to rest from {dq.tolist()}: {result}")
    return motion
