"""Messages about digital and analog inputs and outputs."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from common.messages.basics import SMALL_BYTES, Finite, Header, Label, Message, Name, OperatorName, Text
from common.messages.execution import Acknowledged, Since

MAX_SIGNALS = 256


class IoSignal(Message):
    """State of one signal. `value` is true or false of a digital signal, a number of an analog one."""

    name: Name
    direction: Literal["input", "output"]
    value: bool | Finite | None = Field(None, description="last value that was read; null before the first one")
    stamp: Since = Field(0, description="cell time at which it had changed to this value [ns since the Unix epoch]")
    reason: Text = Field("", description="why the value may not be true any more; empty while it is good")
    unit: Label = ""
    low: Finite | None = Field(None, description="least value of an analog signal; null: digital")
    high: Finite | None = Field(None, description="largest value of an analog signal; null: digital")


class IoState(Message):
    """All signals of a cell. Published at each change."""

    max_bytes: ClassVar[int] = 128 * 1024

    header: Header = Header()
    backend: Label = ""
    reason: Text = Field("", description="why no signal is read or written; empty while the backend works")
    signals: list[IoSignal] = Field([], max_length=MAX_SIGNALS)

    def find(self, name: str) -> IoSignal | None:
        """Return a signal by name."""
        return next((signal for signal in self.signals if signal.name == name), None)

    def problem(self, name: str) -> str:
        """Return why the value of a signal cannot be used; empty when it can."""
        signal = self.find(name)
        if self.reason or signal is None:
            return self.reason or f"there is no signal {name!r}"
        return signal.reason or ("" if signal.value is not None else f"{name} was not read yet")


class IoSet(Message):
    """Set an output. The stamp of the header is the time of the decision: a late request is refused."""

    max_bytes: ClassVar[int] = SMALL_BYTES

    header: Header = Header()
    id: Label = ""
    signal: Name
    value: bool | Finite
    owner: OperatorName = Field("", description="operator who requests it; empty for a task")
    acknowledged: Acknowledged = Field(
        None, description="`since` of the newest interlock that the operator has seen: later ones block the request")


class IoReply(Message):
    """Reply to a request to set an output: its value after that."""

    max_bytes: ClassVar[int] = SMALL_BYTES

    header: Header = Header()
    id: Label = ""
    signal: Label = ""
    value: bool | Finite | None = None
    error: Label = Field("", description="code of a refusal, for tasks")
    message: Text = ""
