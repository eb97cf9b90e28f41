"""The supervisor with plain processes and no network: the test says which service is ready."""

import asyncio
import sys
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager

import psutil
import pytest

from common.config import Cell, ServiceEntry, load_cell
from common.supervision import operation
from common.supervision import supervisor as module
from common.supervision.launch import Launch
from common.supervision.supervisor import BadConfiguration, StartFailed, Supervisor
from common.transport.endpoint import endpoint_of
from common.transport.router import open_router
from common.transport.zenoh_session import open_zenoh
from tests.harness import free_domain

GATE = "import sys; sys.stdin.readline(); print('in', flush=True); "
WAIT = GATE + "import time; time.sleep(60)"
DEAF = (
    GATE + "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); "
    "print('deaf', flush=True); time.sleep(60)"
)
PARENT = (
    GATE + "import subprocess, time; c = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)']); "
    "print('child', c.pid, flush=True); time.sleep(60)"
)


class Scripts(Launch):
    """Starts `python -c <module>` where a service's module should be."""

    def service_command(self, entry: ServiceEntry, *, gate: bool = True) -> list[str]:
        return [sys.executable, "-c", entry.module]


def cell_of(**scripts: str) -> Cell:
    entries = {name: ServiceEntry(name=name, module=script) for name, script in scripts.items()}
    return load_cell("panda").model_copy(update={"services": entries})


class Watch:
    """A supervisor and the lines of its processes."""

    def __init__(self, **scripts: str) -> None:
        self.lines: list[tuple[str, str]] = []
        self._came = asyncio.Event()
        self.supervisor = Supervisor(cell_of(**scripts), Scripts("panda", connect="tcp/127.0.0.1:1"), self._on_line)
        self.supervisor.begin()

    def _on_line(self, name: str, line: str) -> None:
        self.lines.append((name, line))
        self._came.set()

    async def said(self, name: str, start: str, times: int = 1) -> str:
        while True:
            found = [line for who, line in self.lines if who == name and line.startswith(start)]
            if len(found) >= times:
                return found[times - 1]
            self._came.clear()
            await self._came.wait()

    def state(self, name: str) -> str:
        return next(status.state for status in self.supervisor.statuses if status.name == name)

    def pid(self, name: str) -> int | None:
        return next(status.pid for status in self.supervisor.statuses if status.name == name)

    async def up(self) -> None:
        admitting = asyncio.create_task(self.supervisor.admit_all())
        for status in self.supervisor.statuses:
            await self.said(status.name, "in")
            self.supervisor.mark_alive(status.name, True)
        await admitting


Up = Callable[..., Awaitable[Watch]]


@asynccontextmanager
async def watching(**scripts: str) -> AsyncIterator[Watch]:
    watch = Watch(**scripts)
    try:
        async with asyncio.timeout(30):
            yield watch
    finally:
        await watch.supervisor.stop()


async def test_a_service_is_let_through_only_when_those_before_it_are_ready() -> None:
    async with watching(first=WAIT, second=WAIT) as watch:
        admitting = asyncio.create_task(watch.supervisor.admit_all())
        await watch.said("first", "in")
        assert (watch.state("first"), watch.state("second")) == ("starting", "waiting")
        watch.supervisor.mark_alive("second", True)  # a token of somebody else's: it is not even let through
        assert watch.state("second") == "waiting"
        watch.supervisor.mark_alive("first", True)
        await watch.said("second", "in")
        assert watch.state("first") == "ready"
        assert not admitting.done()
        watch.supervisor.mark_alive("second", True)
        await admitting
        assert [status.ready_seconds is not None for status in watch.supervisor.statuses] == [True, True]


async def test_all_processes_are_started_at_once_whatever_the_order() -> None:
    async with watching(first=WAIT, second="print('imports', flush=True); " + WAIT) as watch:
        await watch.said("second", "imports")
        assert watch.state("first") == "waiting"


async def test_time_out_names_the_service_and_its_last_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    async with watching(first=GATE + "print('waiting for the moon', flush=True); " + WAIT) as watch:
        admitting = asyncio.create_task(watch.supervisor.reach_router(asyncio.sleep(0)))
        await admitting
        monkeypatch.setattr(module, "START_TIMEOUT", 1.5)
        with pytest.raises(StartFailed, match=r"(?s)first was not ready within 1.5 s; its last lines:.*moon"):
            await watch.supervisor.admit_all()
        assert watch.state("first") == "failed"


@pytest.mark.parametrize(
    "said",
    [
        "services.first.x: 1 is not a parameter",
        "zencell: services.first.x: 1 is not a parameter",
        "ERROR first: services.first.x: 1 is not a parameter",
        '{"level": "error", "message": "services.first.x: 1 is not a parameter", "service": "first"}',
    ],
)
async def test_exit_code_2_is_the_end_with_the_line_that_was_printed(said: str) -> None:
    async with watching(first=f"import sys; print({said!r}); sys.exit(2)", second=WAIT) as watch:
        with pytest.raises(BadConfiguration) as raised:
            await watch.supervisor.admit_all()
        assert str(raised.value) == "services.first.x: 1 is not a parameter"


async def test_a_service_that_waits_behind_its_gate_can_fail_too() -> None:
    async with watching(first=WAIT, second="import sys; print('no'); sys.exit(2)") as watch:
        with pytest.raises(BadConfiguration, match=r"^no$"):
            await watch.supervisor.admit_all()


async def test_once_up_exit_code_2_is_a_death_like_any_other() -> None:
    async with watching(first=GATE + "sys.stdin.readline(); sys.exit(2)") as watch:
        await watch.up()
        process = psutil.Process(watch.pid("first"))
        process.kill()
        await watch.said("first", "in", times=2)
        assert watch.supervisor.restarts == {"first": 1}
        assert watch.state("first") == "starting"
        watch.supervisor.mark_alive("first", True)
        assert watch.state("first") == "ready"


async def test_a_deaf_process_is_killed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "TERM_TIMEOUT", 0.3)
    async with watching(first=WAIT, second=DEAF) as watch:
        await watch.up()
        await watch.said("second", "deaf")
        pids = [watch.pid("first"), watch.pid("second")]
        await watch.supervisor.stop()
        assert not any(psutil.pid_exists(pid) for pid in pids if pid)
        assert watch.state("second") == "stopped"


async def test_many_deaf_processes_are_gone_in_time() -> None:
    async with watching(**{f"deaf{i}": DEAF for i in range(6)}) as watch:
        await watch.up()
        for i in range(6):
            await watch.said(f"deaf{i}", "deaf")
        hurry = asyncio.Event()
        stopping = asyncio.create_task(watch.supervisor.stop(hurry))
        hurry.set()
        await stopping
        assert {status.state for status in watch.supervisor.statuses} == {"stopped"}


async def test_what_a_service_started_goes_with_it() -> None:
    async with watching(first=PARENT) as watch:
        await watch.up()
        grandchild = psutil.Process(int((await watch.said("first", "child")).split()[1]))
        await watch.supervisor.stop()
        deadline = time.monotonic() + 5
        while grandchild.is_running() and grandchild.status() != psutil.STATUS_ZOMBIE:
            assert time.monotonic() < deadline
            await asyncio.sleep(0.02)


async def test_stop_does_not_wait_for_a_restart_that_is_due() -> None:
    async with watching(first="import sys; sys.exit(1)") as watch:
        while watch.supervisor.restarts["first"] < 2:
            watch.supervisor.changed.clear()
            await watch.supervisor.changed.wait()
    assert watch.state("first") == "stopped"
    assert watch.pid("first") is None


async def test_a_token_that_the_network_did_not_tell_of_is_asked_for(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(operation, "LATE_PERIOD", 0.1)
    endpoint = endpoint_of(free_domain())
    router = await asyncio.to_thread(open_router, [endpoint])
    async with watching(first=WAIT, second=WAIT) as watch:
        service = await open_zenoh(endpoint)
        asking = asyncio.create_task(operation.ask_for_the_late("panda", endpoint, watch.supervisor))
        admitting = asyncio.create_task(watch.supervisor.admit_all())
        await watch.said("first", "in")
        service.token("panda/alive/second")  # which is not let through yet
        service.token("panda/alive/first")
        await admitting  # nobody calls `mark_alive` here
        asking.cancel()
        assert [status.state for status in watch.supervisor.statuses] == ["ready", "ready"]
        assert "first is ready, which the network did not tell" in caplog.text
        await asyncio.to_thread(service.close)
    await asyncio.to_thread(router.close)
