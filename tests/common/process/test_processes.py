"""Real processes: every way in which a service or router ends, and what other processes observe."""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import signal
import subprocess
from collections.abc import AsyncIterator
from pathlib import Path

import psutil
import pytest

from applications.pick_place.topics import PICK_PLACE_STATUS
from common import topics
from common.errors import NoResponder, NoRouter, RemoteError, RequestLost, RequestTimeout, ZencellError
from common.messages import TaskCommand
from common.process.service import add_options, prepare
from common.transport.bus import Bus, Client
from common.transport.endpoint import endpoint_of, port_of
from common.transport.zenoh_session import connect
from tests.common.process.toy import Config
from tests.harness import freeze, wait_router

TIMEOUT = 20.0  # only a failing test waits that long
CELL = str(Path(__file__).with_name("toy_cell.yaml"))
START, HOLD = TaskCommand(command="start"), TaskCommand(command="pause")


class Stage:
    """A router and toys on a domain of their own."""

    def __init__(self, processes, domain: int, until) -> None:
        self.until = until
        self.processes = processes
        self.domain = domain
        self.endpoint = endpoint_of(domain)

    async def router(self) -> subprocess.Popen[bytes]:
        process = self.processes.start("services.router", "--domain", str(self.domain))
        await wait_router(self.endpoint, TIMEOUT)
        return process

    def toy(self, *arguments: str, mode: str = "serve") -> subprocess.Popen[bytes]:
        return self.processes.start(
            "tests.common.process.toy", "--cell", CELL, "--domain", str(self.domain),
            "--set", f"services.toy.mode={mode}", *arguments,
        )

    async def ended(self, process: subprocess.Popen[bytes]) -> int:
        return await asyncio.to_thread(process.wait, TIMEOUT)

    def output(self, process: subprocess.Popen[bytes]) -> str:
        return self.processes.output(process)

    async def said(self, process: subprocess.Popen[bytes], text: str) -> None:
        await self.processes.said(process, text)

    async def connected(self, process: subprocess.Popen[bytes]) -> None:
        """Return when a process has a link to the router, before it logs anything."""

        def linked() -> bool:
            links = psutil.Process(process.pid).net_connections("tcp")
            ports = [link.raddr.port for link in links if link.status == psutil.CONN_ESTABLISHED]
            return port_of(self.domain) in ports

        await self.until(linked)

    def bus(self):
        return connect(cell="toy_cell", service="tester", endpoint=self.endpoint, timeout=TIMEOUT)


@pytest.fixture
def stage(processes, domain: int, until) -> Stage:
    return Stage(processes, domain, until)


@pytest.fixture
async def bus(stage: Stage) -> AsyncIterator[Bus]:
    stage.running_router = await stage.router()
    async with stage.bus() as bus:
        yield bus


async def available(bus: Bus) -> Client:
    client = bus.client(topics.TASK_COMMAND)
    await client.wait_available(TIMEOUT)
    return client


# --- results of a request -----------------------------------------------------------------------------------------


async def test_request_is_answered_or_refused_and_a_bug_in_a_handler_ends_the_process(
    stage: Stage, bus: Bus
) -> None:
    toy = stage.toy("--set", "services.toy.placed=5")
    client = await available(bus)
    assert (await client.call(START)).stage == "5"
    with pytest.raises(RemoteError, match="not now"):
        await client.call(TaskCommand(command="stop"))
    with pytest.raises(RemoteError, match="the handler has a bug") as caught:
        await client.call(TaskCommand(command="resume"))
    assert caught.value.code == "internal"
    assert await stage.ended(toy) == 1
    assert "Traceback" in stage.output(toy)


async def test_killed_server_loses_the_request_and_is_then_unavailable(stage: Stage, bus: Bus) -> None:
    toy = stage.toy()
    client = await available(bus)
    waiting = asyncio.create_task(client.call(HOLD, timeout=TIMEOUT))
    await stage.said(toy, "holding")
    toy.kill()
    with pytest.raises(RequestLost):
        await waiting
    await stage.until(lambda: not client.available)
    with pytest.raises(NoResponder):
        await client.call(START)


async def test_frozen_server_times_out_then_loses_requests_and_serves_again_when_resumed(
    stage: Stage, bus: Bus
) -> None:
    toy = stage.toy()
    client = await available(bus)
    freeze(toy)
    with pytest.raises(RequestTimeout):
        await client.call(START, timeout=0.2)
    with pytest.raises(RequestLost):  # its lease expires during the call
        await client.call(START, timeout=TIMEOUT)
    await stage.until(lambda: not client.available)
    with pytest.raises(NoResponder):
        await client.call(START, timeout=TIMEOUT)
    toy.send_signal(signal.SIGCONT)
    await client.wait_available(TIMEOUT)
    assert (await client.call(START)).stage == "7"


async def test_killed_router_loses_the_request_and_then_no_server_is_available(stage: Stage, bus: Bus) -> None:
    toy = stage.toy()
    client = await available(bus)
    waiting = asyncio.create_task(client.call(HOLD, timeout=TIMEOUT))
    await stage.said(toy, "holding")
    stage.running_router.kill()
    with pytest.raises(RequestLost):
        await waiting
    await stage.until(lambda: not client.available)
    with pytest.raises(NoResponder):
        await client.call(START)


@pytest.mark.slow
async def test_frozen_router_loses_the_request(stage: Stage, bus: Bus) -> None:
    toy = stage.toy()
    client = await available(bus)
    waiting = asyncio.create_task(client.call(HOLD, timeout=TIMEOUT))
    await stage.said(toy, "holding")
    freeze(stage.running_router)
    with pytest.raises(RequestTimeout):
        await client.call(START, timeout=0.1)
    with pytest.raises(RequestLost):
        await waiting


async def test_topics_tokens_and_requests_recover_when_the_router_restarts(stage: Stage, bus: Bus) -> None:
    toy = stage.toy()
    client = await available(bus)
    reader = bus.reader(PICK_PLACE_STATUS)
    await asyncio.wait_for(reader.next(), TIMEOUT)
    await bus.alive.wait("toy", TIMEOUT)
    stage.running_router.kill()
    await stage.ended(stage.running_router)
    await bus.alive.wait("toy", TIMEOUT, there=False)
    await stage.said(toy, "the router is lost")
    await stage.router()
    await bus.alive.wait("toy", TIMEOUT)
    await client.wait_available(TIMEOUT)
    async with asyncio.timeout(TIMEOUT):
        async for sample in bus.raw_reader("toy_cell/pick_place_status"):  # the state is repeated
            assert sample.payload
            break
    assert reader.received == 1
    assert [s.key for s in await bus.raw_get("toy_cell/pick_place_status", TIMEOUT)] == ["toy_cell/pick_place_status"]
    assert (await client.call(START)).stage == "7"
    toy.send_signal(signal.SIGTERM)
    assert await stage.ended(toy) == 0


# --- a signal ends a service in every state -----------------------------------------------------------------------


async def reach(stage: Stage, state: str) -> list[subprocess.Popen[bytes]]:
    """Return two toys in that state, one for each signal."""
    if state == "connecting":
        toys = [stage.toy() for _ in range(2)]
        for toy in toys:
            await stage.said(toy, "no router at")
        return toys
    router = await stage.router()
    if state == "gated":
        toys = [stage.toy("--gate") for _ in range(2)]
        for toy in toys:
            await stage.connected(toy)
        return toys
    mode = state if state in ("busy", "stubborn") else "serve"
    toys = [stage.toy(mode=mode), stage.toy("--set", "cell=another", mode=mode)]  # a cell admits only one of a name
    for toy in toys:
        await stage.said(toy, "is ready")
    if state == "router dead":
        router.kill()
        for toy in toys:
            await stage.said(toy, "the router is lost")
    if state == "router frozen":
        freeze(router)
    return toys


STATES = ["connecting", "gated", "running", "busy", "stubborn", "router dead", "router frozen"]


@pytest.mark.parametrize("state", [
    state if state in ("running", "connecting", "stubborn") else pytest.param(state, marks=pytest.mark.slow)
    for state in STATES
])
async def test_sigint_and_sigterm_end_a_service_with_exit_code_0_in_every_state(stage: Stage, state: str) -> None:
    interrupted, terminated = await reach(stage, state)
    interrupted.send_signal(signal.SIGINT)
    interrupted.send_signal(signal.SIGINT)  # a second one changes nothing
    terminated.send_signal(signal.SIGTERM)
    assert [await stage.ended(interrupted), await stage.ended(terminated)] == [0, 0]
    for toy in (interrupted, terminated):
        assert "Traceback" not in stage.output(toy)


async def test_service_starts_when_its_gate_opens_and_ends_when_it_closes(stage: Stage, bus: Bus) -> None:
    toy = stage.toy("--gate")
    await stage.connected(toy)
    assert "toy" not in await bus.alive.known()
    toy.stdin.write(b"go\n")
    toy.stdin.flush()
    await bus.alive.wait("toy", TIMEOUT)
    toy.stdin.close()
    assert await stage.ended(toy) == 0
    await bus.alive.wait("toy", TIMEOUT, there=False)
    assert "the supervisor is gone" in stage.output(toy)


async def test_token_vanishes_when_a_service_is_terminated(stage: Stage, bus: Bus) -> None:
    toy = stage.toy()
    await bus.alive.wait("toy", TIMEOUT)
    os.kill(toy.pid, signal.SIGTERM)
    await bus.alive.wait("toy", TIMEOUT, there=False)
    assert await stage.ended(toy) == 0
    assert "stopped: SIGTERM" in stage.output(toy)


@pytest.mark.slow
async def test_router_ends_on_signals_and_with_its_supervisor(processes, domain: int) -> None:
    for end in (signal.SIGINT, signal.SIGTERM, None):
        router = processes.start("services.router", "--domain", str(domain), "--gate")
        router.stdin.write(b"\n")
        router.stdin.flush()
        await processes.said(router, "listening at")
        if end is None:
            router.stdin.close()
        else:
            router.send_signal(end)
        assert await asyncio.to_thread(router.wait, TIMEOUT) == 0


# --- bad starts ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["--domain", "233"], "--domain: '233' must be a whole number from 0 to 232"),
        (["--set", "services.toy.mode=idle"], "services.toy.mode: 'idle' must be"),
        (["--sped", "5"], "unrecognized arguments: --sped 5"),
    ],
)
async def test_invalid_option_is_reported_in_one_line_with_exit_code_2(
    stage: Stage, arguments: list[str], reason: str
) -> None:
    toy = stage.toy(*arguments)
    assert await stage.ended(toy) == 2
    output = stage.output(toy)
    assert reason in output
    assert len(output.splitlines()) == 1


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["--cell", "pandaa"], "unknown cell 'pandaa' (did you mean 'panda'?)"),
        (["--set", "services.toy.mood=1"], "services.toy.mood"),
        (["--speed", "50"], "50 is not within 0.1 to 10"),
        (["--connect", "nowhere"], "--connect: 'nowhere' must be an endpoint"),
    ],
)
def test_invalid_configuration_is_reported_in_one_line(arguments: list[str], reason: str) -> None:
    parser = argparse.ArgumentParser()
    add_options(parser)
    options = parser.parse_args(["--cell", CELL, "--domain", "1", *arguments])
    with pytest.raises(ZencellError) as caught:
        prepare("toy", Config, options)
    assert reason in str(caught.value) and "\n" not in str(caught.value)


async def test_exit_code_shows_how_a_service_ended(stage: Stage, bus: Bus) -> None:
    for mode, code in (("crash", 1), ("bad_config", 2), ("end", 0)):
        toy = stage.toy("--log-json", mode=mode)
        assert await stage.ended(toy) == code
        lines = [json.loads(line) for line in stage.output(toy).splitlines()]
        assert {line["service"] for line in lines} == {"toy"}
        bugs = [line["message"] for line in lines if "RuntimeError: the service has a bug" in line.get("traceback", "")]
        assert bugs == (["crashed"] if mode == "crash" else [])
        assert ("services.toy.mode: 'bad_config' cannot be used" in stage.output(toy)) == (mode == "bad_config")


async def test_second_router_names_the_process_that_holds_the_port(stage: Stage) -> None:
    router = await stage.router()
    second = stage.processes.start("services.router", "--domain", str(stage.domain))
    assert await stage.ended(second) == 2
    [line] = stage.output(second).splitlines()
    assert f"port {port_of(stage.domain)} (domain {stage.domain}) is in use by process {router.pid}" in line


async def test_tool_reports_a_missing_router(domain: int) -> None:
    with pytest.raises(NoRouter, match=f"no router at {endpoint_of(domain)}"):
        async with connect(cell="toy_cell", service="tester", endpoint=endpoint_of(domain), timeout=0.1):
            pass
