"""What stands for the executor in tests of drivers: cycles of 10 ms that read an arm and send it set-points."""

import time
from collections.abc import Callable

import numpy as np

from common.hardware.driven_arm import DrivenArm
from common.hardware.interface import HardwareFault

PERIOD, TIMEOUT = 0.01, 30.0
SWING = 1.6  # [s] there and back: it shows, and few stalls of a machine are in it
FASTEST = 0.2 * np.pi / SWING  # [rad/s] that a joint is swung, halfway there and back
HELD_UP = (  # a process, by the machine: which one it was decides who says so
    "the driver was held up", "no message from", "set-points ceased to come", "its program has ended")


class Rig:
    """The backend; `rest` are the velocities (dof,) of an arm that rests."""

    def __init__(self, arm: DrivenArm, rest: np.ndarray) -> None:
        self.arm, self.told, self.rest = arm, [""], rest
        self.measured = rest
        self.kept: np.ndarray | None = None  # the set-point that was taken last, where none was refused since

    def cycle(self, q: np.ndarray | None, dq: np.ndarray, now: float | None = None) -> str:
        """One cycle, with set-points of now: empty when they were taken, else why not; without any it stays."""
        now = time.monotonic() if now is None else now
        try:
            measured, _ = self.arm.read(now)
            self.measured = measured
            q = q if q is not None else measured if self.kept is None else self.kept
            self.arm.write(q, dq, now)
            self.kept, problem = q, ""
        except HardwareFault as fault:
            self.kept, problem = None, str(fault)
        if problem != self.told[-1]:
            self.told.append(problem)
        time.sleep(PERIOD)
        return problem

    def until(self, wanted: str) -> str:
        """Rest until a cycle ends with what is wanted: empty for set-points that are taken."""
        end = time.monotonic() + TIMEOUT
        while True:
            problem = self.cycle(None, self.rest)
            if problem == wanted or (wanted and wanted in problem):
                return problem
            assert time.monotonic() < end, f"{wanted!r} did not come: {self.told}"

    def wave(self, seconds: float, beside: Callable[[float], None] = lambda t: None) -> str:
        """Swing every joint by 0.2 rad in SWING: empty at the end, or why it ended before; `beside` is called too."""
        q0 = self.arm.read(0.0)[0] if self.kept is None else self.kept
        began, w = time.monotonic(), 2 * np.pi / SWING
        while (t := time.monotonic() - began) < seconds:
            each = 1 + self.rest
            if problem := self.cycle(q0 + 0.1 * (1 - np.cos(w * t)) * each, FASTEST * np.sin(w * t) * each):
                return problem
            beside(t)
        return ""

    def swing(self, seconds: float, beside: Callable[[float], None] = lambda t: None) -> str:
        """`wave` until one is not cut short by this machine, which holds a process up now and then: the arm rests."""
        end = time.monotonic() + TIMEOUT
        problem = self.wave(seconds, beside)
        while any(reason in problem for reason in HELD_UP):
            assert time.monotonic() < end, self.told[-6:]
            self.until("")
            problem = self.wave(seconds, beside)
        return problem

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
