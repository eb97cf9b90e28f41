"""What a task asks for reaches the controller, once, and nothing that was made void since."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

from common import messages as m
from common import topics
from common.transport.bus import Bus
from common.transport.local import LocalNetwork
from common.transport.task_runner import Command, TaskRunner

POINT = m.JointTrajectoryPoint(time_from_start=0.0, positions=[0.0], velocities=[0.0], accelerations=[0.0])
GO = m.ExecuteRequest(id="go", trajectory=m.JointTrajectory(joint_names=["j"], points=[POINT]))
HOLD = {"pause": m.HoldRequest(hold=True), "resume": m.HoldRequest(hold=False)}


class Script:
    """A task that asks for a motion at once, and for what a command stands for."""

    def __init__(self) -> None:
        self.status = m.PickPlaceStatus()
        self.first: list[Command] = [GO]

    def step(self, view: Any) -> list[Command]:
        asked, self.first = self.first, []
        return asked

    def command(self, command: str, view: Any) -> list[Command]:
        return [HOLD.get(command, m.StopRequest(reason=command))]

    def on_plan(self, response: m.PlanResponse, view: Any) -> None:
        raise AssertionError

    def on_goal(self, answer: m.MotionStatus | m.GripperState, view: Any) -> None:
        self.status.message = answer.state


@asynccontextmanager
async def running(net: LocalNetwork) -> AsyncIterator[Bus]:
    async def run(bus: Bus, config: None) -> None:
        runner = TaskRunner(bus, Script(), lambda: None, bus.writer(topics.PICK_PLACE_STATUS), lambda: 1.0)
        await bus.ready()
        await runner.run(())

    async with net.running(run, None, name="smart_pick_place") as bus:
        yield bus


class Executor:
    """Comes up late and notes what it is asked."""

    def __init__(self, net: LocalNetwork) -> None:
        self.bus, self.asked = net.bus("trajectory_executor"), asyncio.Queue[m.Message]()
        for topic in (topics.MOTION_EXECUTE, topics.MOTION_STOP, topics.MOTION_HOLD):
            self.bus.serve(topic, self.note)  # type: ignore[arg-type]

    async def note(self, request: m.Message) -> m.MotionStatus:
        self.asked.put_nowait(request)
        return m.MotionStatus(state="active")

    async def next(self) -> m.Message:
        async with asyncio.timeout(10):
            return await self.asked.get()


async def tell(net: LocalNetwork, *commands: str) -> None:
    client = net.bus("person").client(topics.TASK_COMMAND)
    for command in commands:
        await client.call(m.TaskCommand.model_validate({"command": command}))


async def test_pause_and_resume_reach_the_executor_in_order() -> None:
    net = LocalNetwork()
    executor = Executor(net)
    await executor.bus.ready()
    async with running(net):
        assert await executor.next() == GO
        await tell(net, "pause")
        assert await executor.next() == HOLD["pause"]
        await tell(net, "resume")
        assert await executor.next() == HOLD["resume"]


async def test_only_the_newest_hold_and_no_motion_after_a_stop_reach_an_executor_that_comes_up_late() -> None:
    net = LocalNetwork()
    async with running(net):
        await tell(net, "pause", "resume", "pause", "stop")
        executor = Executor(net)
        await executor.bus.ready()
        asked = [await executor.next(), await executor.next()]
        assert sorted(type(request).__name__ for request in asked) == ["HoldRequest", "StopRequest"]
        assert HOLD["pause"] in asked
        await tell(net, "resume")
        assert await executor.next() == HOLD["resume"]
        assert executor.asked.empty()
