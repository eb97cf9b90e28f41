"""A suction cup whose valve is an output of the cell's I/O, and whose vacuum switch is an input: docs/suction.md."""

from __future__ import annotations

import math

from common.config import GripperConfig
from common.errors import Refused
from common.hardware.interface import Gripper, GripperReading
from common.messages import GripperCommand, IoSet, IoSignal, IoState

LOST = "io_lost"


class VacuumCup:
    """The gripper of a robot file with `gripper.vacuum`: commands set the output, readings come from the input.

    Attributes:
        state: newest state of the I/O; None before the first one, and while its service is gone.
        request: gripper command that the next call of `command` belongs to.
        order: request for the output that was not answered yet, or None.
        refusal: why the output was not set at the last attempt.
        sealed: whether the simulated cup holds an object.
        drawing: whether the simulated valve is open.
    """

    def __init__(self, config: GripperConfig, valve: Gripper | None) -> None:
        """Start with unknown signals; `valve` is that of a simulated cup, which follows the output."""
        assert config.vacuum is not None
        self._config, self._signals, self._valve = config, config.vacuum, valve
        self.state: IoState | None = None
        self.request: GripperCommand | None = None
        self.order: IoSet | None = None
        self.refusal, self.sealed, self.drawing = "", False, False
        self._wanted: bool | None = None  # value of the output by the newest command
        self._on = self._vacuum = False  # newest good values of output and input
        self._came = False  # whether the input was on since the newest command
        self._since = -math.inf  # cell time of the newest command or change of the output [s]
        self._no_seal = ""  # of the simulated cup

    @property
    def problem(self) -> str:
        """Why the signals cannot be used; empty when they can."""
        if self.state is None:
            return "the I/O service does not answer"
        return self.state.problem(self._signals.output) or self.state.problem(self._signals.input)

    @property
    def unwatched(self) -> str:
        """Why a held object cannot be watched; empty when it can, or nothing is held."""
        return f"{self._signals.input} is lost: {self.problem}" if self._vacuum and self.problem else ""

    def check(self) -> Refused | None:
        """Return why the cup cannot be commanded, or None."""
        return Refused(LOST, f"{self._signals.output} cannot be set: {self.problem}") if self.problem else None

    def command(self, width: float, now: float, effort: float) -> None:
        """Switch the output on at a width below half of the largest, else off."""
        wanted, owner, seen = width < self._config.held_width, "", None
        if self.request is not None:
            owner, seen = self.request.owner, self.request.acknowledged
        if self._on is not wanted or self.order is not None:
            self.order = IoSet(signal=self._signals.output, value=wanted, owner=owner, acknowledged=seen)
        self._wanted, self._since, self.refusal, self._came = wanted, now, "", False

    def restore(self, width: float, now: float) -> None:
        """Let the simulated valve continue from the width before a restart [m]."""
        self._on = self.drawing = width <= self._config.held_width
        self._vacuum = self._on and width > 0.0
        self._command_valve(now)

    def sense(self, reading: GripperReading) -> None:
        """Take a reading of the simulated cup."""
        self.sealed, self._no_seal = reading.holding, reading.message

    @property
    def sensed(self) -> list[IoSignal]:
        """The signals as the simulated world determines them."""
        return [IoSignal(name=self._signals.output, direction="output", value=self.drawing),
                IoSignal(name=self._signals.input, direction="input", value=self.sealed)]

    def read(self, now: float) -> GripperReading:
        """Return the state of the cup by the newest signals."""
        if self.state is not None and not self.problem:
            on, vacuum = (self.state.find(name) for name in (self._signals.output, self._signals.input))
            self._take(bool(on and on.value), bool(vacuum and vacuum.value), now)
        missing, late = self._missing(), now - self._since >= self._signals.timeout
        if late:
            self.order = None
        width = self._config.held_width if self._vacuum else 0.0 if self._on else self._config.max_width
        return GripperReading(width, 0.0, bool(missing) and not late, self._vacuum, 0.0,
                              (missing if late else "") or self.unwatched or self._released())

    def _take(self, on: bool, vacuum: bool, now: float) -> None:
        if on is not self._on:
            self._since, self._came = now, False
            if on is not self._wanted and self.order is None:
                self._wanted = None  # another client switched it
        self._on, self._vacuum, self._came = on, vacuum, self._came or vacuum
        if on is not self.drawing:
            self.drawing = on
            self._command_valve(now)

    def _command_valve(self, now: float) -> None:
        if self._valve is not None:
            self._valve.command(0.0 if self.drawing else self._config.max_width, now, self._config.effort)

    def _missing(self) -> str:
        """Return why the signals are not as commanded, once the time for it is over; empty if they are."""
        output, vacuum, limit = self._signals.output, self._signals.input, f"{self._signals.timeout:g} s"
        if self.order is not None or (self._wanted is not None and self._on is not self._wanted):
            return (self.problem or self.refusal
                    or f"{output} did not switch {'on' if self._wanted else 'off'} within {limit}")
        if self._on and not self._vacuum:
            why = f": {self._no_seal}" if self._no_seal else ""
            return f"{vacuum} went off" if self._came else f"{vacuum} did not come within {limit}{why}"
        return f"{vacuum} did not end within {limit}" if self._vacuum and not self._on else ""

    def _released(self) -> str:
        return f"{self._signals.output} is off" if not self._on and self._wanted is not False else ""
