"""Hardware that reports exactly what it is commanded."""

from __future__ import annotations

from common.config import Parameters, RobotConfig
from common.hardware.fingers import Fingers
from common.hardware.interface import Limits, Vector

simulated = True


class Options(Parameters):
    """None: a perfect arm has nothing to set."""


class MockHardware:
    """An arm that is at once where it is told to be."""

    def __init__(self, start: Vector, gripper: Fingers | None) -> None:
        """Begin at rest at `start` (dof,) [rad]."""
        self.gripper = gripper
        self._positions = start.copy()
        self._velocities = 0.0 * start

    def read(self, now: float) -> tuple[Vector, Vector]:
        """The newest set-points (dof,) [rad], [rad/s]."""
        return self._positions.copy(), self._velocities.copy()

    def write(self, positions: Vector, velocities: Vector, now: float) -> None:
        """Be at the set-points."""
        self._positions, self._velocities = positions.copy(), velocities.copy()

    def close(self) -> None:
        """Nothing to let go of."""


def create(robot: RobotConfig, limits: Limits, start: Vector, options: Options) -> MockHardware:
    """The arm at `start` with open fingers."""
    return MockHardware(start, Fingers(robot.gripper, robot.gripper.max_width) if robot.gripper else None)
