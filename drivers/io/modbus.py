"""Inputs and outputs of a Modbus TCP server, by `pymodbus` (extra `modbus`).

Digital inputs are discrete inputs, digital outputs coils, analog inputs input registers, analog outputs holding
registers. A register from `raw[0]` to `raw[1]` is the range of its signal.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from pydantic import Field

from common.config import Parameters, Signal
from common.config.io import Value
from common.errors import ConfigError, Refused
from common.hardware.signals import IoLost, Unreadable, channel_error

MOST_BITS, MOST_REGISTERS = 2000, 125  # of one request, by the protocol
TIMEOUT = 0.8  # [s] for an answer: shorter than the service waits for all of them
READS = {  # function by (is output, is analog)
    (False, False): "read_discrete_inputs", (True, False): "read_coils",
    (False, True): "read_input_registers", (True, True): "read_holding_registers",
}


class IoOptions(Parameters):
    """Address of the server, and the numbers in its registers."""

    host: str = Field(min_length=1, description="address of the server")
    port: int = Field(502, ge=1, le=65535, description="port of the server")
    device: int = Field(1, ge=0, le=255, description="unit at this address")
    raw: tuple[int, int] = Field((0, 65535), description="numbers in a register at the ends of a signal's range")


class ModbusIo:
    """A connection to the server. Addresses that follow each other are read with one request."""

    def __init__(self, signals: Mapping[str, Signal], options: IoOptions, client: Callable[[], Any]) -> None:
        """Start without a connection; `client` creates one."""
        self._signals, self._options, self._create = signals, options, client
        self._client: Any = None
        self._blocks = list(_blocks(signals))
        logging.getLogger("pymodbus").setLevel(logging.CRITICAL)  # the service logs a loss, once

    async def connect(self) -> None:
        """Connect to the server."""
        self._client = self._create()
        if not await self._client.connect():
            raise IoLost(f"no Modbus server answers at {self._options.host}:{self._options.port}")

    async def read(self) -> Mapping[str, Value | Unreadable]:
        """Return all signals."""
        found: dict[str, Value | Unreadable] = {}
        for function, first, names in self._blocks:
            answer = await self._request(function, first, count=len(names))
            if not answer.isError():
                found |= self._values(names, answer)
                continue
            for number, name in enumerate(names):  # one of them may be unknown to the server
                single = answer if len(names) == 1 else await self._request(function, first + number, count=1)
                found |= {name: Unreadable(_reason(single))} if single.isError() else self._values([name], single)
        return found

    def _values(self, names: list[str], answer: Any) -> dict[str, Value]:
        limits = self._signals[names[0]].range
        given, most = (answer.bits, len(names) + 7) if limits is None else (answer.registers, len(names))
        if not len(names) <= len(given) <= most:
            raise IoLost(f"{self._options.host}:{self._options.port}: an answer has {len(given)} values instead of "
                         f"{len(names)}")
        if limits is None:
            return dict(zip(names, map(bool, answer.bits), strict=False))  # bits are padded to bytes
        (low, high) = self._options.raw
        found: dict[str, Value] = {}
        for name, number in zip(names, answer.registers, strict=True):
            least, greatest = self._signals[name].range or limits
            found[name] = least + (number - low) / (high - low) * (greatest - least)
        return found

    async def write(self, name: str, value: Value) -> None:
        """Set a coil or a holding register."""
        signal, (low, high) = self._signals[name], self._options.raw
        if signal.range is None:
            answer = await self._request("write_coil", int(signal.channel), bool(value))
        else:
            share = (value - signal.range[0]) / (signal.range[1] - signal.range[0])
            answer = await self._request("write_register", int(signal.channel), round(low + share * (high - low)))
        if answer.isError():
            raise Refused("device", f"{name}: {_reason(answer)}")

    async def _request(self, function: str, *values: int, **more: int) -> Any:
        from pymodbus.exceptions import ModbusException

        try:
            return await getattr(self._client, function)(*values, device_id=self._options.device, **more)
        except ModbusException as error:
            raise IoLost(f"{self._options.host}:{self._options.port}: {error}") from None

    async def close(self) -> None:
        """Close the connection."""
        if self._client is not None:
            self._client.close()
            self._client = None


def _blocks(signals: Mapping[str, Signal]) -> Iterator[tuple[str, int, list[str]]]:
    """Yield function, first address and names of signals that one request reads."""
    for (is_output, is_analog), function in READS.items():
        most = MOST_REGISTERS if is_analog else MOST_BITS
        by_address = {int(signal.channel): name for name, signal in signals.items()
                      if (signal.is_output, signal.range is not None) == (is_output, is_analog)}
        names: list[str] = []
        for address in sorted(by_address):
            names.append(by_address[address])
            if address + 1 not in by_address or len(names) == most:
                yield function, address + 1 - len(names), names
                names = []


def _reason(answer: Any) -> str:
    """Return the exception of an answer in words."""
    texts = {1: "function is not supported", 2: "address does not exist", 3: "value is not accepted",
             4: "device failed", 6: "device is busy"}
    code = getattr(answer, "exception_code", 0)
    return f"Modbus exception {code}: {texts.get(code, 'see the manual of the device')}"


def create_io(signals: Mapping[str, Signal], options: IoOptions, now: Callable[[], float]) -> ModbusIo:
    """Create a connection to a Modbus TCP server."""
    try:
        from pymodbus.client import AsyncModbusTcpClient
    except ImportError:
        raise ConfigError("io.backend", "modbus", "needs the extra `modbus`: pip install 'zencell[modbus]'") from None
    if options.raw[0] == options.raw[1] or not all(0 <= number <= 65535 for number in options.raw):
        raise ConfigError("io.options.raw", list(options.raw), "must be two different numbers from 0 to 65535")
    for name, signal in signals.items():
        if not isinstance(signal.channel, int):
            raise channel_error(name, signal, "must be an address from 0 to 65535")
    return ModbusIo(signals, options, lambda: AsyncModbusTcpClient(
        options.host, port=options.port, timeout=TIMEOUT, retries=0, reconnect_delay=0))
