"""Digital and analog inputs and outputs of a cell by name: the section `io` of a cell file."""

from __future__ import annotations

import math
import re
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from common.config.basics import Number, Section
from common.errors import ConfigError, UnknownName

Value = bool | float
MAX_SIGNALS = 256
SIGNAL_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_.-]{0,63}")


def _name(text: str) -> str:
    if not SIGNAL_NAME.fullmatch(text):
        raise ValueError(f"{text!r} is no name of a signal: a letter, then letters, digits, _, - and .")
    return text


def _switch(value: Any) -> Any:
    """Return the word that YAML has turned into a boolean."""
    return {True: "on", False: "off"}[value] if isinstance(value, bool) else value


def _channel(value: Any) -> Any:
    number = isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= 65535
    if value is not None and not number and not (isinstance(value, str) and 0 < len(value) <= 200):
        raise ValueError(f"{value!r} is no channel: a number from 0 to 65535, or a name of the backend")
    return value


Channel = Annotated[int | str, BeforeValidator(_channel)]


class Signal(Section):
    """One input or output. With a range it is analog, else digital."""

    input: Channel | None = Field(None, description="channel of the backend that is read")
    output: Channel | None = Field(None, description="channel of the backend that is written")
    on_stop: Annotated[Literal["off", "hold"], BeforeValidator(_switch)] = Field(
        "hold", description="what a STOP does to an output: off, or hold its value")
    unit: str = Field("", max_length=20, description="of an analog signal")
    range: tuple[Number, Number] | None = Field(None, description="least and largest value of an analog signal")

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.input is None) == (self.output is None):
            raise ValueError("needs one of input: CHANNEL and output: CHANNEL")
        if self.range is not None and not self.range[0] < self.range[1]:
            raise ValueError(f"range {self.range[0]:g} to {self.range[1]:g} is empty")
        if self.unit and self.range is None:
            raise ValueError(f"unit {self.unit!r} is that of an analog signal: add range: [least, largest]")
        if self.input is not None and "on_stop" in self.model_fields_set:
            raise ValueError("on_stop is for outputs")
        return self

    @property
    def is_output(self) -> bool:
        """Whether it can be set."""
        return self.output is not None

    @property
    def channel(self) -> int | str:
        """Channel of the backend."""
        found = self.output if self.output is not None else self.input
        assert found is not None
        return found

    @property
    def off(self) -> Value:
        """Value of an output that is off: of an analog one 0, or the end of its range next to 0."""
        return False if self.range is None else min(max(0.0, self.range[0]), self.range[1])

    def checked(self, name: str, value: object) -> Value:
        """Return a value for this signal.

        Raises:
            ConfigError: it has another type, or is out of range.
        """
        if self.range is None:
            if value is not True and value is not False:
                raise ConfigError(name, value, "must be true or false: the signal is digital")
            return value
        low, high = self.range
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not number or not low <= float(value) <= high or not math.isfinite(value):  # type: ignore[arg-type]
            unit = f" {self.unit}" if self.unit else ""
            raise ConfigError(name, value, f"must be a number from {low:g} to {high:g}{unit}")
        return float(value)  # type: ignore[arg-type]


class Io(Section):
    """Signals of the cell, and the backend that reads and writes them. Without signals the cell has no I/O."""

    backend: str = Field("simulated", description="a module of drivers/io, or a dotted module of a user")
    options: dict[str, Any] = Field({}, description="of the backend")
    signals: dict[Annotated[str, AfterValidator(_name)], Signal] = Field({}, max_length=MAX_SIGNALS)

    @model_validator(mode="after")
    def _require_single_use(self) -> Self:
        used: dict[tuple[bool, bool, str], str] = {}
        for name, signal in self.signals.items():
            key = signal.is_output, signal.range is None, str(signal.channel)
            if (other := used.setdefault(key, name)) != name:
                what = f"{'digital' if key[1] else 'analog'} {'output' if key[0] else 'input'} {signal.channel}"
                raise ValueError(f"{other} and {name} are both {what}: give one of them another channel")
        return self

    def find(self, name: str, *, output: bool = False) -> Signal:
        """Return a signal; with `output`, one that can be set.

        Raises:
            UnknownName: there is no such signal, or output; with the choices.
        """
        signal = self.signals.get(name)
        if signal is None or (output and not signal.is_output):
            what = "output" if output else "signal"
            raise UnknownName(f"{what} of the cell", name, self.outputs if output else self.signals)
        return signal

    @property
    def outputs(self) -> list[str]:
        """Names of all outputs."""
        return [name for name, signal in self.signals.items() if signal.is_output]
