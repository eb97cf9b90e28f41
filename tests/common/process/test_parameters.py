"""Every service serves its parameters, without code of its own."""

import asyncio
from collections.abc import AsyncIterator
from typing import Any

import pytest
from pydantic import Field

from common import topics
from common.config import Motion, Parameters, Tunable
from common.config.tunables import values_of
from common.errors import RemoteError
from common.messages import ParameterRequest
from common.process.in_process import running_service
from common.process.timing import LoopRate
from common.supervision.wiring import wiring
from common.topics import parameters_of
from common.transport.bus import Bus
from common.transport.local import LocalNetwork

TIMEOUT = 20.0


class Config(Parameters):
    motion: Motion
    rate: Tunable[float] = Field(10.0, gt=0, le=1000, description="cycles [Hz]")
    size: Tunable[int] = Field(3, ge=1, le=5)
    file: str = ""


async def service(bus: Bus, config: Config) -> None:
    bus.on_parameters(lambda: bus.log.info("now at %g Hz", config.rate))
    await bus.ready()
    await asyncio.Event().wait()


class Rig:
    def __init__(self) -> None:
        self.net, self.config = LocalNetwork(), Config(motion=Motion())
        bus = self.net.bus("tester")
        self.log, self.client = bus.reader(topics.LOG), bus.client(parameters_of("toy"))

    async def request(self, *, dry_run: bool = False, by: str = "", **values: object) -> dict[str, object]:
        full = {path.replace("__", "."): value for path, value in values.items()}
        reply = await self.client.call(ParameterRequest.model_validate({"set": full, "dry_run": dry_run, "by": by}))
        assert reply.service == "toy"
        return {p.path: p.value for p in reply.parameters}

    async def lines(self, count: int) -> list[str]:
        async with asyncio.timeout(TIMEOUT):
            return [(await self.log.next()).message for _ in range(count)]


@pytest.fixture
async def rig() -> AsyncIterator[Rig]:
    rig = Rig()
    async with running_service(rig.net, service, rig.config, name="toy"):
        yield rig


async def test_change_is_applied_logged_with_its_operator_and_reported_to_the_service(rig: Rig) -> None:
    assert await rig.request() == values_of(rig.config, "toy"), "an empty request returns all values"
    values = await rig.request(services__toy__rate=20, motion__velocity_scaling=0.5, by="ann@desk/7")
    assert (values["services.toy.rate"], values["motion.velocity_scaling"]) == (20.0, 0.5)
    assert (rig.config.rate, rig.config.motion.velocity_scaling) == (20.0, 0.5)
    lines = await rig.lines(3)
    assert sorted(lines[:2]) == ["motion.velocity_scaling: 0.2 -> 0.5 (by ann@desk/7)",
                                 "services.toy.rate: 10.0 -> 20.0 (by ann@desk/7)"]
    assert lines[2] == "now at 20 Hz"


async def test_dry_run_and_unchanged_value_change_and_log_nothing(rig: Rig) -> None:
    assert (await rig.request(services__toy__rate=20, dry_run=True))["services.toy.rate"] == 10.0
    await rig.request(services__toy__rate=10)
    await rig.request(services__toy__size=4)
    assert await rig.lines(2) == ["services.toy.size: 3 -> 4 (by unknown operator)", "now at 10 Hz"]


@pytest.mark.parametrize("values", [
    {"services__toy__size": 6, "dry_run": True}, {"services__toy__rate": 20, "services__toy__size": 9},
    *({"services__toy__rate": value} for value in (float("inf"), None, [1], {"a": 1})),
])
async def test_invalid_value_is_refused_and_leaves_all_values_unchanged(rig: Rig, values: dict[str, Any]) -> None:
    before = await rig.request()
    with pytest.raises(RemoteError, match=r"services.toy.(size|rate): ") as refused:
        await rig.request(**values)
    assert refused.value.code == "bad_value"
    assert await rig.request() == before


async def test_wiring_of_a_service_omits_its_parameter_request() -> None:
    assert parameters_of("toy") not in (await wiring(service, Config(motion=Motion()))).serves


async def test_waiting_rate_wakes_when_it_is_raised() -> None:
    rate = 1e-6
    bus = LocalNetwork().bus("toy")
    loop_rate = LoopRate(bus, lambda: rate)
    waiting = asyncio.create_task(loop_rate.wait())
    await asyncio.sleep(0)
    bus.parameters_changed()  # of another parameter
    await asyncio.sleep(0)
    assert not waiting.done()
    rate = 1000.0
    bus.parameters_changed()
    async with asyncio.timeout(TIMEOUT):
        await waiting


async def test_cycles_lie_on_a_grid_and_missed_ones_are_skipped() -> None:
    loop = asyncio.get_running_loop()
    loop_rate = LoopRate(LocalNetwork().bus("toy"), lambda: 1000.0)
    await loop_rate.wait()
    first = loop_rate.due
    for _ in range(5):
        await asyncio.sleep(0.0035)  # more than three cycles
        await loop_rate.wait()
        assert loop_rate.due <= loop.time()
        cycles = (loop_rate.due - first) * 1000.0
        assert cycles == pytest.approx(round(cycles), abs=1e-3) and cycles > 3
        first = loop_rate.due
