"""A stop that survives the death of all processes of a cell, and a `run` that releases it."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import psutil
import pytest

from common import topics
from common.messages import JointState
from common.transport.bus import Reader
from common.transport.endpoint import endpoint_of
from common.transport.zenoh_session import connect
from tests.harness import PATIENCE, Place, Zencell, free_domain, until

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]

UP = "zenoh --mode client"  # when all is ready
PANDA = ("panda", "--no-viewer", "--set", "world.count=1", "--speed", "3")


def kill_all(command: Zencell) -> None:
    """SIGKILL for the supervisor and all that it started, none before the other has had a word."""
    everybody = [psutil.Process(command.process.pid), *command.children().values()]
    for process in everybody:
        with suppress(psutil.NoSuchProcess):
            process.kill()
    command.end()
    command.until_childless()


async def assert_still(joints: Reader[JointState]) -> None:
    first = await joints.next()
    later = await until(joints, lambda s: s.header.stamp > first.header.stamp + 5_000_000_000)
    assert later.position == first.position


@pytest.fixture
def place(tmp_path: Path) -> Iterator[Place]:
    made = Place(tmp_path, free_domain())
    yield made
    made.end()


async def test_stop_survives_killed_supervisor_and_executor(place: Place) -> None:
    command = place.start("up", *PANDA)
    async with connect(cell="panda", service="watcher", endpoint=endpoint_of(place.domain), timeout=PATIENCE) as bus:
        motion = bus.reader(topics.MOTION_STATUS)
        command.until(UP)
        await until(motion, lambda m: m.state == "active" and m.progress > 0.1)
        await asyncio.to_thread(place.say, "param", "set", "services.trajectory_executor.speed_scaling=0.05")
        await asyncio.to_thread(place.say, "task", "stop")
    kill_all(command)
    command = place.start("up", *PANDA)
    command.until("Motions run at 5 % of their speed")
    line = command.until("panda is stopped since")
    assert "`zencell task start` lets it continue" in line and "@" in line
    async with connect(cell="panda", service="watcher", endpoint=endpoint_of(place.domain), timeout=PATIENCE) as bus:
        joints, motion = bus.reader(topics.JOINT_STATES), bus.reader(topics.MOTION_STATUS)
        await assert_still(joints)
        command.children()["trajectory_executor"].kill()
        await asyncio.to_thread(command.until, "trajectory_executor is ready again")
        again = await until(motion, lambda m: m.state == "none")
        assert again.stopped and again.speed_scaling == 0.05
        await assert_still(joints)
    await asyncio.to_thread(place.say, "param", "set", "services.trajectory_executor.speed_scaling=1")
    command.interrupt()
    assert command.end() == 0
    run = place.start("run", *PANDA)
    run.until("Released: panda was stopped since")
    assert run.end() == 0
