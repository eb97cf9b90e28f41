"""Inputs and outputs of a controller of Universal Robots, over its protocol."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from common.config import Io, check
from common.errors import ConfigError
from common.hardware.signals import IoLost, load_io
from tests.doubles.ur_host import UrHost

pytest.importorskip("rtde_io", reason="make setup EXTRAS=ur")

SIGNALS: dict[str, Any] = {
    "part": {"input": 3}, "door": {"input": "configurable:1"}, "button": {"input": "tool:0"},
    "clamp": {"output": 0}, "lamp": {"output": "configurable:7"}, "blow": {"output": "tool:1"},
    "pressure": {"input": 1, "range": [0, 6], "unit": "bar"}, "valve": {"output": 0, "range": [-1, 1]},
}


def connection(host: str, signals: dict[str, Any] = SIGNALS, **options: Any) -> Any:
    section = check(Io, {"backend": "ur", "options": {"host": host, **options}, "signals": signals}, "io")
    return load_io(section, lambda: 0.0)


async def test_all_banks_are_read_and_set_and_a_silent_controller_is_lost() -> None:
    with UrHost("127.0.0.43") as host:
        io = connection(host.host)
        await io.connect()
        for order in ("input 3 1", "input 9 1", "input 16 1", "analog 1 5"):
            host.command(order)
        async with asyncio.timeout(20):
            while (found := await io.read())["pressure"] != pytest.approx(3.0):  # noqa: ASYNC110 - the last order
                await asyncio.sleep(0.01)
        assert found == {"part": True, "door": True, "button": True, "clamp": False, "lamp": False, "blow": False,
                         "pressure": pytest.approx(3.0), "valve": pytest.approx(-1.0)}
        for name, value in (("clamp", True), ("lamp", True), ("blow", True), ("valve", 0.5)):
            await io.write(name, value)
            assert (await io.read())[name] == pytest.approx(value, abs=0.02)
        await io.write("clamp", False)
        found = await io.read()
        assert (found["clamp"], found["lamp"], found["blow"]) == (False, True, True)
        host.command("pull 1.2")
        with pytest.raises(IoLost, match=r"no message from the controller 127\.0\.0\.43"):
            for _ in range(100):
                await asyncio.sleep(0.02)
                await io.read()
        await io.close()
        await asyncio.sleep(1.0)
        await io.connect()
        assert (await io.read())["lamp"] is True
        await io.close()


async def test_absent_controller_is_lost_at_once() -> None:
    with pytest.raises(IoLost, match=r"127\.0\.0\.44:30004"):
        await connection("127.0.0.44").connect()


@pytest.mark.parametrize(("signal", "words"), [
    ({"input": 8}, "io.signals.s.input: 8 must be 0 to 7, configurable:0"),
    ({"output": "tool:2"}, "io.signals.s.output: 'tool:2' must be 0 to 7"),
    ({"output": "flange:0"}, "'flange:0' must be"),
    ({"input": 2, "range": [0, 1]}, "2 must be 0 or 1: the controller has two analog channels"),
])
def test_channel_that_the_controller_does_not_have(signal: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError) as error:
        connection("h", {"s": signal})
    assert words in str(error.value)
