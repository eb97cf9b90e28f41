"""The Modbus backend against the server of the same package."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from types import SimpleNamespace
from typing import Any

import pytest

from common.config import Io, Signal, check
from common.errors import ConfigError, Refused
from common.hardware.signals import IoLost, Unreadable, load_io
from drivers.io.modbus import IoOptions, ModbusIo
from tests.domains import free_port

pytest.importorskip("pymodbus")
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

SIGNALS = {
    "closed": {"input": 3}, "door": {"input": 4}, "gone": {"input": 3, "range": [0, 1]},
    "clamp": {"output": 0}, "start": {"output": 1}, "other": {"output": 9},
    "pressure": {"input": 2, "range": [0, 10], "unit": "bar"}, "valve": {"output": 7, "range": [-1, 1]},
}


@asynccontextmanager
async def server(port: int) -> AsyncIterator[ModbusTcpServer]:
    coils = [SimData(address=0, values=[False] * 2, datatype=DataType.BITS),
             SimData(address=9, values=[True], datatype=DataType.BITS)]
    inputs = [SimData(address=3, values=[True, False], datatype=DataType.BITS)]
    holding = [SimData(address=7, values=[0], datatype=DataType.REGISTERS)]
    registers = [SimData(address=2, values=[32767], datatype=DataType.REGISTERS)]
    made = ModbusTcpServer(SimDevice(id=1, simdata=(coils, inputs, holding, registers)), address=("127.0.0.1", port))
    await made.serve_forever(background=True)
    try:
        yield made
    finally:
        await made.shutdown()


def connection(port: int, **options: Any) -> Any:
    section = {"backend": "modbus", "signals": SIGNALS, "options": {"host": "127.0.0.1", "port": port, **options}}
    return load_io(check(Io, section, "io"), lambda: 0.0)


async def test_all_kinds_are_read_and_outputs_are_set() -> None:
    port = free_port()
    async with server(port):
        io = connection(port)
        await io.connect()
        found = await io.read()
        assert found.pop("gone") == Unreadable("Modbus exception 2: address does not exist")
        assert found.pop("pressure") == pytest.approx(5.0, abs=1e-3)
        assert found == {"closed": True, "door": False, "clamp": False, "start": False, "other": True, "valve": -1.0}
        for name, value in (("clamp", True), ("other", False), ("valve", 1.0)):
            await io.write(name, value)
        now = await io.read()
        assert (now["clamp"], now["start"], now["other"], now["valve"]) == (True, False, False, 1.0)
        await io.close()


async def test_lost_server_is_reported_and_can_be_connected_again() -> None:
    port = free_port()
    io = connection(port)
    with pytest.raises(IoLost, match=rf"no Modbus server answers at 127.0.0.1:{port}"):
        await io.connect()
    async with server(port):
        await io.close()
        await io.connect()
        await io.read()
    with pytest.raises(IoLost):
        await io.read()
    await io.close()
    async with server(port):
        await io.connect()
        assert (await io.read())["closed"] is True
        await io.close()


async def test_refused_output_is_no_loss() -> None:
    port = free_port()
    section = check(Io, {"backend": "modbus", "options": {"host": "127.0.0.1", "port": port}, "signals": {
        "far": {"output": 500}}}, "io")
    async with server(port):
        io = load_io(section, lambda: 0.0)
        await io.connect()
        with pytest.raises(Refused, match="far: Modbus exception 2"):
            await io.write("far", True)
        await io.close()


@pytest.mark.parametrize(("signal", "options", "words"), [
    ({"input": "a"}, {"host": "h"}, "io.signals.s.input: 'a' must be an address from 0 to 65535"),
    ({"input": 1}, {}, "io.options.host: is missing"),
    ({"input": 1}, {"host": "h", "raw": [5, 5]}, "io.options.raw: [5, 5] must be two different numbers"),
    ({"input": 1}, {"host": "h", "hots": "h"}, "io.options.hots: 'h' is not a parameter; choices: device, host"),
])
def test_bad_channels_and_options(signal: dict[str, Any], options: dict[str, Any], words: str) -> None:
    section = check(Io, {"backend": "modbus", "signals": {"s": signal}, "options": options}, "io")
    with pytest.raises(ConfigError) as error:
        load_io(section, lambda: 0.0)
    assert words in str(error.value)


@pytest.mark.parametrize("numbers", [[], [1, 2]])
async def test_answer_of_another_length_is_a_lost_server(numbers: list[int]) -> None:
    class Client:
        async def connect(self) -> bool:
            return True

        async def read_input_registers(self, *address: int, **more: int) -> Any:
            return SimpleNamespace(isError=lambda: False, registers=numbers, bits=[])

    io = ModbusIo({"pressure": Signal(input=2, range=(0, 10))}, IoOptions(host="plc"), Client)
    await io.connect()
    with pytest.raises(IoLost, match=f"plc:502: an answer has {len(numbers)} values instead of 1"):
        await io.read()
