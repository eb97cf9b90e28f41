"""Inputs and outputs of a controller of Universal Robots, by `ur_rtde` (extra `ur`): standard, configurable, tool.

It connects on its own, next to the driver of the arm. Channels: 0 to 7 (standard), configurable:0 to 7, tool:0 to 1;
analog 0 and 1.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from typing import Any, Literal

from pydantic import Field

from common.config import Parameters, Signal
from common.config.io import Value
from common.errors import ConfigError, Refused
from common.hardware.signals import IoLost, Unreadable, channel_error
from common.time_source import monotonic

PORT = 30004  # of RTDE
RATE = 50.0  # [Hz] of the states of the controller
STALE = 0.5  # [s] without a new state, after which the controller counts as lost
SETTLE, POLL = 0.4, 0.01  # [s] until an output has to be in a state, and between two looks
VARIABLES = ["timestamp", "actual_digital_input_bits", "actual_digital_output_bits", "standard_analog_input0",
             "standard_analog_input1", "standard_analog_output0", "standard_analog_output1"]
BANKS = {"standard": (0, 8), "configurable": (8, 8), "tool": (16, 2)}  # first bit, and number of channels
DIGITAL = "must be 0 to 7, configurable:0 to configurable:7, tool:0 or tool:1"
SPANS = {"voltage": (0.0, 10.0), "current": (0.004, 0.02)}  # [V], [A] at the ends of a signal's range
CLOSE = 0.01  # share of the range by which an analog output may differ from its set value
Span = Literal["voltage", "current"]


class IoOptions(Parameters):
    """Address of the controller, and the kind of its analog channels."""

    host: str = Field(min_length=1, description="address of the controller")
    inputs: Span = Field("voltage", description="analog inputs: 0 to 10 V, or 4 to 20 mA")
    outputs: Span = Field("voltage", description="analog outputs: 0 to 10 V, or 4 to 20 mA")


class UrIo:
    """Two connections to a controller: one with its states, one that sets outputs."""

    def __init__(self, signals: Mapping[str, Signal], options: IoOptions) -> None:
        """Start without connections."""
        self._signals, self._options = signals, options
        self._receive: Any = None
        self._outputs: Any = None
        self._stamp, self._since = -1.0, 0.0

    async def connect(self) -> None:
        """Connect; the library itself would wait for an absent controller without end."""
        host = self._options.host
        try:
            _, writer = await asyncio.open_connection(host, PORT)
            writer.close()
            await writer.wait_closed()
            await asyncio.to_thread(self._connect)
        except (OSError, RuntimeError) as error:  # the library raises RuntimeError
            raise IoLost(f"{host}:{PORT}: {str(error).strip().splitlines()[0] if str(error).strip() else error!r}"
                         ) from None
        self._stamp, self._since = -1.0, monotonic()

    def _connect(self) -> None:
        import rtde_io
        import rtde_receive

        self._receive = rtde_receive.RTDEReceiveInterface(self._options.host, RATE, VARIABLES)
        self._outputs = rtde_io.RTDEIOInterface(self._options.host)

    async def read(self) -> Mapping[str, Value | Unreadable]:
        """Return all signals of the newest state."""
        self._require_new_state()
        return {name: self._value(signal) for name, signal in self._signals.items()}

    def _require_new_state(self) -> None:
        stamp, now = self._receive.getTimestamp(), monotonic()
        if stamp != self._stamp:
            self._stamp, self._since = stamp, now
        if not self._receive.isConnected() or now - self._since > STALE:
            raise IoLost(f"no message from the controller {self._options.host} for {now - self._since:.1f} s")

    def _value(self, signal: Signal) -> Value:
        receive, out = self._receive, signal.is_output
        if signal.range is None:
            bank, number = channel_of(signal.channel)
            bits = receive.getActualDigitalOutputBits() if out else receive.getActualDigitalInputBits()
            return bool(bits >> (BANKS[bank][0] + number) & 1)
        read = getattr(receive, f"getStandardAnalog{'Output' if out else 'Input'}{signal.channel}")
        low, high = SPANS[self._options.outputs if out else self._options.inputs]
        share = min(max((float(read()) - low) / (high - low), 0.0), 1.0)
        return signal.range[0] + share * (signal.range[1] - signal.range[0])

    async def write(self, name: str, value: Value) -> None:
        """Set an output, and wait until the controller reports it."""
        signal = self._signals[name]
        if not self._outputs.isConnected():
            raise IoLost(f"the connection to {self._options.host} that sets outputs is lost")
        if not await asyncio.to_thread(self._send, signal, value):
            raise Refused("device", f"{name}: the controller does not set it")
        end = monotonic() + SETTLE
        while not self._shows(signal, value):
            if monotonic() > end:
                raise Refused("device", f"{name}: the controller still reports another value after {SETTLE:g} s")
            await asyncio.sleep(POLL)
            self._require_new_state()

    def _send(self, signal: Signal, value: Value) -> bool:
        if signal.range is None:
            bank, number = channel_of(signal.channel)
            return bool(getattr(self._outputs, f"set{bank.capitalize()}DigitalOut")(number, bool(value)))
        share = (value - signal.range[0]) / (signal.range[1] - signal.range[0])
        return bool(getattr(self._outputs, f"setAnalogOutput{self._options.outputs.capitalize()}")(
            int(signal.channel), share))

    def _shows(self, signal: Signal, value: Value) -> bool:
        if signal.range is None:
            return self._value(signal) == value
        return abs(self._value(signal) - value) <= CLOSE * (signal.range[1] - signal.range[0])

    async def close(self) -> None:
        """Close both connections; outputs stay as they are."""
        for connection in (self._receive, self._outputs):
            if connection is not None:
                await asyncio.to_thread(connection.disconnect)
        self._receive = self._outputs = None


def channel_of(channel: int | str) -> tuple[str, int]:
    """Return bank and number of a digital channel.

    Raises:
        ValueError: there is no such channel.
    """
    bank, _, number = str(channel).rpartition(":")
    bank = bank or "standard"
    if bank not in BANKS or not number.isdecimal() or int(number) >= BANKS[bank][1]:
        raise ValueError(channel)
    return bank, int(number)


def create_io(signals: Mapping[str, Signal], options: IoOptions, now: Callable[[], float]) -> UrIo:
    """Create the connections to a controller."""
    try:
        import rtde_io  # noqa: F401
    except ImportError:
        raise ConfigError("io.backend", "ur", "needs the extra `ur`: pip install 'zencell[ur]'") from None
    for name, signal in signals.items():
        if signal.range is not None:
            if signal.channel not in (0, 1):
                raise channel_error(name, signal, "must be 0 or 1: the controller has two analog channels")
            continue
        try:
            channel_of(signal.channel)
        except ValueError:
            raise channel_error(name, signal, DIGITAL) from None
    return UrIo(signals, options)
