"""An executor, the driver of an arm that its speed slider slows, and the double of that arm, on one virtual clock."""

from __future__ import annotations

import contextlib
from collections import deque
from types import SimpleNamespace

import numpy as np

from common.control.executor import Executor
from common.errors import Refused
from common.hardware import driven_arm
from common.hardware.driven_arm import DrivenArm, Player
from common.hardware.driver_process import DriverProcess
from common.hardware.interface import ArmState, Limits
from common.hardware.streaming import SetPointStream
from common.messages import ExecuteRequest, Header, JogCommand, StopRequest
from common.time_source import SystemTimeSource, use_time_source
from drivers.ur import Smoothing
from tests.common.control.trajectories import rest_to_rest
from tests.doubles.ur_arm import SERVOJ, Arm

SIX = np.ones(6)
LIMITS = Limits(tuple("abcdef"), -6 * SIX, 6 * SIX, 3 * SIX, 5 * SIX, 10 * SIX, 500 * SIX)
CYCLE, PERIOD, LOOKAHEAD, EPOCH = 0.002, 0.01, 0.03, 1_700_000_000


class Link:
    """One direction of a pipe."""

    def __init__(self) -> None:
        self.messages: deque[object] = deque()

    def poll(self) -> bool:
        return bool(self.messages)

    def recv(self) -> object:
        return self.messages.popleft()


class Driver:
    """Servoes the double as the driver of Universal Robots does."""

    rate, paced_by_arm, realtime, slowed = 1 / CYCLE, True, False, True

    def __init__(self, arm: Arm, clock: SimpleNamespace) -> None:
        self._arm, self._clock, self._smoothing = arm, clock, Smoothing(self.rate)

    def read(self) -> ArmState:
        stopped = self._arm.stops > 0
        return ArmState(self._arm.q.tolist(), self._arm.qd.tolist(), "protective_stop" if stopped else "running", "",
                        self._arm.slider)

    def due(self) -> list[float]:
        return [self._clock.monotonic()]

    def servo(self, points: list[np.ndarray]) -> None:
        self._arm.registers["input_int_register"][0] = SERVOJ
        self._arm.registers["input_double_register"][:10] = [*self._smoothing.add(points[-1]), 0, 0, 0, LOOKAHEAD]

    def wait(self) -> None:
        """Do nothing."""


class HeldUpArm:
    """Runs cycles of arm, driver and executor, each unless it is frozen."""

    def __init__(self, monkeypatch, ahead: float) -> None:
        self.now, self.frozen = 100.0, {"driver": 0.0, "executor": 0.0}
        clock = SimpleNamespace(monotonic=lambda: self.now, sleep=lambda seconds: None)
        monkeypatch.setattr(driven_arm, "time", clock)
        monkeypatch.setattr(driven_arm.select, "select", lambda *_: ([], [True], []))
        monkeypatch.setattr(DriverProcess, "keep_running", lambda process: None)
        self.arm, down = Arm(np.zeros(6)), Link()
        self.arm.start_program()
        self.hardware = DrivenArm("none", {}, LIMITS, gripper=None, ahead=ahead, delay=ahead + LOOKAHEAD + 0.011,
                                  name="arm")
        process = self.hardware._process
        process.send = lambda message: (down.messages.append(message), True)[1]  # type: ignore[method-assign]
        down.send = process.on_message  # type: ignore[attr-defined]
        self.player = Player(Driver(self.arm, clock), SetPointStream(LIMITS, ahead, CYCLE), down)  # type: ignore[arg-type]
        self.source = SystemTimeSource()
        self.source.monotonic_ns = self.source.wall_ns = lambda: round((EPOCH + self.now) * 1e9)  # type: ignore[method-assign]
        self.executor = Executor(self.hardware, LIMITS, np.zeros(6))
        self.status, self.jogs, self.notes, self.cycles = self.executor.arm.status, 0.0, list[str](), 0
        self.run(0.5)

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / CYCLE)):
            self.now += CYCLE
            self.arm.step(CYCLE)
            if self.now > self.frozen["driver"]:
                self.player.cycle()
            self.cycles += 1
            if self.cycles % round(PERIOD / CYCLE) == 0 and self.now > self.frozen["executor"]:
                with use_time_source(self.source):
                    if self.jogs:
                        with contextlib.suppress(Refused):
                            self.executor.jog(JogCommand(owner="ann", joints={"a": self.jogs}))
                    report = self.executor.cycle(Header(stamp=self.source.wall_ns()))
                self.notes += report.notes
                self.status = self.executor.arm.status

    def move(self, end: float, seconds: float) -> None:
        path = rest_to_rest(self.executor.arm.set_point, end * SIX, seconds, 41, LIMITS.names)
        request = ExecuteRequest(id=f"to {end} at {self.now}", trajectory=path)
        assert self.executor.execute(request, EPOCH + self.now).state == "active"

    def stop(self) -> None:
        with use_time_source(self.source):
            self.executor.authority.stop(StopRequest(owner="ann"), EPOCH + self.now)
