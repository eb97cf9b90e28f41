"""Processes that are alive and do nothing, and a supervisor that is no more: in whole cells."""

from __future__ import annotations

import asyncio
import os
import signal
from pathlib import Path

import psutil
import pytest
import yaml

from common import topics
from common.applications.pick_place.topics import PICK_PLACE_STATUS
from common.messages import MotionStatus, ParameterRequest, SupervisorStatus
from common.transport.bus import Bus
from tests.harness import ROOT, RunningCell, until

pytestmark = pytest.mark.cell

STOP_SECONDS = 3.0  # after which a cell without its supervisor is gone


def restarted(name: str, status: SupervisorStatus) -> bool:
    return any(s.name == name and s.restarts > 0 and s.state == "ready" for s in status.services)


def halfway(status: MotionStatus) -> bool:
    return status.state == "active" and status.progress > 0.2


async def freeze(bus: Bus, cell: RunningCell, name: str) -> None:
    """Stop a process and return when it was started again and is ready."""
    supervisor = bus.reader(topics.SUPERVISOR_STATUS)
    cell.processes()[name].send_signal(signal.SIGSTOP)
    await until(supervisor, lambda status: restarted(name, status), 60)


@pytest.mark.slow
@pytest.mark.parametrize("victim", ["vision_detector", "router"])
async def test_a_process_that_is_frozen_is_started_again_and_no_other(tmp_path: Path, victim: str) -> None:
    options = ("--speed", "3", "--set", "world.count=2", "--set", "watchdogs.silence=4")
    with RunningCell(tmp_path, "run", "panda", *options) as cell:
        async with cell.listen() as bus:
            await until(bus.reader(topics.MOTION_STATUS), halfway, 60)
            await freeze(bus, cell, victim)
            assert await cell.ended(120) == 0, cell.tail()
        summary = cell.summary
        assert not cell.processes()
    assert {name: n for name, n in summary["restarts"].items() if n} == {victim: 1}
    assert f"{victim} {'does not answer' if victim == 'router' else 'has not been heard'} for" in cell.text
    assert summary["state"] == "DONE"
    assert summary["truth"] == {"in_box": 2, "on_table": 0, "elsewhere": 0, "containers": {"box": 2}}


@pytest.mark.slow
async def test_a_service_whose_loop_is_stuck_tells_where_and_is_started_again(tmp_path: Path) -> None:
    file = tmp_path / "with_stuck.yaml"
    cell_file = yaml.safe_load((ROOT / "config" / "cells" / "panda.yaml").read_text())
    services = {"tests.cells.stuck": {}, **cell_file["services"]}
    file.write_text(yaml.safe_dump({**cell_file, "services": services, "autostart": False}, sort_keys=False))
    with RunningCell(tmp_path, "up", str(file), "--set", "watchdogs.loop=1.5") as cell:
        cell.name = "panda"
        async with cell.listen() as bus:
            supervisor = bus.reader(topics.SUPERVISOR_STATUS)
            client = bus.client(topics.parameters_of("stuck"))
            await until(supervisor, lambda status: all(s.state == "ready" for s in status.services), 60)
            asking = asyncio.create_task(
                client.call(ParameterRequest(set={"services.stuck.stuck": True}, by="a test"), 30)
            )
            await until(supervisor, lambda status: restarted("stuck", status), 60)
            await asyncio.wait({asking})
            assert asking.exception() is not None, "it was stuck before it could answer"
        cell.interrupt()
        assert await cell.ended(20) == 0
        text = cell.text
    assert "stuck ended (its event loop was stuck, exit code 70)" in text
    assert "the event loop has not turned for" in text
    assert "in retuned" in text, "where it hangs"
    assert {name: n for name, n in cell.summary["restarts"].items() if n} == {"stuck": 1}


async def test_nothing_is_left_of_a_cell_whose_supervisor_is_killed_not_even_what_is_frozen(tmp_path: Path) -> None:
    with RunningCell(tmp_path, "up", "panda", "--speed", "3") as cell:
        async with cell.listen() as bus:
            await until(bus.reader(topics.MOTION_STATUS), halfway, 60)
            processes = list(cell.processes().values())
            for name in ("scene_manager", "trajectory_executor"):
                cell.processes()[name].send_signal(signal.SIGSTOP)
        os.kill(cell.process.pid, signal.SIGKILL)
        _, left = await asyncio.to_thread(psutil.wait_procs, processes, STOP_SECONDS)
    assert len(processes) == 9
    assert not left


@pytest.mark.slow
async def test_the_arm_is_held_while_the_planner_is_dead_and_the_same_motion_goes_on_when_it_is_back(
    tmp_path: Path,
) -> None:
    with RunningCell(tmp_path, "run", "panda", "--speed", "1.5", "--set", "world.count=1") as cell:
        async with cell.listen() as bus:
            motion, status = bus.reader(topics.MOTION_STATUS), bus.reader(PICK_PLACE_STATUS)
            before = await until(motion, halfway, 60)
            cell.processes()["motion_planner"].kill()
            told = await until(status, lambda s: s.message == "the arm waits: motion_planner is gone", 20)
            held = await until(motion, lambda m: m.held, 20)
            assert held.held_by == ["watchdog"] and not told.paused
            assert held.id == before.id and "motion_planner is gone" in held.message
            ended = await until(motion, lambda m: not m.held and m.state != "active", 60)
            assert (ended.id, ended.state) == (before.id, "succeeded")
            assert await cell.ended(120) == 0, cell.tail()
        summary = cell.summary
    assert summary["state"] == "DONE"
    assert summary["truth"] == {"in_box": 1, "on_table": 0, "elsewhere": 0, "containers": {"box": 1}}
    assert (summary["failures"], summary["restarts"]["motion_planner"]) == (0, 1)
