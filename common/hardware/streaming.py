"""Set-points that come ahead of time, as a function of it, for an arm that wants one more often than they are made.

They are played `ahead` late, so that the next one is there when it is needed; between two of them the curve is the
cubic with their velocities. When they cease in the middle of a motion it comes to rest by itself within the limits.
"""

from __future__ import annotations

from collections import deque

import numpy as np
import ruckig

from common.hardware.interface import Limits, Vector

STALL = 0.05  # [s] without being asked where to be
REST = 1e-6  # [rad/s] slower, a set-point is at rest
JUMP = 1e-3  # [rad] by which a step may be longer than the velocity limit allows: numbers are rounded, cycles jitter
MOST = 1000  # set-points that wait; a sender that is so far ahead is broken


class SetPointStream:
    """What is played of the set-points that came; times are [s] of one clock, whichever."""

    def __init__(self, limits: Limits, ahead: float) -> None:
        """Nothing is played before `begin`; `ahead` is the time [s] between a set-point's own and its turn."""
        self._limits, self._ahead = limits, ahead
        self._points: deque[tuple[float, Vector, Vector]] = deque(maxlen=MOST)
        self._braking: tuple[float, ruckig.Trajectory] | None = None
        self._last = np.zeros(0)  # acceleration at the end of the newest piece (dof,) [rad/s^2]
        self._asked, self._played = 0.0, (np.zeros(0), np.zeros(0))
        self.ceased = ""  # why nothing is taken until the next `begin`; empty while all is well

    def begin(self, q: Vector, now: float) -> None:
        """Rest at q (dof,) [rad], and take set-points again that begin there."""
        self._points.clear()
        self._points.append((now - self._ahead, q.copy(), np.zeros_like(q)))
        self._braking, self.ceased = None, ""
        self._asked, self._played = now, (q.copy(), np.zeros_like(q))

    def put(self, time: float, q: Vector, dq: Vector) -> None:
        """Take a set-point (dof,) [rad], [rad/s] for `time`; one that nobody could follow ends the motion instead."""
        if self.ceased or not self._points:
            return
        before, q0, _ = self._points[-1]
        step = time - before
        if step <= 0:
            return
        off = np.abs(q - q0) - self._limits.velocity * step - JUMP
        if not np.all(off <= 0):  # also when it is not finite
            j = int(np.argmax(np.where(np.isfinite(off), off, np.inf)))
            self.ceased = f"{self._limits.names[j]} would jump by {abs(q[j] - q0[j]):.4g} rad in {step * 1e3:.1f} ms"
            return
        if np.all(np.abs(self._points[-1][2]) <= REST) and np.all(q == q0):
            self._points.pop()  # rests: a later motion begins where the rest ends
            if self._points and np.any(self._points[-1][2]):
                self._points.append((before, q0, 0 * q0))
        self._points.append((time, q.copy(), dq.copy()))

    def at(self, now: float) -> tuple[Vector, Vector]:
        """Where to be (dof,) [rad], and how fast [rad/s], at a time that does not go back.

        Who asks too seldom in the middle of a motion was held up, and the arm has come to rest meanwhile where it was
        sent last: there it stays.

        Raises:
            IndexError: before `begin`.
        """
        held_up = now - self._asked
        self._asked = now
        if held_up > STALL and np.any(np.abs(self._played[1]) > REST):
            self.ceased = self.ceased or f"the driver was held up for {held_up * 1e3:.0f} ms"
            rest = 0 * self._played[1]
            self._braking = now - self._ahead, braking(self._limits, self._played[0], rest, rest)
        self._played = self._at(now)
        return self._played

    def _at(self, now: float) -> tuple[Vector, Vector]:
        time = now - self._ahead
        if self._braking is not None:
            return self._brake(time)
        while len(self._points) > 1 and self._points[1][0] <= time:
            before, q, dq = self._points.popleft()
            time1, q1, dq1 = self._points[0]
            step = time1 - before
            self._last = (6 * (q - q1) + 2 * step * (dq + 2 * dq1)) / step**2
        t0, q0, dq0 = self._points[0]
        if len(self._points) > 1:
            t1, q1, dq1 = self._points[1]
            return hermite((time - t0) / (t1 - t0), t1 - t0, q0, dq0, q1, dq1) if time > t0 else (q0, dq0)
        if np.all(np.abs(dq0) <= REST):
            return q0, 0 * q0
        self.ceased = self.ceased or f"set-points ceased to come {(time - t0 + self._ahead) * 1e3:.0f} ms ago"
        self._braking = t0, braking(self._limits, q0, dq0, self._last)
        return self._brake(time)

    def _brake(self, time: float) -> tuple[Vector, Vector]:
        assert self._braking is not None
        began, motion = self._braking
        q, dq, _ = motion.at_time(min(max(time - began, 0.0), motion.duration))
        return np.array(q), np.array(dq)


def hermite(
    u: float, step: float, q0: Vector, dq0: Vector, q1: Vector, dq1: Vector
) -> tuple[Vector, Vector]:
    """Positions and velocities (dof,) at the share u of a step [s] of the cubic with these at its ends."""
    moved, a, b = q1 - q0, step * dq0, step * dq1
    q = q0 + u * (a + u * ((3 * moved - 2 * a - b) + u * (a + b - 2 * moved)))
    return q, (a + u * (2 * (3 * moved - 2 * a - b) + 3 * u * (a + b - 2 * moved))) / step


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
