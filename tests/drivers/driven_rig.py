"""An executor for tests of drivers: cycles of 10 ms that read an arm and send set-points."""

import time
from collections.abc import Callable

import numpy as np

from common.hardware.driven_arm import DrivenArm
from common.hardware.interface import HardwareFault

PERIOD, TIMEOUT = 0.01, 30.0
SWING = 1.6  # [s] there and back: it shows, and few stalls of a machine are in it
FASTEST = 0.2 * np.pi / SWING  # [rad/s] that a joint is swung, halfway there and back
HELD_UP = (  # by a busy machine, reported by either process
    "the driver was held up", "no message from", "set-points ceased to come", "its program has ended")


class Rig:
    """The backend; `rest` are the velocities (dof,) of an arm at rest."""

    def __init__(self, arm: DrivenArm, rest: np.ndarray) -> None:
        self.arm, self.problems, self.rest = arm, [""], rest
        self.measured = rest
        self.target: np.ndarray | None = None  # newest accepted set-point, if none was refused since

    def cycle(self, q: np.ndarray | None, dq: np.ndarray, now: float | None = None) -> str:
        """Do one cycle with present set-points; return "", or why they were refused; without q the arm stays."""
        now = time.monotonic() if now is None else now
        try:
            measured, _ = self.arm.read(now)
            self.measured = measured
            q = q if q is not None else measured if self.target is None else self.target
            self.arm.write(q, dq, now)
            self.target, problem = q, ""
        except HardwareFault as fault:
            self.target, problem = None, str(fault)
        if problem != self.problems[-1]:
            self.problems.append(problem)
        time.sleep(PERIOD)
        return problem

    def until(self, wanted: str) -> str:
        """Stay at rest until a cycle ends with that problem; "" for accepted set-points."""
        end = time.monotonic() + TIMEOUT
        while True:
            problem = self.cycle(None, self.rest)
            if problem == wanted or (wanted and wanted in problem):
                return problem
            assert time.monotonic() < end, f"{wanted!r} did not occur: {self.problems}"

    def wave(self, seconds: float, meanwhile: Callable[[float], None] = lambda t: None) -> str:
        """Swing every joint by 0.2 rad in SWING: return "", or why it ended early; call `meanwhile` in each cycle."""
        q0 = self.arm.read(0.0)[0] if self.target is None else self.target
        began, w = time.monotonic(), 2 * np.pi / SWING
        while (t := time.monotonic() - began) < seconds:
            each = 1 + self.rest
            if problem := self.cycle(q0 + 0.1 * (1 - np.cos(w * t)) * each, FASTEST * np.sin(w * t) * each):
                return problem
            meanwhile(t)
        return ""

    def swing(self, seconds: float, meanwhile: Callable[[float], None] = lambda t: None) -> str:
        """Repeat `wave` until it is not interrupted by a hold-up of this machine."""
        end = time.monotonic() + TIMEOUT
        problem = self.wave(seconds, meanwhile)
        while any(reason in problem for reason in HELD_UP):
            assert time.monotonic() < end, self.problems[-6:]
            self.until("")
            problem = self.wave(seconds, meanwhile)
        return problem

    def until_it_moves(self) -> None:
        """Try until a motion is not interrupted: a lost link may be lost again before it is stable."""
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
