"""The executor's topic of the wrench at the tool, and the request to zero it."""

import pytest

from common import messages as m
from common import topics
from common.control.force_sensing import NO_SENSOR
from common.errors import RequestFailed
from tests.services.executor_rig import executor
from tests.services.fake_cell import latest

PHYSICS = ("world.simulator=mujoco", "world.count=0")


async def test_kinematic_world_has_no_wrench_and_says_why() -> None:
    async with executor() as client:
        wrench = await latest(client.reader(topics.WRENCH))
        assert wrench.reason == NO_SENSOR and wrench.force is None and wrench.header.frame_id == "panda_hand_tcp"
        with pytest.raises(RequestFailed, match="no force sensor") as failed:
            await client.client(topics.WRENCH_ZERO).call(m.ZeroWrench(owner="anna"))
        assert failed.value.code == "no_wrench"


async def test_wrench_in_physics_is_zeroed_at_rest_and_not_in_motion() -> None:
    pytest.importorskip("mujoco")
    async with executor(*PHYSICS, speed=1.0) as client:
        wrenches, zero = client.reader(topics.WRENCH), client.client(topics.WRENCH_ZERO)
        first = await latest(wrenches, lambda wrench: wrench.force is not None)
        assert not first.zeroed
        await latest(wrenches, lambda wrench: wrench.header.stamp > first.header.stamp + 500_000_000)
        answer = await zero.call(m.ZeroWrench(header=client.bus.header(), owner="anna"))
        assert answer.zeroed and answer.force == m.Vector3()
        zeroed = await latest(wrenches, lambda wrench: wrench.zeroed)
        stamps = [zeroed.header.stamp, *[(await wrenches.next()).header.stamp for _ in range(20)]]
        assert stamps == sorted(set(stamps)), "one in each cycle"
        await client.move_slowly(until=0.02)
        with pytest.raises(RequestFailed, match="must be at rest") as failed:
            await zero.call(m.ZeroWrench(header=client.bus.header()))
        assert failed.value.code == "moving"
        with pytest.raises(RequestFailed, match="take it over first"):
            await zero.call(m.ZeroWrench(header=client.bus.header(), owner="anna"))
        with pytest.raises(RequestFailed, match="stale_request"):
            late = m.Header(stamp=client.bus.header().stamp - 100_000_000_000)
            await zero.call(m.ZeroWrench(header=late, owner="anna"))
