"""What stands for the executor in tests of drivers: cycles of 10 ms that read an arm and send it set-points."""

import time

import numpy as np

from common.hardware.driver import DrivenArm
from common.hardware.interface import HardwareFault

PERIOD, TIMEOUT = 0.01, 30.0


class Rig:
    """The backend; `rest` are the velocities (dof,) of an arm that rests."""

    def __init__(self, arm: DrivenArm, rest: np.ndarray) -> None:
        self.arm, self.told, self.rest = arm, [""], rest
        self.measured = rest

    def cycle(self, q: np.ndarray | None, dq: np.ndarray, now: float | None = None) -> str:
        """One cycle, with set-points of now: empty when they were taken, else why not."""
        now = time.monotonic() if now is None else now
        try:
            measured, _ = self.arm.read(now)
            self.measured = measured
            self.arm.write(measured if q is None else q, dq, now)
            problem = ""
        except HardwareFault as fault:
            problem = str(fault)
        if problem != self.told[-1]:
            self.told.append(problem)
        time.sleep(PERIOD)
        return problem

    def until(self, wanted: str) -> str:
        """Rest until a cycle ends with what is wanted: empty for set-points that are taken."""
        end = time.monotonic() + TIMEOUT
        q = None
        while True:
            problem = self.cycle(q, self.rest)
            q = None if problem else self.measured if q is None else q
            if problem == wanted or (wanted and wanted in problem):
                return problem
            assert time.monotonic() < end, f"{wanted!r} did not come: {self.told}"

    def wave(self, seconds: float) -> str:
        """Swing every joint by 0.2 rad: empty at the end, or why it ended before."""
        q0, _ = self.arm.read(0.0)
        began = time.monotonic()
        while (t := time.monotonic() - began) < seconds:
            each = 1 + self.rest
            if problem := self.cycle(q0 + 0.1 * (1 - np.cos(2 * t)) * each, 0.2 * np.sin(2 * t) * each):
                return problem
        return ""

    def until_it_moves(self) -> None:
        """Try until a motion is not cut short: a link that was lost may be lost once more before it is there again."""
        end = time.monotonic() + TIMEOUT
        self.until("")
        while self.wave(0.3):
            assert time.monotonic() < end, self.told[-6:]
            self.until("")

    def done(self, number: int) -> str:
        """What became of an order."""
        end = time.monotonic() + TIMEOUT
        while (outcome := self.arm.outcome(number)) is None:
            assert time.monotonic() < end
            time.sleep(PERIOD)
        return outcome
