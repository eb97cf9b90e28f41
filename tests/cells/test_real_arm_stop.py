"""A stop of a real arm in a simulated world, which no later run releases, whatever its cell and domain are called."""

import asyncio

import pytest

from common import topics
from common.transport.endpoint import endpoint_of
from common.transport.zenoh_session import connect
from tests.harness import PATIENCE, Place, free_domain, until

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]

REAL = ("--no-viewer", "--set", "robot.hardware.backend=tests.cells.mock_real_arm", "--set",
        "robot.hardware.options.host=10.0.0.5")


async def test_stop_of_a_real_arm_blocks_every_later_run_in_any_domain(tmp_path):
    place = Place(tmp_path, free_domain())
    elsewhere = Place(tmp_path, free_domain())
    try:
        command = place.start("up", "panda", *REAL)
        command.until("zenoh --mode client")
        await asyncio.to_thread(place.say, "task", "stop")
        command.interrupt()
        assert command.end() == 0

        run = elsewhere.start("run", "panda", *REAL)
        assert "`zencell task start` lets it continue" in run.until("panda is stopped since")
        async with connect(
            cell="panda", service="watcher", endpoint=endpoint_of(elsewhere.domain), timeout=PATIENCE
        ) as bus:
            joints = bus.reader(topics.JOINT_STATES)
            first = await joints.next()
            later = await until(joints, lambda state: state.header.stamp > first.header.stamp + 2_000_000_000)
            assert later.position == first.position
        run.interrupt()
        run.end()
        assert [path.name for path in tmp_path.rglob("arm-*.inhibits.json")] == [
            "arm-tests.cells.mock_real_arm-10.0.0.5.inhibits.json"]
    finally:
        place.end()
        elsewhere.end()
