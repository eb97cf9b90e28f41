"""Gaps in the set-points: late cycles, an arm that stopped by itself, and a start from an unknown position."""

from __future__ import annotations

import math

import numpy as np

from common.control.set_points import Standstill
from common.control.trajectory import Tolerances
from common.hardware.interface import HardwareFault, Vector

LATE = 2  # periods: a later cycle moves the arm by no more, and
STALLED = 2  # usual cycles: after a later one the motion resumes from rest, where the arm is
USUAL_SHARE = 0.2  # weight of the newest cycle in the mean duration of cycles
FROZEN, RECENT = 0.15, 0.5  # [s] cell time between cycles after which an interruption ends a motion, if it was recent
REST_TIMEOUT = 5.0  # [s] for an interrupted arm to come to rest: a low slider makes it slow


class SetPointGaps:
    """Whether set-points may continue, and by how much time they advance in a cycle.

    Attributes:
        last: cell time of the newest set-point [s]; None before the first.
        bridges: time between set-points that the arm bridges by itself, as they are sent ahead of time [s].
        resumed: number of interruptions after which the motion continued.
        waiting: whether set-points wait until an interrupted arm is at rest.
    """

    def __init__(self, tolerances: Tolerances, standstill: Standstill, period: float) -> None:
        """Expect cycles of `period` [s]."""
        self._tolerances, self._standstill = tolerances, standstill
        self._period = self._usual = period
        self.last: float | None = None
        self.bridges = 0.0
        self.resumed = 0
        self.waiting = False
        self._found: Vector | None = None  # first reading of an arm that moves
        self._frozen_at = -math.inf  # cell time at which a cycle last came later than FROZEN [s]
        self._interrupted_at: float | None = None  # cell time since which set-points are not accepted [s]
        self._reason = ""  # of that interruption

    @property
    def interrupted(self) -> bool:
        """Whether the arm does not accept set-points, or has only just accepted one."""
        return self._interrupted_at is not None

    @property
    def locating(self) -> bool:
        """Whether a second reading has to show how an arm moves."""
        return self._found is not None

    @property
    def longest(self) -> float:
        """Time by which set-points advance at most in a cycle [s]."""
        return max(LATE * self._period, self.bridges)

    def interrupt(self, reason: str, now: float) -> str:
        """Wait until the arm is at rest; return a line for the log, empty if it was interrupted before.

        Raises:
            HardwareFault: this process was held up too long itself.
        """
        if now - self._frozen_at < RECENT:
            raise HardwareFault(reason)
        self.waiting, again = True, self.interrupted
        if again:
            return ""
        self._interrupted_at, self._reason = now, reason
        self.resumed += 1
        return f"{reason}: the motion continues once the arm is at rest"

    def end_interruption(self) -> None:
        """Forget an interruption."""
        self._interrupted_at, self.waiting = None, False

    def advance(self, now: float) -> tuple[float, bool]:
        """Return by how much time set-points advance at a cell time [s], and whether they resume from rest."""
        elapsed = self._period if self.last is None else max(now - self.last, 0.0)
        self.last = now
        if elapsed > FROZEN:
            self._frozen_at = now
        if self.waiting:
            return 0.0, False
        self._interrupted_at = None
        stalled = elapsed > max(STALLED * self._usual, self.bridges) + 1e-6
        self._usual = max(self._period, self._usual + USUAL_SHARE * (elapsed - self._usual))
        return self._period if stalled else min(elapsed, self.longest), stalled

    def has_come_to_rest(self, now: float, velocity: Vector) -> bool:
        """Return whether an interrupted arm is at rest: the next set-point may be accepted.

        Raises:
            HardwareFault: it does not come to rest.
        """
        assert self._interrupted_at is not None
        if now - self._interrupted_at > REST_TIMEOUT:
            raise HardwareFault(f"{self._reason}; the arm was not at rest within {REST_TIMEOUT:g} s")
        self.waiting = bool(np.any(np.abs(velocity) > self._tolerances.stopped_velocity))
        return not self.waiting

    def locate_arm(self, now: float, measured: Vector, velocity: Vector, lost: bool, moved_by_goal: bool) -> bool:
        """Start set-points where the arm is, after a start or a fault; return whether they may start.

        One reading does not show whether an arm moves, or reports the velocity that it was commanded: two do.

        Args:
            now: cell time [s].
            measured: where the arm is (dof,) [rad].
            velocity: measured (dof,) [rad/s].
            lost: whether a fault is over: the arm may have sagged, or start anywhere.
            moved_by_goal: whether a goal was accepted already.
        """
        if lost or (self.last is None and not moved_by_goal):
            self.last = None
            self._standstill.locate(measured)
            if np.any(np.abs(velocity) > self._tolerances.stopped_velocity):
                self._found, self.last = measured.copy(), now
                return False
        if self._found is not None:
            mean = (measured - self._found) / max(now - (self.last or now), 1e-9)
            self._found, self.last = None, None
            moves = mean * np.sign(velocity) > np.abs(velocity) / 2
            self._standstill.locate(measured, np.where(moves, velocity, 0.0))
        return True
