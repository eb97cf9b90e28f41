import asyncio
import signal
import subprocess
import sys
import uuid
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AsyncExitStack
from pathlib import Path
from typing import TypeVar

import pytest

from common.clock import Clock
from common.messages import Message
from common.transport.bus import Bus, Reader
from common.transport.endpoint import endpoint_of
from common.transport.local import LocalNetwork
from common.transport.zenoh_session import connect
from tests.harness import ROOT, environment, free_domain, wait_router

M = TypeVar("M", bound=Message)
TIMEOUT = 20.0  # only a failing test waits that long


@pytest.fixture(autouse=True)
def _frequent_repetition(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("common.transport.bus.REPEAT_SECONDS", 0.1)
    monkeypatch.setattr("common.supervision.lifecycle.MATCH_PERIOD", 0.1)


async def next_of(reader: Reader[M]) -> M:
    return await asyncio.wait_for(reader.next(), TIMEOUT)


def put_raw(bus: Bus, key: str, payload: bytes, attachment: bytes = b"") -> None:
    """Publish a payload of a plain Zenoh client under a key of the cell."""
    bus._session.publisher(f"{bus.cell}/{key}", "", reliable=True).put(payload, attachment)


async def until(condition: Callable[[], bool]) -> None:
    """Poll until the condition holds."""
    async with asyncio.timeout(TIMEOUT):
        while not condition():  # noqa: ASYNC110
            await asyncio.sleep(0.005)


class Processes:
    """Starts modules of the project as processes, and kills them at the end."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._started: list[subprocess.Popen[bytes]] = []

    def start(self, module: str, *arguments: str) -> subprocess.Popen[bytes]:
        with self.log_of(len(self._started)).open("wb") as log:
            process = subprocess.Popen([sys.executable, "-m", module, *arguments], cwd=ROOT, stdin=subprocess.PIPE,
                                       stderr=log, env=environment())
        self._started.append(process)
        return process

    def log_of(self, index: int) -> Path:
        return self._folder / f"process_{index}.log"

    def output(self, process: subprocess.Popen[bytes]) -> str:
        return self.log_of(self._started.index(process)).read_text()

    async def printed(self, process: subprocess.Popen[bytes], text: str) -> None:
        await until(lambda: text in self.output(process))

    def end(self) -> None:
        for process in self._started:
            if process.poll() is None:
                process.send_signal(signal.SIGCONT)
                process.kill()
            process.wait()
            if process.stdin:
                process.stdin.close()


@pytest.fixture
def domain() -> int:
    return free_domain()


@pytest.fixture
def processes(tmp_path: Path) -> Iterator[Processes]:
    started = Processes(tmp_path)
    yield started
    started.end()


@pytest.fixture(scope="session")
def shared_router(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Endpoint of a router that tests share; each test uses a cell name of its own."""
    processes = Processes(tmp_path_factory.mktemp("router"))
    domain = free_domain()
    processes.start("services.router", "--domain", str(domain))
    try:
        with ThreadPoolExecutor(1) as thread:  # this thread may already run a loop
            thread.submit(lambda: asyncio.run(wait_router(endpoint_of(domain), TIMEOUT))).result()
        yield endpoint_of(domain)
    finally:
        processes.end()


NewBus = Callable[..., Awaitable[Bus]]


@pytest.fixture(params=["local", "zenoh"])
async def new_bus(request: pytest.FixtureRequest) -> AsyncIterator[NewBus]:
    """Creates buses on one network: in process, and over a real router."""
    cell = f"test_{uuid.uuid4().hex[:8]}"
    async with AsyncExitStack() as stack:
        if request.param == "local":
            net = LocalNetwork()

            async def make(service: str = "tester") -> Bus:
                bus = net.bus(service, cell=cell, clock=Clock())
                stack.push_async_callback(bus.close)
                return bus
        else:
            endpoint = request.getfixturevalue("shared_router")

            async def make(service: str = "tester") -> Bus:
                return await stack.enter_async_context(
                    connect(cell=cell, service=service, endpoint=endpoint, timeout=TIMEOUT))

        yield make
