"""Hardware that follows its set-points with a first-order lag: what a controller's tolerances are for."""

from __future__ import annotations

import math

from pydantic import Field

from common.config import Parameters, RobotConfig
from common.hardware.fingers import Fingers
from common.hardware.interface import Limits, Vector

simulated = True


class Options(Parameters):
    """How slow the arm is."""

    time_constant: float = Field(0.03, gt=0, le=1, description="63 % of a step is done after this [s]")


class LagHardware:
    """An arm with dq/dt = (set-point - q) / time_constant, integrated exactly between calls."""

    def __init__(self, start: Vector, time_constant: float, gripper: Fingers | None) -> None:
        """Begin at rest at `start` (dof,) [rad]; `time_constant` in [s]."""
        self.gripper = gripper
        self._time_constant = time_constant
        self._positions = start.copy()
        self._set_point = start.copy()
        self._now: float | None = None

    def read(self, now: float) -> tuple[Vector, Vector]:
        """Positions (dof,) [rad] and velocities (dof,) [rad/s] at a time that does not go back."""
        elapsed = max(0.0, now - self._now) if self._now is not None else 0.0
        self._now = now
        left = (self._positions - self._set_point) * math.exp(-elapsed / self._time_constant)
        self._positions = self._set_point + left
        return self._positions.copy(), -left / self._time_constant

    def write(self, positions: Vector, velocities: Vector, now: float) -> None:
        """Head for the set-points from here on; their velocities are not used."""
        self.read(now)
        self._set_point = positions.copy()

    def close(self) -> None:
        """Nothing to let go of."""


def create(robot: RobotConfig, limits: Limits, start: Vector, options: Options) -> LagHardware:
    """The arm at `start` with open fingers."""
    fingers = Fingers(robot.gripper, robot.gripper.max_width) if robot.gripper else None
    return LagHardware(start, options.time_constant, fingers)
