"""The supervisor with plain processes and no network: the test reports which service is ready."""

import asyncio
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import psutil
import pytest

from common.config import ServiceEntry, load_cell
from common.messages import ServiceStatus
from common.supervision.launch import Launch
from common.supervision.lifecycle import recover_missed_tokens
from common.supervision.supervisor import BadConfiguration, StartFailed, Supervisor
from common.transport.endpoint import endpoint_of
from common.transport.router import open_router
from common.transport.zenoh_session import open_zenoh
from tests.harness import free_domain

GATE = "import sys; sys.stdin.readline(); print('in', flush=True); "
WAIT = GATE + "import time; time.sleep(60)"
DEAF = (GATE + "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('deaf', flush=True); "
        "time.sleep(60)")
PARENT = (GATE + "import subprocess, time; "
          "c = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)']); "
          "print('child', c.pid, flush=True); time.sleep(60)")


class Scripts(Launch):
    """Starts `python -c <module>` where a service's module should be."""

    def service_command(self, entry: ServiceEntry, *, gate: bool = True) -> list[str]:
        return [sys.executable, "-c", entry.module]


class Rig:
    """A supervisor and the lines of its processes."""

    def __init__(self, timeouts: dict[str, float], **scripts: str) -> None:
        self.lines: list[tuple[str, str]] = []
        self._new = asyncio.Event()
        entries = {name: ServiceEntry(name=name, module=script) for name, script in scripts.items()}
        cell = load_cell("panda").model_copy(update={"services": entries})
        self.supervisor = Supervisor(cell, Scripts("panda", connect="tcp/127.0.0.1:1"), self._on_line, **timeouts)
        self.supervisor.start()

    def _on_line(self, name: str, line: str) -> None:
        self.lines.append((name, line))
        self._new.set()

    async def wrote(self, name: str, start: str, times: int = 1) -> str:
        while True:
            found = [line for source, line in self.lines if source == name and line.startswith(start)]
            if len(found) >= times:
                return found[times - 1]
            self._new.clear()
            await self._new.wait()

    def status(self, name: str) -> ServiceStatus:
        return next(status for status in self.supervisor.statuses if status.name == name)

    def state(self, name: str) -> str:
        return self.status(name).state

    async def up(self) -> None:
        admitting = asyncio.create_task(self.supervisor.admit_all())
        for status in self.supervisor.statuses:
            await self.wrote(status.name, "in")
            self.supervisor.mark_alive(status.name, True)
        await admitting


@asynccontextmanager
async def supervised(timeouts: dict[str, float] | None = None, **scripts: str) -> AsyncIterator[Rig]:
    rig = Rig(timeouts or {}, **scripts)
    try:
        async with asyncio.timeout(30):
            yield rig
    finally:
        await rig.supervisor.stop()


async def test_processes_are_started_at_once_and_a_gate_opens_when_those_before_it_are_ready() -> None:
    async with supervised(first=WAIT, second="print('imports', flush=True); " + WAIT) as rig:
        await rig.wrote("second", "imports")
        assert rig.state("first") == "waiting"
        admitting = asyncio.create_task(rig.supervisor.admit_all())
        await rig.wrote("first", "in")
        assert (rig.state("first"), rig.state("second")) == ("starting", "waiting")
        rig.supervisor.mark_alive("second", True)  # a foreign token: its gate is closed
        assert rig.state("second") == "waiting"
        rig.supervisor.mark_alive("first", True)
        await rig.wrote("second", "in")
        assert rig.state("first") == "ready"
        assert not admitting.done()
        rig.supervisor.mark_alive("second", True)
        await admitting
        assert [status.ready_seconds is not None for status in rig.supervisor.statuses] == [True, True]


async def test_start_timeout_names_the_service_and_its_last_lines() -> None:
    script = "print('waiting for the moon', flush=True); " + WAIT
    async with supervised({"start_timeout": 1.0}, first=script) as rig:
        await rig.wrote("first", "waiting")
        await rig.supervisor.reach_router(asyncio.sleep(0))
        with pytest.raises(StartFailed, match=r"(?s)first was not ready within 1 s; its last lines:.*moon"):
            await rig.supervisor.admit_all()
        assert rig.state("first") == "failed"


@pytest.mark.parametrize("printed", [
    "no", "zencell: no", "ERROR first: no", '{"level": "error", "message": "no", "service": "first"}',
])
@pytest.mark.parametrize("name", ["first", "second"])
async def test_exit_code_2_ends_the_start_also_behind_a_closed_gate(name: str, printed: str) -> None:
    scripts = {"first": WAIT, "second": WAIT, name: f"import sys; print({printed!r}); sys.exit(2)"}
    async with supervised(**scripts) as rig:
        with pytest.raises(BadConfiguration, match=r"^no$"):
            await rig.supervisor.admit_all()


async def test_once_the_cell_is_up_a_process_with_exit_code_2_is_restarted() -> None:
    async with supervised(first=GATE + "sys.stdin.readline(); sys.exit(2)") as rig:
        await rig.up()
        psutil.Process(rig.status("first").pid).kill()
        await rig.wrote("first", "in", times=2)
        assert rig.supervisor.restarts == {"first": 1}
        assert rig.state("first") == "starting"
        rig.supervisor.mark_alive("first", True)
        assert rig.state("first") == "ready"


async def test_process_that_ignores_sigterm_is_killed() -> None:
    async with supervised({"term_timeout": 0.2}, first=WAIT, second=DEAF) as rig:
        await rig.up()
        await rig.wrote("second", "deaf")
        pids = [rig.status("first").pid, rig.status("second").pid]
        await rig.supervisor.stop()
        assert not any(psutil.pid_exists(pid) for pid in pids if pid)
        assert rig.state("second") == "stopped"


async def test_many_processes_that_ignore_sigterm_are_gone_in_time() -> None:
    async with supervised(**{f"deaf{i}": DEAF for i in range(6)}) as rig:
        await rig.up()
        for i in range(6):
            await rig.wrote(f"deaf{i}", "deaf")
        hurry = asyncio.Event()
        stopping = asyncio.create_task(rig.supervisor.stop(hurry))
        hurry.set()
        await stopping
        assert {status.state for status in rig.supervisor.statuses} == {"stopped"}


async def test_children_of_a_service_are_killed_with_it() -> None:
    async with supervised(first=PARENT) as rig:
        await rig.up()
        grandchild = psutil.Process(int((await rig.wrote("first", "child")).split()[1]))
        await rig.supervisor.stop()
        while grandchild.is_running() and grandchild.status() != psutil.STATUS_ZOMBIE:  # noqa: ASYNC110
            await asyncio.sleep(0.02)


async def test_stop_does_not_wait_for_a_pending_restart() -> None:
    async with supervised(first="import sys; sys.exit(1)") as rig:
        while rig.supervisor.restarts["first"] < 2:
            rig.supervisor.changed.clear()
            await rig.supervisor.changed.wait()
    assert (rig.state("first"), rig.status("first").pid) == ("stopped", None)


async def test_readiness_token_that_the_subscription_missed_is_found_by_a_query(caplog) -> None:
    endpoint = endpoint_of(free_domain())
    router = await asyncio.to_thread(open_router, [endpoint])
    async with supervised(first=WAIT, second=WAIT) as rig:
        service = await open_zenoh(endpoint)
        recovering = asyncio.create_task(recover_missed_tokens("panda", endpoint, rig.supervisor, period=0.1))
        admitting = asyncio.create_task(rig.supervisor.admit_all())
        await rig.wrote("first", "in")
        service.token("panda/alive/second")  # its gate is closed
        service.token("panda/alive/first")
        await admitting  # the test does not call `mark_alive`
        recovering.cancel()
        assert [status.state for status in rig.supervisor.statuses] == ["ready", "ready"]
        assert "first is ready: the router has its token, which the subscription missed" in caplog.text
        await asyncio.to_thread(service.close)
    await asyncio.to_thread(router.close)
