"""A backend for tests: a simulated arm with a controller of its own, which a test stops for safety."""

from __future__ import annotations

from common.config import Parameters, RobotConfig
from common.hardware.interface import ArmState, HardwareFault, Limits, Vector
from common.hardware.mock import MockHardware, SimulatedFingers

simulated = True
made: list[StoppingArm] = []  # the newest last


class Options(Parameters):
    """None."""


class StoppingArm(MockHardware):
    """Does all it is told at once."""

    delay = ahead = late = 0.0

    def __init__(self, start: Vector, gripper: SimulatedFingers | None) -> None:
        """Not stopped."""
        super().__init__(start, gripper)
        self.stopped = False
        self.orders: list[tuple[object, ...]] = []
        self.refuses = ""

    @property
    def state(self) -> ArmState:
        """Stopped or running."""
        q, dq = self.read(0.0)
        return ArmState(q.tolist(), dq.tolist(), "protective_stop" if self.stopped else "running", "stopped for safety")

    def write(self, positions: Vector, velocities: Vector, now: float) -> None:
        """Move, unless it is stopped."""
        if self.stopped:
            raise HardwareFault("stopped for safety")
        super().write(positions, velocities, now)

    def order(self, act: str, *values: float) -> int:
        """Recover, or take note."""
        self.orders.append((act, *values))
        self.stopped = self.stopped and act != "recover"
        return len(self.orders)

    def outcome(self, number: int) -> str:
        """It is done, unless it is refused."""
        return self.refuses


def create(robot: RobotConfig, limits: Limits, start: Vector, options: Options) -> StoppingArm:
    """The arm at `start` with open fingers."""
    made.append(StoppingArm(start, SimulatedFingers(robot.gripper, robot.gripper.max_width) if robot.gripper else None))
    return made[-1]
