"""The executor's requests for belts follow the rules of motion, and a STOP stops them."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from common import messages as m
from common import topics
from common.errors import RemoteError
from tests.services.executor_rig import executor
from tests.services.fake_cell import latest

BELT = ('world.conveyors={"belt": {"dimensions": [1.0, 0.2, 0.05], "position": [0.5, -0.5, -0.025], "speed": 0.1}}',)


def test_belt_is_switched_by_its_owner_and_stopped_by_a_stop(tmp_path: Path) -> None:
    async def check() -> None:
        async with executor(*BELT) as client:
            states, set_ = client.reader(topics.CONVEYOR_STATE), client.client(topics.CONVEYOR_SET)
            first = await latest(states, lambda state: state.belts[0].position > 0.05)
            assert first.belts[0].speed == pytest.approx(0.1)
            changed = await set_.call(m.ConveyorSet(header=client.bus.header(), speed=0.2, owner="ann"))
            assert changed.belts[0].set_speed == 0.2
            await latest(states, lambda state: abs(state.belts[0].speed - 0.2) < 1e-6)
            await client.own.call(m.OwnRequest(act="take", owner="bob"))
            with pytest.raises(RemoteError, match="bob"):
                await set_.call(m.ConveyorSet(running=True, owner="ann"))
            await client.own.call(m.OwnRequest(act="give", owner="bob"))
            await client.own.call(m.OwnRequest(act="take", owner="a_task", kind="task"))
            with pytest.raises(RemoteError, match="a_task"):  # a request without an owner is not the task's
                await set_.call(m.ConveyorSet(running=True))
            with pytest.raises(ValueError, match="owner"):
                m.ConveyorSet(running=True, owner="")
            assert (await set_.call(m.ConveyorSet(running=True, owner="a_task"))).belts[0].running
            await client.own.call(m.OwnRequest(act="give", owner="a_task", kind="task"))
            await client.own.call(m.OwnRequest(act="take", owner="bob"))
            assert not (await set_.call(m.ConveyorSet(running=False, owner="ann"))).belts[0].running
            await set_.call(m.ConveyorSet(running=True, owner="bob"))
            await client.stop.call(m.StopRequest(by="operator", owner="cat"))
            stopped = await latest(states, lambda state: state.belts[0].speed == 0.0)
            assert not stopped.belts[0].running
            with pytest.raises(RemoteError, match="stopped"):
                await set_.call(m.ConveyorSet(running=True, owner="bob"))

    asyncio.run(check())
