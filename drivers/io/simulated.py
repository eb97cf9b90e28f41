"""Simulated inputs and outputs: inputs follow outputs as the cell file says, in cell time."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable, Iterable, Mapping
from typing import Self

from pydantic import Field, model_validator

from common.config import Parameters, Section, Signal
from common.config.io import Value
from common.errors import ConfigError, UnknownName
from common.hardware.signals import Unreadable
from common.messages import IoState


class Behavior(Section):
    """How an input depends on an output."""

    follows: str = Field("", description="output whose value the input takes `after` its change")
    started_by: str = Field("", description="digital output whose rising edge sets the input for `seconds`")
    after: float = Field(0.0, ge=0, le=3600, description="delay [s]")
    seconds: float = Field(1.0, gt=0, le=86_400, description="duration; a start meanwhile has no effect [s]")
    inverted: bool = Field(False, description="a digital input shows the opposite")

    @model_validator(mode="after")
    def _require_one(self) -> Self:
        if bool(self.follows) == bool(self.started_by):
            raise ValueError("needs one of follows: OUTPUT and started_by: OUTPUT")
        return self


class IoOptions(Parameters):
    """What the inputs do."""

    behaviors: dict[str, Behavior] = Field({}, max_length=256, description="by input")
    initial: dict[str, bool | float] = Field({}, description="values at the start; others are off")


class SimulatedIo:
    """Signals without hardware. Changes happen at their exact time, whenever they are read."""

    def __init__(self, signals: Mapping[str, Signal], options: IoOptions, now: Callable[[], float]) -> None:
        """Start with the initial values.

        Raises:
            ConfigError, UnknownName: a name or value that does not fit the signals.
        """
        self._signals, self._behaviors, self._now = signals, options.behaviors, now
        self._events: list[tuple[float, int, str, Value]] = []  # heap: time [s], order, input, value
        self._order = itertools.count()
        self._expected: set[str] = set()
        inputs = [name for name, signal in signals.items() if not signal.is_output]
        for name, behavior in options.behaviors.items():
            if name not in inputs:
                raise UnknownName("input in io.options.behaviors", name, inputs)
            self._check(name, behavior)
        self._values = {name: signal.off for name, signal in signals.items()}
        for name, value in options.initial.items():
            if name not in signals:
                raise UnknownName("signal in io.options.initial", name, signals)
            self._values[name] = signals[name].checked(f"io.options.initial.{name}", value)
        for name, behavior in options.behaviors.items():
            if behavior.follows:
                self._values[name] = self._followed(name, self._values[behavior.follows])
            elif behavior.inverted:
                self._values[name] = True

    def _check(self, name: str, behavior: Behavior) -> None:
        field, source = f"io.options.behaviors.{name}", behavior.follows or behavior.started_by
        outputs = [each for each, signal in self._signals.items() if signal.is_output]
        if source not in outputs:
            raise UnknownName(f"output in {field}", source, outputs)
        analog = {each: self._signals[each].range is not None for each in (name, source)}
        if analog[name] != analog[source] or (analog[name] and (behavior.started_by or behavior.inverted)):
            raise ConfigError(field, source, "must be as digital or analog as the input, and digital for started_by "
                                             "and inverted")

    def _followed(self, name: str, value: Value) -> Value:
        if (limits := self._signals[name].range) is not None:
            return min(max(float(value), limits[0]), limits[1])
        return bool(value) != self._behaviors[name].inverted

    async def connect(self) -> None:
        """Return at once."""

    async def read(self) -> Mapping[str, Value | Unreadable]:
        """Return all values at the current cell time."""
        self._advance()
        return {**self._values, **dict.fromkeys(self._expected, Unreadable("not yet reported by the simulated world"))}

    def expect(self, names: Iterable[str]) -> None:
        """Leave signals unreadable until the simulated world reports them; one with a behavior follows that."""
        self._expected = set(names) - self._behaviors.keys()

    def sense(self, state: IoState) -> None:
        """Take inputs of the simulated world, and outputs at first."""
        for signal in state.signals:
            known = signal.direction == "output" and signal.name not in self._expected
            if signal.value is not None and not known and signal.name not in self._behaviors:
                self._values[signal.name] = signal.value
            self._expected.discard(signal.name)

    def _advance(self) -> None:
        while self._events and self._events[0][0] <= self._now():
            _, _, name, value = heapq.heappop(self._events)
            self._values[name] = value

    async def write(self, name: str, value: Value) -> None:
        """Set an output; inputs that depend on it change at once or later."""
        self._advance()
        self._expected.discard(name)
        before, self._values[name], now = self._values[name], value, self._now()
        for signal, behavior in self._behaviors.items():
            if behavior.follows == name and value != before:
                self._schedule(now + behavior.after, signal, self._followed(signal, value))
            elif behavior.started_by == name and value and not before and not self._pending(signal):
                self._schedule(now + behavior.after, signal, not behavior.inverted)
                self._schedule(now + behavior.after + behavior.seconds, signal, behavior.inverted)
        self._advance()

    def _pending(self, name: str) -> bool:
        return any(event[2] == name for event in self._events)

    def _schedule(self, at: float, name: str, value: Value) -> None:
        heapq.heappush(self._events, (at, next(self._order), name, value))

    async def close(self) -> None:
        """Return at once."""


def create_io(signals: Mapping[str, Signal], options: IoOptions, now: Callable[[], float]) -> SimulatedIo:
    """Create simulated signals."""
    return SimulatedIo(signals, options, now)
