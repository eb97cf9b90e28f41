"""An executor for tests of drivers: cycles of 10 ms that read an arm and send set-points."""

import time
from collections.abc import Callable

import numpy as np

from common.hardware.driven_arm import DrivenArm
from common.hardware.interface import HardwareFault

PERIOD, TIMEOUT = 0.01, 30.0
SWING = 1.6  # [s] there and back: a visible motion, short enough for few stalls of the machine
FASTEST = 0.2 * np.pi / SWING  # [rad/s] of a joint in the middle of a swing
DELAYS = (  # problems that a busy machine causes, reported by either process
    "the driver was held up", "no message from", "set-points ceased to come", "its program has ended")


class Rig:
    """The backend; `rest` are the velocities (dof,) of an arm at rest."""

    def __init__(self, arm: DrivenArm, rest: np.ndarray) -> None:
        self.arm, self.problems, self.rest = arm, [""], rest
        self.measured = rest
        self.target: np.ndarray | None = None  # newest set-point, None after a rejected one

    def cycle(self, q: np.ndarray | None, dq: np.ndarray, now: float | None = None) -> str:
        """Do one cycle with these set-points, without q at the same place; return "" or why they were rejected."""
        now = time.monotonic() if now is None else now
        try:
            self.measured, _ = self.arm.read(now)
            q = q if q is not None else self.measured if self.target is None else self.target
            self.arm.write(q, dq, now)
            self.target, problem = q, ""
        except HardwareFault as fault:
            self.target, problem = None, str(fault)
        if problem != self.problems[-1]:
            self.problems.append(problem)
        time.sleep(PERIOD)
        return problem

    def wait_for(self, condition: Callable[[], object]) -> None:
        """Wait for a condition without sending set-points."""
        end = time.monotonic() + TIMEOUT
        while not condition():
            assert time.monotonic() < end, self.problems[-6:]
            time.sleep(0.001)

    def until(self, wanted: str) -> str:
        """Stay at rest until a cycle ends with a problem that contains `wanted`; "" waits for accepted set-points."""
        end = time.monotonic() + TIMEOUT
        while (problem := self.cycle(None, self.rest)) != wanted and not (wanted and wanted in problem):
            assert time.monotonic() < end, f"{wanted!r} did not occur: {self.problems}"
        return problem

    def wave(self, seconds: float, meanwhile: Callable[[float], None] = lambda t: None) -> str:
        """Swing every joint by 0.2 rad; return "" or why it ended early. Call `meanwhile` in each cycle."""
        q0 = self.arm.read(0.0)[0] if self.target is None else self.target
        start, w, ones = time.monotonic(), 2 * np.pi / SWING, 1 + self.rest
        while (t := time.monotonic() - start) < seconds:
            if problem := self.cycle(q0 + 0.1 * (1 - np.cos(w * t)) * ones, FASTEST * np.sin(w * t) * ones):
                return problem
            meanwhile(t)
        return ""

    def swing(self, seconds: float, meanwhile: Callable[[float], None] = lambda t: None) -> str:
        """Repeat `wave` until no delay of this machine interrupts it."""
        end = time.monotonic() + TIMEOUT
        while any(reason in (problem := self.wave(seconds, meanwhile)) for reason in DELAYS):
            assert time.monotonic() < end, self.problems[-6:]
            self.until("")
        return problem

    def until_it_moves(self) -> None:
        """Repeat short motions until one is not interrupted: a link may be lost again before it is stable."""
        end = time.monotonic() + TIMEOUT
        self.until("")
        while self.wave(0.3):
            assert time.monotonic() < end, self.problems[-6:]
            self.until("")

    def done(self, number: int) -> str:
        """Return the outcome of an order."""
        end = time.monotonic() + TIMEOUT
        while (outcome := self.arm.outcome(number)) is None:
            assert time.monotonic() < end
            time.sleep(PERIOD)
        return outcome
