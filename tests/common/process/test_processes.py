"""Real processes: every way in which a service or router ends, and what other processes observe."""

import argparse
import asyncio
import json
import signal
import subprocess
import uuid
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import psutil
import pytest

from applications.pick_place.topics import PICK_PLACE_STATUS
from common import topics
from common.errors import NoResponder, NoRouter, RequestLost, RequestTimeout, ZencellError
from common.messages import TaskCommand
from common.process.service import add_options, prepare
from common.transport.bus import Bus, Client
from common.transport.endpoint import endpoint_of, port_of
from common.transport.router import PortInUse, open_router
from common.transport.zenoh_session import connect
from tests.common.process.toy import Config
from tests.common.transport.conftest import TIMEOUT, Processes, until
from tests.harness import freeze, wait_router

CELL = str(Path(__file__).with_name("toy_cell.yaml"))
START, HOLD = TaskCommand(command="start"), TaskCommand(command="pause")
Process = subprocess.Popen[bytes]


class Stage(Processes):
    """Toys in a cell of their own, at a router that is shared or their own."""

    def __init__(self, folder: Path, endpoint: str) -> None:
        super().__init__(folder)
        self.endpoint = endpoint
        self.port = int(endpoint.rpartition(":")[2])
        self.domain = self.port - port_of(0)
        self.cell = f"toy_{uuid.uuid4().hex[:8]}"

    async def router(self) -> Process:
        process = self.start("services.router", "--domain", str(self.domain))
        await wait_router(self.endpoint, TIMEOUT)
        return process

    def toy(self, *arguments: str, mode: str = "serve", cell: str = "") -> Process:
        cell = f"cell={cell or self.cell}"
        return self.start("tests.common.process.toy", "--cell", CELL, "--connect", self.endpoint,
                          "--set", cell, "--set", f"services.toy.mode={mode}", *arguments)

    async def ended(self, process: Process) -> int:
        return await asyncio.to_thread(process.wait, TIMEOUT)

    async def connected(self, process: Process) -> None:
        """Return when a process has a link to the router, before it logs anything."""

        def linked() -> bool:
            links = psutil.Process(process.pid).net_connections("tcp")
            return self.port in [link.raddr.port for link in links if link.status == psutil.CONN_ESTABLISHED]

        await until(linked)

    async def holding(self, client: Client, toy: Process) -> asyncio.Task:
        """Return a call that the toy has received and does not answer."""
        waiting = asyncio.create_task(client.call(HOLD, timeout=TIMEOUT))
        await self.printed(toy, "holding")
        return waiting


@pytest.fixture
def stage(tmp_path: Path, domain: int) -> Iterator[Stage]:
    """Without a router yet."""
    stage = Stage(tmp_path, endpoint_of(domain))
    yield stage
    stage.end()


@pytest.fixture
def shared(tmp_path: Path, shared_router: str) -> Iterator[Stage]:
    stage = Stage(tmp_path, shared_router)
    yield stage
    stage.end()


@pytest.fixture
async def bus(shared: Stage) -> AsyncIterator[Bus]:
    async with connect(cell=shared.cell, service="tester", endpoint=shared.endpoint, timeout=TIMEOUT) as bus:
        yield bus


async def available(bus: Bus) -> Client:
    client = bus.client(topics.TASK_COMMAND)
    await client.wait_available(TIMEOUT)
    return client


# --- results of a request -----------------------------------------------------------------------------------------


@pytest.mark.slow
async def test_frozen_or_killed_server_loses_requests_until_it_resumes(shared: Stage, bus: Bus) -> None:
    toy = shared.toy()
    client = await available(bus)
    freeze(toy)
    with pytest.raises(RequestTimeout):
        await client.call(START, timeout=0.2)
    with pytest.raises(RequestLost):  # its lease expires during the call
        await client.call(START, timeout=TIMEOUT)
    await until(lambda: not client.available)
    with pytest.raises(NoResponder):
        await client.call(START, timeout=TIMEOUT)
    toy.send_signal(signal.SIGCONT)
    await client.wait_available(TIMEOUT)
    assert (await client.call(START)).stage == "7"
    waiting = await shared.holding(client, toy)
    toy.kill()
    with pytest.raises(RequestLost):
        await waiting
    await until(lambda: not client.available)
    with pytest.raises(NoResponder):
        await client.call(START)


@pytest.mark.slow
async def test_frozen_router_loses_the_request(stage: Stage) -> None:
    router = await stage.router()
    async with connect(cell=stage.cell, service="tester", endpoint=stage.endpoint, timeout=TIMEOUT) as bus:
        toy = stage.toy()
        client = await available(bus)
        waiting = await stage.holding(client, toy)
        freeze(router)
        with pytest.raises(RequestTimeout):
            await client.call(START, timeout=0.1)
        with pytest.raises(RequestLost):
            await waiting


async def test_killed_router_loses_the_request_and_all_recovers_when_it_restarts(stage: Stage) -> None:
    router = await stage.router()
    async with connect(cell=stage.cell, service="tester", endpoint=stage.endpoint, timeout=TIMEOUT) as bus:
        toy = stage.toy()
        client = await available(bus)
        reader, key = bus.reader(PICK_PLACE_STATUS), f"{stage.cell}/pick_place_status"
        await asyncio.wait_for(reader.next(), TIMEOUT)
        await bus.alive.wait("toy", TIMEOUT)
        waiting = await stage.holding(client, toy)
        router.kill()
        with pytest.raises(RequestLost):
            await waiting
        await until(lambda: not client.available)
        with pytest.raises(NoResponder):
            await client.call(START)
        await bus.alive.wait("toy", TIMEOUT, there=False)
        await stage.printed(toy, "the router is lost")
        await stage.ended(router)
        await stage.router()
        await bus.alive.wait("toy", TIMEOUT)
        await client.wait_available(TIMEOUT)
        async with asyncio.timeout(TIMEOUT):
            async for sample in bus.raw_reader(key):  # the state is repeated
                assert sample.payload
                break
        assert reader.received == 1
        assert [sample.key for sample in await bus.raw_get(key, TIMEOUT)] == [key]
        assert (await client.call(START)).stage == "7"
        toy.send_signal(signal.SIGTERM)
        assert await stage.ended(toy) == 0


# --- a signal ends a service in every state -----------------------------------------------------------------------


async def reach(stage: Stage, state: str) -> list[Process]:
    """Return two toys in that state, one for each signal."""
    mode = state if state in ("busy", "stubborn") else "serve"
    gate = ["--gate"] if state == "gated" else []
    cells = [f"{state.replace(' ', '_')}_{number}" for number in range(2)]  # a cell admits only one of a name
    toys = [stage.toy(*gate, mode=mode, cell=cell) for cell in cells]
    for toy in toys:
        if state == "gated":
            await stage.connected(toy)
        else:
            await stage.printed(toy, "no router at" if state == "connecting" else "is ready")
    return toys


SLOW_STATES = ("connecting",), ("gated", "busy"), ("router dead",), ("router frozen",)


@pytest.mark.parametrize("states", [
    ("running", "stubborn"), *(pytest.param(states, marks=pytest.mark.slow) for states in SLOW_STATES)],
    ids=" and ".join)
async def test_sigint_and_sigterm_end_a_service_with_exit_code_0_in_every_state(stage: Stage, states) -> None:
    router = await stage.router() if states != ("connecting",) else None
    pairs = await asyncio.gather(*(reach(stage, state) for state in states))
    if states == ("router dead",):
        router.kill()
        await asyncio.gather(*(stage.printed(toy, "the router is lost") for toy in pairs[0]))
    if states == ("router frozen",):
        freeze(router)
    for interrupted, terminated in pairs:
        interrupted.send_signal(signal.SIGINT)
        interrupted.send_signal(signal.SIGINT)  # a second one changes nothing
        terminated.send_signal(signal.SIGTERM)
    for toy in (toy for pair in pairs for toy in pair):
        assert await stage.ended(toy) == 0
        assert "Traceback" not in stage.output(toy)


async def test_token_exists_from_the_opening_of_the_gate_to_the_end(shared: Stage, bus: Bus) -> None:
    toy = shared.toy("--gate")
    await shared.connected(toy)
    assert "toy" not in await bus.alive.known()
    toy.stdin.write(b"go\n")
    toy.stdin.flush()
    await bus.alive.wait("toy", TIMEOUT)
    toy.stdin.close()
    assert await shared.ended(toy) == 0
    await bus.alive.wait("toy", TIMEOUT, there=False)
    assert "the supervisor is gone" in shared.output(toy)
    again = shared.toy()
    await bus.alive.wait("toy", TIMEOUT)
    again.send_signal(signal.SIGTERM)
    await bus.alive.wait("toy", TIMEOUT, there=False)
    assert await shared.ended(again) == 0
    assert "stopped: SIGTERM" in shared.output(again)


@pytest.mark.slow
async def test_router_ends_on_signals_and_with_its_supervisor(stage: Stage) -> None:
    for end in (signal.SIGINT, signal.SIGTERM, None):
        router = stage.start("services.router", "--domain", str(stage.domain), "--gate")
        router.stdin.write(b"\n")
        router.stdin.flush()
        await stage.printed(router, "listening at")
        if end is None:
            router.stdin.close()
        else:
            router.send_signal(end)
        assert await stage.ended(router) == 0


# --- bad starts ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("arguments", "reason"), [
    (["--cell", "pandaa"], "unknown cell 'pandaa' (did you mean 'panda'?)"),
    (["--set", "services.toy.mood=1"], "services.toy.mood"),
    (["--set", "services.toy.mode=idle"], "services.toy.mode: 'idle' must be"),
    (["--speed", "50"], "50 is not within 0.1 to 10"),
    (["--connect", "nowhere"], "--connect: 'nowhere' must be an endpoint"),
])
def test_invalid_configuration_is_reported_in_one_line(arguments: list[str], reason: str) -> None:
    parser = argparse.ArgumentParser()
    add_options(parser)
    options = parser.parse_args(["--cell", CELL, *arguments])
    with pytest.raises(ZencellError) as caught:
        prepare("toy", Config, options)
    assert reason in str(caught.value) and "\n" not in str(caught.value)


async def test_exit_code_and_log_show_how_a_service_ended(shared: Stage) -> None:
    modes = {"crash": 1, "bad_config": 2, "end": 0}
    toys = {mode: shared.toy("--log-json", mode=mode, cell=f"{shared.cell}_{mode}") for mode in modes}
    invalid = {shared.toy("--sped", "5"): "unrecognized arguments: --sped 5",
               shared.toy("--speed", "50"): "50 is not within 0.1 to 10"}
    for mode, toy in toys.items():
        assert await shared.ended(toy) == modes[mode]
        lines = [json.loads(line) for line in shared.output(toy).splitlines()]
        assert {line["service"] for line in lines} == {"toy"}
        bugs = [line["message"] for line in lines if "RuntimeError: the service has a bug" in line.get("traceback", "")]
        assert bugs == (["crashed"] if mode == "crash" else [])
        assert ("services.toy.mode: 'bad_config' cannot be used" in shared.output(toy)) == (mode == "bad_config")
    for toy, reason in invalid.items():
        assert await shared.ended(toy) == 2
        (line,) = shared.output(toy).splitlines()
        assert reason in line


async def test_second_router_names_the_process_that_holds_the_port(shared: Stage) -> None:
    (router,) = [each.pid for each in psutil.net_connections("tcp")
                 if each.status == psutil.CONN_LISTEN and each.laddr.port == shared.port]
    found = rf"port {shared.port} \(domain {shared.domain}\) is in use by process {router} "
    with pytest.raises(PortInUse, match=found):
        open_router([shared.endpoint])


async def test_tool_reports_a_missing_router(domain: int) -> None:
    with pytest.raises(NoRouter, match=f"no router at {endpoint_of(domain)}"):
        async with connect(cell="toy_cell", service="tester", endpoint=endpoint_of(domain), timeout=0.1):
            pass
