"""How long it takes until a failure is noticed: frozen processes, a dead planner, a supervisor that is killed.

Run as `python -m benchmarks.watchdogs`; it brings up the Panda cell once and takes about a minute and a half.
"""

from __future__ import annotations

import argparse
import asyncio
import signal
import tempfile
import time
from pathlib import Path

import psutil

from applications.pick_place.topics import PICK_PLACE_STATUS, PickPlaceStatus
from common import topics
from common.messages import MotionStatus, ServiceStatus, SupervisorStatus
from common.transport.bus import Bus
from tests.harness import RunningCell, until

FROZEN = ("vision_detector", "camera_simulator", "trajectory_executor", "router")


def waits(status: PickPlaceStatus) -> bool:
    """Whether the task says that the arm waits."""
    return status.message.startswith("the arm waits")


def started(status: MotionStatus) -> bool:
    """Whether a motion is under way, with most of it to come."""
    return status.state == "active" and not status.held and status.progress < 0.3


def of(status: SupervisorStatus | None, name: str) -> ServiceStatus:
    """One process of all."""
    assert status is not None
    return next(service for service in status.services if service.name == name)


async def freeze(cell: RunningCell, bus: Bus, name: str) -> str:
    """Stop a process; a row of what followed."""
    supervisor, status = bus.reader(topics.SUPERVISOR_STATUS), bus.reader(PICK_PLACE_STATUS)
    before = of(await supervisor.next(), name).restarts
    await until(bus.reader(topics.MOTION_STATUS), started)
    process, began = cell.processes()[name], time.monotonic()
    process.send_signal(signal.SIGSTOP)
    noticed = ""
    if name == "trajectory_executor":
        await until(status, waits)
        noticed = f"{time.monotonic() - began:.2f} s"
    await asyncio.to_thread(psutil.wait_procs, [process])
    killed = time.monotonic() - began
    await until(supervisor, lambda s: of(s, name).restarts > before and of(s, name).state == "ready")
    return f"| {name} frozen | {noticed} | {killed:.1f} s | {time.monotonic() - began:.1f} s |"


async def kill_planner(cell: RunningCell, bus: Bus) -> str:
    """Kill the planner in the middle of a motion; a row of what followed."""
    status, motion = bus.reader(PICK_PLACE_STATUS), bus.reader(topics.MOTION_STATUS)
    await until(motion, started)
    began = time.monotonic()
    cell.processes()["motion_planner"].kill()
    await until(status, waits)
    noticed = time.monotonic() - began
    await until(motion, lambda m: m.held)
    await until(motion, lambda m: not m.held)
    return f"| motion_planner killed | {noticed:.2f} s | | {time.monotonic() - began:.1f} s |"


async def measure(cell: RunningCell) -> list[str]:
    """All rows."""
    async with cell.listen() as bus:
        rows = [await freeze(cell, bus, name) for name in FROZEN]
        rows.append(await kill_planner(cell, bus))
        processes = cell.processes()
        for name in ("scene_manager", "trajectory_executor"):
            processes[name].send_signal(signal.SIGSTOP)
    cell.process.kill()
    began = time.monotonic()
    _, left = await asyncio.to_thread(psutil.wait_procs, list(processes.values()), 10)
    gone = f"{time.monotonic() - began:.1f} s" if not left else f"{len(left)} are left"
    return [*rows, f"| supervisor killed, two others frozen | | all gone after {gone} | |"]


def main() -> None:
    """Print the table."""
    argparse.ArgumentParser(prog="watchdogs", description=__doc__.splitlines()[0]).parse_args()
    with tempfile.TemporaryDirectory() as folder, RunningCell(Path(folder), "up", "panda") as cell:
        rows = asyncio.run(measure(cell))
    print("| what | the task says so after | killed after | ready again after |\n|---|---|---|---|")
    print("\n".join(rows))


if __name__ == "__main__":
    main()
