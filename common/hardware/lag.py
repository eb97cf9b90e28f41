"""Hardware that follows its set-points with a first-order lag, as a real arm does."""

from __future__ import annotations

import math

from pydantic import Field

from common.config import Parameters, RobotConfig
from common.hardware.interface import Limits, Vector
from common.hardware.mock import SimulatedFingers, simulated_fingers

simulated = True


class Options(Parameters):
    """Response time of the arm."""

    time_constant: float = Field(0.03, gt=0, le=1, description="63 % of a step is done after this [s]")


class LagHardware:
    """An arm with dq/dt = (set-point - q) / time_constant, integrated exactly between calls."""

    def __init__(self, start: Vector, time_constant: float, gripper: SimulatedFingers | None) -> None:
        """Start at rest at `start` (dof,) [rad]; `time_constant` in [s]."""
        self.gripper = gripper
        self._time_constant = time_constant
        self._positions = start.copy()
        self._set_point = start.copy()
        self._now: float | None = None

    def read(self, now: float) -> tuple[Vector, Vector]:
        """Return positions (dof,) [rad] and velocities (dof,) [rad/s] at a time that never decreases."""
        elapsed = max(0.0, now - self._now) if self._now is not None else 0.0
        self._now = now
        error = (self._positions - self._set_point) * math.exp(-elapsed / self._time_constant)
        self._positions = self._set_point + error
        return self._positions.copy(), -error / self._time_constant

    def write(self, positions: Vector, velocities: Vector, now: float) -> None:
        """Approach the set-points from here on; their velocities are not used."""
        self.read(now)
        self._set_point = positions.copy()

    def close(self) -> None:
        """Do nothing: there is no device."""


def create(robot: RobotConfig, limits: Limits, start: Vector, options: Options) -> LagHardware:
    """Create the arm at `start` with open fingers."""
    return LagHardware(start, options.time_constant, simulated_fingers(robot))
