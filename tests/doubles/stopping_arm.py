"""A backend for tests: a simulated arm with a controller of its own, on which a test triggers safety stops."""

from __future__ import annotations

from common.config import Parameters, RobotConfig
from common.hardware.interface import ArmState, HardwareFault, Limits, Vector
from common.hardware.mock import MockHardware, SimulatedFingers, simulated_fingers

simulated = True
created: list[StoppingArm] = []  # the newest last


class Options(Parameters):
    """None."""


class StoppingArm(MockHardware):
    """Executes orders at once; `stopped` is a safety stop, `powered` its joints, `refuses` the outcome of orders."""

    delay = ahead = late = 0.0

    def __init__(self, start: Vector, gripper: SimulatedFingers | None) -> None:
        super().__init__(start, gripper)
        self.stopped, self.powered = False, True
        self.orders: list[tuple[object, ...]] = []
        self.refuses = ""

    @property
    def state(self) -> ArmState:
        q, dq = self.read(0.0)
        if not self.powered:
            return ArmState(q.tolist(), dq.tolist(), "off", "without power: `zencell robot enable`")
        return ArmState(q.tolist(), dq.tolist(), "protective_stop" if self.stopped else "running", "stopped for safety")

    def write(self, positions: Vector, velocities: Vector, now: float) -> None:
        if self.stopped:
            raise HardwareFault("stopped for safety")
        super().write(positions, velocities, now)

    def order(self, act: str, *values: float) -> int:
        self.orders.append((act, *values))
        self.stopped = self.stopped and act != "recover"
        self.powered = self.powered or act == "enable"
        return len(self.orders)

    def outcome(self, number: int) -> str:
        return self.refuses


def create(robot: RobotConfig, limits: Limits, start: Vector, options: Options) -> StoppingArm:
    """Create the arm at `start` with open fingers."""
    created.append(StoppingArm(start, simulated_fingers(robot)))
    return created[-1]
