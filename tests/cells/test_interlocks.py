"""A stop survives the death of all processes of a cell; `zencell run` releases it."""

import asyncio
from contextlib import AbstractAsyncContextManager, suppress
from pathlib import Path

import psutil
import pytest

from common import topics
from common.transport.bus import Bus
from common.transport.endpoint import endpoint_of
from common.transport.zenoh_session import connect
from tests.harness import PATIENCE, Place, Zencell, free_domain, until

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]

UP = "zenoh --mode client"  # once the cell is ready
PANDA = ("panda", "--no-viewer", "--set", "world.count=1", "--speed", "3")


def kill_all(command: Zencell) -> None:
    """Kill the supervisor and all of its processes before any can react."""
    processes = [psutil.Process(command.process.pid), *command.children().values()]
    for process in processes:
        with suppress(psutil.NoSuchProcess):
            process.kill()
    command.end()
    command.until_childless()


def connected(place: Place) -> AbstractAsyncContextManager[Bus]:
    return connect(cell="panda", service="watcher", endpoint=endpoint_of(place.domain), timeout=PATIENCE)


async def test_stop_survives_the_death_of_all_processes_until_run_releases_it(tmp_path: Path) -> None:
    place = Place(tmp_path, free_domain())
    command = place.start("up", *PANDA)
    try:
        async with connected(place) as bus:
            command.until(UP)
            await until(bus.reader(topics.MOTION_STATUS), lambda m: m.state == "active" and m.progress > 0.1)
            await asyncio.to_thread(place.say, "param", "set", "services.trajectory_executor.speed_scaling=0.05")
            await asyncio.to_thread(place.say, "task", "stop")
        kill_all(command)
        command = place.start("up", *PANDA)
        command.until("Motions run at 5 % of their speed")
        line = command.until("panda is stopped since")
        assert "`zencell task start` lets it continue" in line and "@" in line
        async with connected(place) as bus:
            joints, motion = bus.reader(topics.JOINT_STATES), bus.reader(topics.MOTION_STATUS)
            first = await joints.next()
            later = await until(joints, lambda s: s.header.stamp > first.header.stamp + 5_000_000_000)
            assert later.position == first.position
            status = await until(motion, lambda m: m.state == "none")
            assert status.stopped and status.speed_scaling == 0.05
        await asyncio.to_thread(place.say, "param", "set", "services.trajectory_executor.speed_scaling=1")
        command.interrupt()
        assert command.end() == 0
        run = place.start("run", *PANDA)
        run.until("Released: panda was stopped since")
        assert run.end() == 0
    finally:
        place.end()
