"""Frozen and stuck processes, and a killed supervisor, in complete cells."""

import asyncio
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
import yaml

from common import topics
from common.messages import MotionStatus, ParameterRequest, SupervisorStatus, TaskCommand
from common.transport.bus import Bus
from tests.harness import ROOT, RunningCell, until
from tests.simulated.visited import in_box

pytestmark = pytest.mark.cell

STOP_SECONDS = 3.0  # after which a cell without its supervisor has ended


def restarted(name: str, status: SupervisorStatus) -> bool:
    return any(s.name == name and s.restarts > 0 and s.state == "ready" for s in status.services)


def halfway(status: MotionStatus) -> bool:
    return status.state == "active" and status.progress > 0.2


async def freeze(bus: Bus, cell: RunningCell, name: str) -> None:
    """Stop a process and wait until it was restarted and is ready."""
    supervisor = bus.reader(topics.SUPERVISOR_STATUS)
    cell.processes()[name].send_signal(signal.SIGSTOP)
    await until(supervisor, lambda status: restarted(name, status), 60)


@pytest.mark.slow
async def test_frozen_processes_and_no_others_are_restarted(tmp_path: Path) -> None:
    options = ("--speed", "3", "--set", "world.count=2", "--set", "watchdogs.silence=4")
    with RunningCell(tmp_path, "run", "panda", *options) as cell:
        async with cell.listen() as bus:
            for victim in ("vision_detector", "router"):
                await until(bus.reader(topics.MOTION_STATUS), halfway, 60)
                await freeze(bus, cell, victim)
            assert await cell.ended(120) == 0, cell.tail()
        summary = cell.summary
        assert not cell.processes()
    assert {name: n for name, n in summary["restarts"].items() if n} == {"vision_detector": 1, "router": 1}
    assert "vision_detector has sent nothing for" in cell.text and "router does not answer for" in cell.text
    assert summary["state"] == "DONE"
    assert summary["truth"] == in_box(2)


@pytest.fixture(scope="module")
def up(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningCell]:
    """A cell with a service that can get stuck; its task waits."""
    folder = tmp_path_factory.mktemp("up")
    file = folder / "with_stuck.yaml"
    cell_file = yaml.safe_load((ROOT / "config" / "cells" / "panda.yaml").read_text())
    services = {"tests.cells.stuck": {}, **cell_file["services"]}
    file.write_text(yaml.safe_dump({**cell_file, "services": services, "autostart": False}, sort_keys=False))
    with RunningCell(folder, "up", str(file), "--set", "watchdogs.loop=1.5") as cell:
        cell.name = "panda"
        yield cell


@pytest.mark.slow
async def test_service_with_a_stuck_loop_reports_where_and_is_restarted(up: RunningCell) -> None:
    async with up.listen() as bus:
        supervisor = bus.reader(topics.SUPERVISOR_STATUS)
        client = bus.client(topics.parameters_of("stuck"))
        await until(supervisor, lambda status: all(s.state == "ready" for s in status.services), 60)
        asking = asyncio.create_task(client.call(ParameterRequest(set={"services.stuck.stuck": True}, by="a test"), 30))
        status = await until(supervisor, lambda status: restarted("stuck", status), 60)
        await asyncio.wait({asking})
        assert asking.exception() is not None, "it was stuck before it could answer"
    assert "stuck ended (its event loop was stuck, exit code 70)" in up.text
    assert "the event loop has not turned for" in up.text
    assert "in retuned" in up.text, "where it hangs"
    assert {service.name: service.restarts for service in status.services if service.restarts} == {"stuck": 1}


@pytest.mark.slow  # `make test` does it with tiny services, in tests/cli/test_bring_up.py
async def test_killed_supervisor_leaves_no_process_not_even_frozen_ones(up: RunningCell) -> None:
    async with up.listen() as bus:
        task = bus.client(topics.TASK_COMMAND)
        await task.wait_available(60.0)
        await task.call(TaskCommand(command="start"), 10.0)
        await until(bus.reader(topics.MOTION_STATUS), halfway, 60)
        processes = list(up.processes().values())
        for name in ("scene_manager", "trajectory_executor"):
            up.processes()[name].send_signal(signal.SIGSTOP)
    os.kill(up.process.pid, signal.SIGKILL)
    _, left = await asyncio.to_thread(psutil.wait_procs, processes, STOP_SECONDS)
    assert len(processes) == 10
    assert not left
