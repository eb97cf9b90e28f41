"""What a task asks for reaches the controller, once, and nothing that was made void since."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from itertools import pairwise
from typing import Any

from applications.pick_place.topics import PICK_PLACE_STATUS, PickPlaceStatus
from common import messages as m
from common import topics
from common.clock import Clock
from common.errors import Refused
from common.process.in_process import running_service
from common.process.task_runner import TaskRunner
from common.tasks.monitoring import LivenessWatchdog
from common.tasks.stages import Command, View
from common.time_source import wall_ns
from common.transport.bus import Bus
from common.transport.local import LocalNetwork

POINT = m.JointTrajectoryPoint(time_from_start=0.0, positions=[0.0], velocities=[0.0], accelerations=[0.0])
GO = m.ExecuteRequest(id="go", trajectory=m.JointTrajectory(joint_names=["j"], points=[POINT]))
HOLD = {"pause": m.HoldRequest(hold=True), "resume": m.HoldRequest(hold=False)}


class Script:
    """A task that asks for a motion at once, and for what a command stands for."""

    def __init__(self) -> None:
        self.status = PickPlaceStatus()
        self.first: list[Command] = [GO]
        self.also: list[Command] = []  # together with every command

    def step(self, view: Any) -> list[Command]:
        asked, self.first = self.first, []
        return asked

    def command(self, command: str, view: Any) -> list[Command]:
        return [HOLD[command].model_copy() if command in HOLD else m.StopRequest(reason=command), *self.also]

    def on_plan(self, response: m.PlanResponse, view: Any) -> None:
        raise AssertionError

    def on_goal(self, answer: m.MotionStatus | m.GripperState, view: Any) -> None:
        self.status.message = answer.state


@asynccontextmanager
async def running(net: LocalNetwork, *also: Command, clock: Clock | None = None) -> AsyncIterator[Bus]:
    async def run(bus: Bus, config: None) -> None:
        script = Script()
        script.also = list(also)
        runner = TaskRunner(bus, script, lambda: None, bus.writer(PICK_PLACE_STATUS), lambda: 1.0)
        await bus.ready()
        await runner.run(())

    async with running_service(net, run, None, name="smart_pick_place", clock=clock) as bus:
        yield bus


class Executor:
    """Comes up late and notes what it is asked."""

    def __init__(self, net: LocalNetwork) -> None:
        self.bus, self.asked = net.bus("trajectory_executor"), asyncio.Queue[m.Message]()
        self.interlocks: list[m.Interlock] = []
        for topic in (topics.MOTION_EXECUTE, topics.MOTION_STOP, topics.MOTION_HOLD):
            self.bus.serve(topic, self.note)  # type: ignore[arg-type]

    async def note(self, request: m.Message) -> m.MotionStatus:
        self.asked.put_nowait(request)
        return m.MotionStatus(state="active", interlocks=self.interlocks)

    async def next(self) -> m.Message:
        async with asyncio.timeout(30):
            return await self.asked.get()


    async def let_go(self) -> int | None:
        """Until when what was said is let go of by what is asked next."""
        request = await self.next()
        assert isinstance(request, m.HoldRequest)
        assert request.model_copy(update={"acknowledged": None}) == HOLD["resume"]
        return request.acknowledged


async def tell(net: LocalNetwork, *commands: str) -> str:
    """Tell the task so; what it said of the last one."""
    client, said = net.bus("person").client(topics.TASK_COMMAND), ""
    for command in commands:
        said = (await client.call(m.TaskCommand.model_validate({"command": command}))).message
    return said


async def test_person_is_told_that_what_they_said_was_kept_by_nobody_yet() -> None:
    net = LocalNetwork()
    async with running(net):
        assert "is lost when the task ends" in await tell(net, "stop")
        await (executor := Executor(net)).bus.ready()
        await executor.next()
        assert "outlive" not in await tell(net, "pause")


async def test_pause_and_resume_reach_the_executor_in_order() -> None:
    net = LocalNetwork()
    executor = Executor(net)
    await executor.bus.ready()
    async with running(net):
        assert await executor.next() == GO
        await tell(net, "pause")
        assert await executor.next() == HOLD["pause"]
        await tell(net, "resume")
        assert await executor.let_go()


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
        assert await executor.let_go()
        assert executor.asked.empty()


async def test_pauses_of_two_persons_both_reach_an_executor_that_comes_up_late() -> None:
    net = LocalNetwork()
    async with running(net):
        client = net.bus("person").client(topics.TASK_COMMAND)
        for person in ("alice", "bob"):
            await client.call(m.TaskCommand(command="pause", by=person))
        executor = Executor(net)
        await executor.bus.ready()
        asked = [await executor.next() for _ in range(3)]
        assert {request.owner for request in asked if isinstance(request, m.HoldRequest)} == {"alice", "bob"}


async def test_start_that_waits_for_an_executor_does_not_let_go_of_what_is_said_meanwhile() -> None:
    net, fast = LocalNetwork(), Clock(10.0, wall_ns() - 3_600_000_000_000)  # `since` is no cell time
    async with running(net, clock=fast):
        before = wall_ns()
        await tell(net, "resume")
        executor = Executor(net)
        await executor.bus.ready()
        asked = [await executor.next(), await executor.next()]
        seen = [request.acknowledged for request in asked if isinstance(request, m.HoldRequest)]
        assert seen[0] is not None and before <= seen[0] <= wall_ns()


async def test_start_that_waits_for_an_answer_lets_go_of_that_but_of_no_stop_that_another_said_in_between() -> None:
    for stopped, lets_go_of in ((0, 2), (1, 0), (3, 2)):
        net, since = LocalNetwork(), 2 * wall_ns()
        said = [m.Interlock(kind="held", by="operator", since=since + 2)]
        said += [m.Interlock(kind="stopped", by="bob", since=since + stopped)] if stopped else []
        async with running(net):
            await tell(net, "pause", "resume")
            executor = Executor(net)
            executor.interlocks = said
            await executor.bus.ready()
            asked = [await executor.next() for _ in range(3)]
            released = [each for each in asked if isinstance(each, m.HoldRequest) and not each.hold]
            seen = [each.acknowledged for each in released]
            assert (seen == [since + lets_go_of]) if lets_go_of else (seen[0] is not None and seen[0] < since)


async def test_a_resume_lets_go_of_the_pause_that_it_waited_for_whatever_watchdogs_held_meanwhile() -> None:
    net, since = LocalNetwork(), 2 * wall_ns()
    async with running(net):
        await tell(net, "pause", "resume")
        executor = Executor(net)
        executor.interlocks = [m.Interlock(kind="held", by="watchdog", since=since),
                             m.Interlock(kind="held", by="operator", since=since + 1)]
        await executor.bus.ready()
        asked = [await executor.next() for _ in range(3)]
        seen = [request.acknowledged for request in asked if isinstance(request, m.HoldRequest) and not request.hold]
        assert seen == [since + 1]


async def test_who_says_what_a_stop_makes_void_at_once_is_not_told_that_it_is_still_asked_for() -> None:
    net = LocalNetwork()
    executor = Executor(net)
    await executor.bus.ready()
    async with running(net):
        client = net.bus("person").client(topics.TASK_COMMAND)
        async with asyncio.TaskGroup() as group:
            resumed = group.create_task(client.call(m.TaskCommand(command="resume")))
            group.create_task(client.call(m.TaskCommand(command="stop")))
        assert "outlive" not in resumed.result().message


async def test_stop_and_pause_that_were_not_taken_or_came_damaged_are_asked_for_again() -> None:
    net, asked = LocalNetwork(), asyncio.Queue[m.Message]()
    codes = {m.StopRequest: ["busy", "internal", "invalid"], m.HoldRequest: ["invalid", "busy"]}

    async def note(request: m.StopRequest | m.HoldRequest) -> m.MotionStatus:
        if codes[type(request)]:
            raise Refused(codes[type(request)].pop(), "not now")
        asked.put_nowait(request)
        return m.MotionStatus()

    executor = net.bus("trajectory_executor")
    executor.serve(topics.MOTION_STOP, note)
    executor.serve(topics.MOTION_HOLD, note)
    await executor.ready()
    async with running(net), asyncio.timeout(30):
        for said, request in (("pause", HOLD["pause"]), ("stop", m.StopRequest(reason="stop"))):
            assert "outlive" not in await tell(net, said)
            assert await asked.get() == request


async def test_a_watchdog_and_a_person_do_not_make_each_others_holds_void() -> None:
    net = LocalNetwork()
    watchdog = m.HoldRequest(hold=True, reason="no joint states", by="watchdog")
    async with running(net, watchdog):
        await tell(net, "pause")
        executor = Executor(net)
        await executor.bus.ready()
        asked = [await executor.next() for _ in range(3)]
        assert watchdog in asked and HOLD["pause"] in asked and GO in asked


class Silent(Script):
    """A task that asks for nothing by itself."""

    def __init__(self) -> None:
        super().__init__()
        self.first = []


async def test_what_is_missing_is_told_in_the_status_and_holds_the_arm_until_it_is_back() -> None:
    net = LocalNetwork()
    executor = Executor(net)
    await executor.bus.ready()
    view = View(now=0.0, motion=m.MotionStatus(id="go", state="active"))

    async def run(bus: Bus, config: None) -> None:
        joints = bus.reader(topics.JOINT_STATES)
        watchdog = LivenessWatchdog(lambda: joints.received, lambda: 0.2)
        writer = bus.writer(PICK_PLACE_STATUS)
        runner = TaskRunner(bus, Silent(), lambda: view, writer, lambda: 1.0, watchdog)
        await bus.ready()
        await runner.run(())

    person = net.bus("person")
    status, joints = person.reader(PICK_PLACE_STATUS), executor.bus.writer(topics.JOINT_STATES)
    async with running_service(net, run, None, name="smart_pick_place"):
        joints.put(m.JointState(header=m.Header(stamp=1), name=["j"], position=[0.0]))
        hold = await executor.next()
        assert isinstance(hold, m.HoldRequest) and hold.hold and hold.by == "watchdog"
        async with asyncio.timeout(30):
            while (await status.next()).message != "the arm waits: no joint states for 200 ms":
                pass
        assert view.trouble
        joints.put(m.JointState(header=m.Header(stamp=1), name=["j"], position=[0.0]))
        release = await executor.next()
        assert isinstance(release, m.HoldRequest) and not release.hold and release.by == "watchdog"


async def test_motion_that_is_refused_again_and_again_is_asked_for_more_and_more_slowly() -> None:
    net, asked, told = LocalNetwork(), [], set()
    loop = asyncio.get_running_loop()
    enough = asyncio.Event()

    class Stubborn(Script):
        def on_goal(self, answer: m.MotionStatus | m.GripperState, view: Any) -> None:
            super().on_goal(answer, view)
            told.add(answer.error)

        def step(self, view: Any) -> list[Command]:
            again, self.status.message = not asked or self.status.message == "rejected", ""
            fingers = m.GripperCommand(id=f"{len(asked)}", width=0.0)
            arm = m.ExecuteRequest(id=f"{len(asked)}", trajectory=m.JointTrajectory(joint_names=["a"], points=[]))
            return [fingers if len(asked) % 2 else arm] if again else []

    def note() -> None:
        asked.append(loop.time())
        if len(asked) == 6:
            enough.set()

    async def refuse(request: m.ExecuteRequest) -> m.MotionStatus:
        note()
        return m.MotionStatus(id=request.id, state="rejected", error="clock_ahead")

    async def refuse_fingers(request: m.GripperCommand) -> m.GripperState:
        note()
        raise Refused("clock_ahead", "the same")

    executor = net.bus("trajectory_executor")
    executor.serve(topics.MOTION_EXECUTE, refuse)
    executor.serve(topics.GRIPPER_COMMAND, refuse_fingers)
    await executor.ready()

    async def run(bus: Bus, config: None) -> None:
        runner = TaskRunner(bus, Stubborn(), lambda: None, bus.writer(PICK_PLACE_STATUS), lambda: 1.0)
        await bus.ready()
        await runner.run(())

    async with running_service(net, run, None, name="smart_pick_place"), asyncio.timeout(30):
        await enough.wait()
    assert told == {"clock_ahead"}
    waits = [after - before for before, after in pairwise(asked)]
    assert waits[1] >= 0.1 and waits[2] >= 0.2 and waits[3] >= 0.4 and waits[4] >= 0.8
