from __future__ import annotations

import asyncio
import math
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import pytest

from common import messages as m
from common import topics
from common.client.cell import Cell
from common.client.io import SignalTimeout, parse_value
from common.clock import Clock
from common.config import Io, Parameters, check
from common.errors import ConfigError, NoResponder, RemoteError, UnknownName, ZencellError
from common.hardware.signals import load_io
from common.process.in_process import running_service
from services import io
from tests.doubles.lossy_io import BROKEN, Server
from tests.services.fake_cell import FakeCell, latest, until

SIGNALS: dict[str, Any] = {
    "clamp": {"output": 0}, "start": {"output": 1, "on_stop": False},  # YAML reads `off` as false
    "closed": {"input": 0}, "busy": {"input": 1}, "pressure": {"input": 2, "range": [0, 10], "unit": "bar"},
    "valve": {"output": 2, "range": [1, 5], "on_stop": "off"},
}
BEHAVIORS = {"closed": {"follows": "clamp", "after": 0.2}, "busy": {"started_by": "start", "seconds": 0.4}}


class Signals(FakeCell):
    """The service with the neighbours that it reads."""

    def __init__(self) -> None:
        super().__init__(Clock(5.0))
        self.states = self.reader(topics.IO_STATE)
        self.client_cell = Cell.on(self.bus, owner="me")
        self.io = self.client_cell.io
        self.release()

    def release(self) -> None:
        self.put(topics.MOTION_STATUS, m.MotionStatus(header=self.bus.header()))
        self.put(topics.MOTION_OWNER, m.MotionOwner())

    def stop(self, by: str = "you") -> None:
        self.put(topics.MOTION_STATUS, m.MotionStatus(header=self.bus.header(), interlocks=[
            m.Interlock(kind="stopped", by=by, since=self.bus.clock.now_ns())]))

    async def until(self, **values: Any) -> m.IoState:
        def there(state: m.IoState) -> bool:
            return not state.reason and all(state.find(name).value == value for name, value in values.items())
        state: m.IoState = await latest(self.states, there)
        return state


@asynccontextmanager
async def cell(backend: str = "simulated", **options: Any) -> AsyncIterator[Signals]:
    fake = Signals()
    section = check(Io, {"backend": backend, "options": options, "signals": SIGNALS}, "io")
    config = io.Config(io=section, rate=100.0, reopen_after=0.02)
    async with fake.running(io, config), fake.client_cell:
        await fake.until()
        yield fake


async def test_input_follows_an_output_and_a_pulse_starts_a_machine() -> None:
    async with cell(behaviors=BEHAVIORS, initial={"pressure": 6}) as fake:
        assert (await fake.io.read("closed"), await fake.io.read("pressure")) == (False, 6.0)
        began = fake.bus.clock.now()
        assert (await fake.io.set("clamp")).value is True
        assert await fake.io.wait("closed") is True and await fake.io.read("closed") is True
        assert fake.bus.clock.now() - began >= 0.2
        started = fake.bus.clock.now_ns()
        await fake.io.set("start", True)
        await fake.io.set("start", False)
        assert await fake.io.wait("busy", False) is False
        pulse = (await fake.io.state()).find("busy").stamp - started
        assert pulse >= 400_000_000, "its last change is the end of the pulse"
        assert await fake.io.wait("pressure", above=5.0, below=7.0) == 6.0
        with pytest.raises(SignalTimeout, match=r"pressure >= 8 was not seen within 0\.05 s"):
            await fake.io.wait("pressure", above=8.0, timeout=0.05)
        state = await fake.io.state()
        assert state.find("clamp").stamp > began * 1e9 and not any(each.reason for each in state.signals)


@pytest.mark.parametrize(("name", "value", "error", "words"), [
    ("clmap", True, UnknownName, "unknown output of the cell 'clmap' (did you mean 'clamp'?); choices: clamp, start"),
    ("closed", True, UnknownName, "choices: clamp, start, valve"),
    ("clamp", 1, ConfigError, "clamp: 1 must be true or false: the signal is digital"),
    ("valve", 5.5, ConfigError, "valve: 5.5 must be a number from 1 to 5"),
    ("valve", True, ConfigError, "valve: True must be a number from 1 to 5"),
    ("valve", float("nan"), ConfigError, "valve: nan must be a number from 1 to 5"),
])
async def test_bad_request_is_refused_by_client_and_service(name: str, value: Any, error: Any, words: str) -> None:
    async with cell() as fake:
        with pytest.raises(error) as found:
            await fake.io.set(name, value)
        assert words in str(found.value) and "\n" not in str(found.value)
        if not math.isnan(value):  # a message holds none
            with pytest.raises(RemoteError) as remote:
                await fake.client_cell.call(topics.IO_SET, {"signal": name, "value": value})
            assert remote.value.code in ("unknown_output", "bad_value")


async def test_other_owner_and_stop_block_outputs_and_the_stop_switches_those_configured_off() -> None:
    async with cell() as fake:
        for name, value in (("clamp", True), ("start", True), ("valve", 3.0)):
            await fake.io.set(name, value)
        fake.put(topics.MOTION_OWNER, m.MotionOwner(owner="you", kind="operator", asked=True))
        with pytest.raises(RemoteError, match="owned by you") as refused:
            await again_until_refused(fake, "clamp")
        assert refused.value.code == "not_owner"
        fake.release()
        fake.stop()
        await fake.until(clamp=True, start=False, valve=1.0)
        with pytest.raises(RemoteError) as refused:
            await fake.io.set("start", True)
        assert refused.value.code == "stopped"
        fake.release()
        await asyncio.sleep(0.05)
        assert (await fake.io.state()).find("start").value is False, "a release switches nothing"
        with pytest.raises(RemoteError, match="at most 2 s"):
            await fake.client_cell.call(topics.IO_SET, {"header": {"stamp": 1, "frame_id": ""}, "signal": "clamp",
                                                        "value": True, "owner": "me"})
        await fake.io.set("start", True)
        fake.stop("me")
        await fake.until(start=False)
        assert (await fake.io.set("start", True)).value is True, "an own stop that is known does not block"


async def again_until_refused(fake: Signals, name: str) -> None:
    for _ in range(50):
        await fake.io.set(name, True)
        await asyncio.sleep(0.01)


async def test_lost_server_is_a_state_with_a_reason_and_nothing_is_written_when_it_is_back() -> None:
    Server.restart(clamp=True, start=True, closed=True, busy=False, pressure=BROKEN, valve=1.0)
    async with cell("tests.doubles.lossy_io") as fake:
        state = await fake.until(clamp=True)
        assert (state.problem("pressure"), state.problem("closed")) == ("sensor is unplugged", "")
        with pytest.raises(ZencellError, match="pressure: sensor is unplugged"):
            await fake.io.read("pressure")
        Server.down = "connection refused"
        lost = await until(fake.states, lambda state: state.reason)
        assert (lost.reason, lost.find("closed").value) == ("connection refused", True)
        with pytest.raises(RemoteError, match="connection refused") as refused:
            await fake.io.set("clamp", False)
        assert refused.value.code == "io_lost"
        with pytest.raises(SignalTimeout, match="connection refused"):
            await fake.io.wait("closed", False, timeout=0.05)
        waiting = asyncio.create_task(fake.io.wait("closed", False))
        Server.values["closed"], Server.values["clamp"], Server.down = False, False, ""
        assert await waiting is False
        assert Server.writes == []
        assert (await fake.until(clamp=False)).reason == ""


@pytest.mark.parametrize(("reading", "reason"), [
    (10.1, ""), (-0.1, ""), (164.0, "164 is not within 0 to 10 bar"), (math.nan, "nan is not within 0 to 10 bar"),
])
async def test_analog_value_far_out_of_its_range_is_not_good(reading: float, reason: str) -> None:
    Server.restart(clamp=True, start=True, closed=True, busy=False, pressure=1.0, valve=1.0)
    async with cell("tests.doubles.lossy_io") as fake:
        await fake.until(pressure=1.0)
        Server.values["pressure"] = reading
        def read(state: m.IoState) -> bool:
            return state.find("pressure").value == reading or bool(state.problem("pressure"))
        state = await until(fake.states, read)
        assert state.problem("pressure") == reason


async def test_stop_while_the_server_is_lost_switches_outputs_once_it_is_back() -> None:
    Server.restart(clamp=True, start=True, closed=True, busy=False, pressure=1.0, valve=1.0)
    async with cell("tests.doubles.lossy_io") as fake:
        Server.down = "no route to host"
        await until(fake.states, lambda state: state.reason)
        fake.stop()
        await asyncio.sleep(0.05)
        Server.refused = {"start"}
        Server.down = ""
        await until(fake.states, lambda state: not state.reason)
        Server.refused = set()
        await fake.until(start=False)
        assert Server.writes == [("start", False)]


async def test_cell_without_signals_has_no_service_and_a_client_gets_an_error() -> None:
    fake = FakeCell()
    with pytest.raises(ConfigError, match=r"io\.signals: is missing"):
        async with running_service(fake.net, io.run, io.Config(), name="io", clock=fake.clock):
            pass
    async with Cell.on(fake.bus) as joined:
        with pytest.raises(NoResponder):
            await joined.io.state()


@pytest.mark.parametrize(("section", "words"), [
    ({"signals": {"a": {}}}, "io.signals.a: needs one of input: CHANNEL and output: CHANNEL"),
    ({"signals": {"a": {"input": 1, "output": 1}}}, "io.signals.a: needs one of"),
    ({"signals": {"a": {"input": 1}, "b": {"input": 1}}}, "io: a and b are both digital input 1"),
    ({"signals": {"a": {"input": -1}}}, "io.signals.a.input: -1 is no channel"),
    ({"signals": {"a": {"input": True}}}, "io.signals.a.input: True is no channel"),
    ({"signals": {"a": {"input": 1, "on_stop": "off"}}}, "io.signals.a: on_stop is for outputs"),
    ({"signals": {"a": {"output": 1, "on_stop": "drop"}}}, "io.signals.a.on_stop: 'drop' must be 'off' or 'hold'"),
    ({"signals": {"a": {"output": 1, "unit": "bar"}}}, "is that of an analog signal"),
    ({"signals": {"a": {"output": 1, "range": [1, 1]}}}, "range 1 to 1 is empty"),
    ({"signals": {"a b": {"output": 1}}}, "'a b' is no name of a signal"),
    ({"signls": {}}, "io.signls: {} is not a parameter; choices: backend, options, signals"),
    ({"backend": "modbas"}, "unknown I/O backend 'modbas'"),
    ({"backend": "common.clock"}, "io.backend: 'common.clock' is no I/O backend: it has no IoOptions, create_io"),
    ({"signals": SIGNALS, "options": {"behaviors": {"clozed": {"follows": "clamp"}}}}, "did you mean 'closed'?"),
    ({"signals": SIGNALS, "options": {"behaviors": {"closed": {"follows": "busy"}}}}, "unknown output"),
    ({"signals": SIGNALS, "options": {"behaviors": {"closed": {"follows": "valve"}}}}, "as digital or analog"),
    ({"signals": SIGNALS, "options": {"behaviors": {"closed": {}}}}, "needs one of follows"),
    ({"signals": SIGNALS, "options": {"initial": {"pressure": 11}}}, "io.options.initial.pressure: 11"),
])
def test_bad_section_is_one_line_that_names_field_and_choices(section: dict[str, Any], words: str) -> None:
    class Only(Parameters):
        io: Io = Io()

    with pytest.raises(ZencellError) as error:
        load_io(check(Only, {"io": section}).io, lambda: 0.0)
    assert words in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(("backend", "module", "options"), [
    ("modbus", "pymodbus.client", {"host": "h"}), ("opcua", "asyncua.ua", {"url": "opc.tcp://h"}),
    ("ur", "rtde_io", {"host": "h"}),
])
def test_missing_package_is_named_with_its_extra(
    monkeypatch: pytest.MonkeyPatch, backend: str, module: str, options: dict[str, Any]
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ConfigError, match=rf"io.backend: '{backend}' needs the extra `{backend}`: pip install"):
        load_io(check(Io, {"backend": backend, "options": options}, "io"), lambda: 0.0)


def test_values_are_parsed() -> None:
    assert [parse_value("a", text) for text in ("on", "OFF", "true", "2.5")] == [True, False, True, 2.5]
    with pytest.raises(ConfigError, match="a: 'up' must be on, off or a number"):
        parse_value("a", "up")
