"""Simulated fingers: a jerk-limited motion of the width, which stops at what is between them."""

from __future__ import annotations

import ruckig

from common.config import GripperConfig
from common.hardware.interface import GripperReading

TOUCH = 1e-9  # widths closer than this are the same [m]


class Fingers:
    """A gripper that reports what it is commanded, but does not close through an obstruction; also the valve of a cup.

    While something blocks them the fingers press: when it goes away they close on to the width they were told.
    """

    def __init__(self, config: GripperConfig, width: float) -> None:
        """Begin at rest at a width [m]."""
        self._config = config
        self._width, self._velocity, self._acceleration = width, 0.0, 0.0
        self._target = width
        self._effort = config.max_effort
        self._obstruction = 0.0
        self._blocked = False
        self._since = 0.0
        self._motion: ruckig.Trajectory | None = None
        self._now = 0.0

    def command(self, width: float, now: float, effort: float | None = None) -> None:
        """Start to move from the present width, velocity and acceleration to rest at a width [m].

        On something in the way the fingers press with an effort [N], all that they have when none is given.
        """
        self._advance(now)
        self._effort = self._config.max_effort if effort is None else effort
        self._target = min(max(width, 0.0), self._config.max_width)
        self._start(now)

    def obstruct(self, width: float) -> None:
        """Let the fingers close no further than a width [m]; 0 when nothing is between them."""
        freed = self._blocked and width < self._width - TOUCH
        self._obstruction = width
        if freed:
            self._blocked = False
            self._start(self._now)
        elif self._config.cup is not None and self._motion is None and self._target < width - TOUCH:
            self._width, self._blocked = width, True  # a cup that draws takes what it comes to

    def place(self, width: float) -> None:
        """Be at rest at a width [m] at once."""
        self._width = self._target = min(max(width, 0.0), self._config.max_width)
        self._velocity = self._acceleration = 0.0
        self._motion, self._blocked = None, False

    def read(self, now: float) -> GripperReading:
        """Width [m], its rate [m/s], whether the fingers move, whether they press on something, and how hard."""
        self._advance(now)
        effort = self._effort if self._blocked else 0.0
        return GripperReading(self._width, self._velocity, self._motion is not None, self._blocked, effort)

    def _start(self, now: float) -> None:
        self._blocked = False
        self._motion, self._since = self._plan(), now
        self._advance(now)

    def _advance(self, now: float) -> None:
        self._now = now
        if self._motion is None:
            return
        elapsed = now - self._since
        if elapsed >= self._motion.duration:
            self._width, self._velocity, self._acceleration = self._target, 0.0, 0.0
            self._motion = None
        else:
            (self._width,), (self._velocity,), (self._acceleration,) = self._motion.at_time(max(elapsed, 0.0))
            self._width = min(max(self._width, 0.0), self._config.max_width)
        if self._target < self._obstruction - TOUCH and self._width <= self._obstruction + TOUCH:
            self._width, self._velocity, self._acceleration = self._obstruction, 0.0, 0.0
            self._motion, self._blocked = None, True

    def _plan(self) -> ruckig.Trajectory:
        given = ruckig.InputParameter(1)
        given.current_position, given.current_velocity = [self._width], [self._velocity]
        given.current_acceleration = [self._acceleration]
        given.target_position = [self._target]
        given.max_velocity, given.max_acceleration = [self._config.speed], [self._config.acceleration]
        given.max_jerk = [self._config.jerk]
        motion = ruckig.Trajectory(1)
        result = ruckig.Ruckig(1).calculate(given, motion)
        if result not in (ruckig.Result.Working, ruckig.Result.Finished):
            raise RuntimeError(f"no finger motion from {given.current_position} to {given.target_position}: {result}")
        return motion
