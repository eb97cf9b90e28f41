"""Slow and frozen subscribers of a complete cell, which must not be affected."""

import asyncio
from collections import Counter
from pathlib import Path

import pytest

from applications.pick_place.topics import PICK_PLACE_STATUS
from common import topics
from common.messages import ServiceCounters, TaskCommand
from common.transport.bus import Bus
from tests.cells.losses import Losses
from tests.cells.subscribers import Subscriber
from tests.harness import RunningCell, running_with, until
from tests.simulated.visited import in_box

pytestmark = [pytest.mark.cell, pytest.mark.slow]


async def newest_counters(bus: Bus, newest: dict[str, ServiceCounters]) -> None:
    async for counters in bus.reader(topics.COUNTERS):
        newest[counters.service] = counters


async def test_slow_and_frozen_subscribers_block_no_service(tmp_path: Path) -> None:
    newest: dict[str, ServiceCounters] = {}
    settings = ("autostart=false", "world.count=1", "services.camera_simulator.rate=30")
    with RunningCell(tmp_path, "up", "panda", "--speed", "5", *(f"--set={one}" for one in settings)) as cell:
        async with cell.listen() as bus:
            losses, task, status = Losses(bus), bus.client(topics.TASK_COMMAND), bus.reader(PICK_PLACE_STATUS)
            await task.wait_available(60.0)
            slow, stuck = await asyncio.gather(
                *(asyncio.to_thread(Subscriber, cell.endpoint, "panda/**", rest) for rest in (0.5, 0.0))
            )
            with slow, stuck:
                stuck.freeze()
                async with running_with(newest_counters(bus, newest)):
                    await task.call(TaskCommand(command="start"), 10.0)
                    await until(status, lambda one: one.state in ("DONE", "ERROR"), 90.0)
                    losses.stop()
        cell.interrupt()
        assert await cell.ended(20) == 0, cell.tail()
        summary = cell.summary
    assert summary["state"] == "DONE"
    assert summary["truth"] == in_box(1)
    assert not any(summary["restarts"].values())
    came = {key: one for key, one in losses.of.items() if one.came}
    assert came.keys() >= {"scene_object_updates", "planning_scene", "motion/status", "gripper/state",
                           topics.COUNTERS.key}
    # On a busy machine a state may be replaced on its way by the next one; `make soak` counts those too.
    assert not {key: one.lost for key, one in came.items() if one.lost and losses.kind(key) == "event"}
    overflow = sum((Counter(counters.overflow) for counters in newest.values()), Counter())
    assert newest and not overflow
