"""Commands of a task reach the executor once, and none that a later one has superseded."""

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
from common.process.task_runner import NOT_ANSWERED, TaskRunner
from common.tasks.monitoring import LivenessWatchdog
from common.tasks.stages import Command, View
from common.time_source import wall_ns
from common.transport.bus import Bus
from common.transport.local import LocalNetwork

POINT = m.JointTrajectoryPoint(time_from_start=0.0, positions=[0.0], velocities=[0.0], accelerations=[0.0])
GO = m.ExecuteRequest(id="go", trajectory=m.JointTrajectory(joint_names=["j"], points=[POINT]))
HOLD = {"pause": m.HoldRequest(hold=True), "resume": m.HoldRequest(hold=False)}


class Script:
    """A task that requests a motion in its first step, and forwards each command as a hold or stop."""

    def __init__(self) -> None:
        self.status = PickPlaceStatus()
        self.first: list[Command] = [GO]
        self.also: list[Command] = []  # sent along with every command

    def step(self, view: Any) -> list[Command]:
        commands, self.first = self.first, []
        return commands

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
    """A fake executor that records requests."""

    def __init__(self, net: LocalNetwork) -> None:
        self.bus, self.requests = net.bus("trajectory_executor"), asyncio.Queue[m.Message]()
        self.interlocks: list[m.Interlock] = []
        for topic in (topics.MOTION_EXECUTE, topics.MOTION_STOP, topics.MOTION_HOLD):
            self.bus.serve(topic, self.note)  # type: ignore[arg-type]

    async def note(self, request: m.Message) -> m.MotionStatus:
        self.requests.put_nowait(request)
        return m.MotionStatus(state="active", interlocks=self.interlocks)

    async def next(self) -> m.Message:
        async with asyncio.timeout(30):
            return await self.requests.get()

    async def next_release(self) -> int | None:
        """Return up to which time the next request, a release, acknowledges interlocks [ns]."""
        request = await self.next()
        assert isinstance(request, m.HoldRequest)
        assert request.model_copy(update={"acknowledged": None}) == HOLD["resume"]
        return request.acknowledged


async def command(net: LocalNetwork, *commands: str) -> str:
    """Send commands to the task; return its reply to the last one."""
    client, reply = net.bus("operator").client(topics.TASK_COMMAND), ""
    for name in commands:
        reply = (await client.call(m.TaskCommand.model_validate({"command": name}))).message
    return reply


async def test_reply_says_that_a_command_is_lost_while_no_executor_answers() -> None:
    net = LocalNetwork()
    async with running(net):
        assert NOT_ANSWERED in await command(net, "stop")
        await (executor := Executor(net)).bus.ready()
        await executor.next()
        assert NOT_ANSWERED not in await command(net, "pause")


async def test_pause_and_resume_reach_the_executor_in_order() -> None:
    net = LocalNetwork()
    executor = Executor(net)
    await executor.bus.ready()
    async with running(net):
        assert await executor.next() == GO
        await command(net, "pause")
        assert await executor.next() == HOLD["pause"]
        await command(net, "resume")
        assert await executor.next_release()


async def test_late_executor_receives_the_newest_hold_and_no_motion_after_a_stop() -> None:
    net = LocalNetwork()
    async with running(net):
        await command(net, "pause", "resume", "pause", "stop")
        executor = Executor(net)
        await executor.bus.ready()
        requests = [await executor.next(), await executor.next()]
        assert sorted(type(request).__name__ for request in requests) == ["HoldRequest", "StopRequest"]
        assert HOLD["pause"] in requests
        await command(net, "resume")
        assert await executor.next_release()
        assert executor.requests.empty()


async def test_late_executor_receives_the_pauses_of_two_operators() -> None:
    net = LocalNetwork()
    async with running(net):
        client = net.bus("person").client(topics.TASK_COMMAND)
        for operator in ("alice", "bob"):
            await client.call(m.TaskCommand(command="pause", by=operator))
        executor = Executor(net)
        await executor.bus.ready()
        requests = [await executor.next() for _ in range(3)]
        assert {request.owner for request in requests if isinstance(request, m.HoldRequest)} == {"alice", "bob"}


async def test_delayed_resume_releases_no_interlock_that_is_newer_than_its_request() -> None:
    net, fast = LocalNetwork(), Clock(10.0, wall_ns() - 3_600_000_000_000)  # `since` is no cell time
    async with running(net, clock=fast):
        before = wall_ns()
        await command(net, "resume")
        executor = Executor(net)
        await executor.bus.ready()
        requests = [await executor.next(), await executor.next()]
        seen = [request.acknowledged for request in requests if isinstance(request, m.HoldRequest)]
        assert seen[0] is not None and before <= seen[0] <= wall_ns()


async def test_delayed_resume_releases_its_own_pause_but_no_stop_of_another_operator_in_between() -> None:
    for stopped, released_until in ((0, 2), (1, 0), (3, 2)):
        net, since = LocalNetwork(), 2 * wall_ns()
        interlocks = [m.Interlock(kind="held", by="operator", since=since + 2)]
        interlocks += [m.Interlock(kind="stopped", by="bob", since=since + stopped)] if stopped else []
        async with running(net):
            await command(net, "pause", "resume")
            executor = Executor(net)
            executor.interlocks = interlocks
            await executor.bus.ready()
            requests = [await executor.next() for _ in range(3)]
            released = [each for each in requests if isinstance(each, m.HoldRequest) and not each.hold]
            seen = [each.acknowledged for each in released]
            assert (seen == [since + released_until]) if released_until else (seen[0] is not None and seen[0] < since)


async def test_delayed_resume_releases_its_pause_despite_a_watchdog_hold() -> None:
    net, since = LocalNetwork(), 2 * wall_ns()
    async with running(net):
        await command(net, "pause", "resume")
        executor = Executor(net)
        executor.interlocks = [m.Interlock(kind="held", by="watchdog", since=since),
                             m.Interlock(kind="held", by="operator", since=since + 1)]
        await executor.bus.ready()
        requests = [await executor.next() for _ in range(3)]
        seen = [request.acknowledged for request in requests if isinstance(request, m.HoldRequest) and not request.hold]
        assert seen == [since + 1]


async def test_reply_to_a_resume_that_a_stop_supersedes_does_not_call_it_pending() -> None:
    net = LocalNetwork()
    executor = Executor(net)
    await executor.bus.ready()
    async with running(net):
        client = net.bus("person").client(topics.TASK_COMMAND)
        async with asyncio.TaskGroup() as group:
            resumed = group.create_task(client.call(m.TaskCommand(command="resume")))
            group.create_task(client.call(m.TaskCommand(command="stop")))
        assert NOT_ANSWERED not in resumed.result().message


async def test_refused_or_damaged_stop_and_pause_are_sent_again() -> None:
    net, accepted = LocalNetwork(), asyncio.Queue[m.Message]()
    codes = {m.StopRequest: ["busy", "internal", "invalid"], m.HoldRequest: ["invalid", "busy"]}

    async def note(request: m.StopRequest | m.HoldRequest) -> m.MotionStatus:
        if codes[type(request)]:
            raise Refused(codes[type(request)].pop(), "not now")
        accepted.put_nowait(request)
        return m.MotionStatus()

    executor = net.bus("trajectory_executor")
    executor.serve(topics.MOTION_STOP, note)
    executor.serve(topics.MOTION_HOLD, note)
    await executor.ready()
    async with running(net), asyncio.timeout(30):
        for name, request in (("pause", HOLD["pause"]), ("stop", m.StopRequest(reason="stop"))):
            assert NOT_ANSWERED not in await command(net, name)
            assert await accepted.get() == request


async def test_holds_of_a_watchdog_and_an_operator_are_independent() -> None:
    net = LocalNetwork()
    watchdog = m.HoldRequest(hold=True, reason="no joint states", by="watchdog")
    async with running(net, watchdog):
        await command(net, "pause")
        executor = Executor(net)
        await executor.bus.ready()
        requests = [await executor.next() for _ in range(3)]
        assert watchdog in requests and HOLD["pause"] in requests and GO in requests


class Idle(Script):
    """A task that requests no motion."""

    def __init__(self) -> None:
        super().__init__()
        self.first = []


async def test_missing_joint_states_are_reported_and_hold_the_arm_until_they_return() -> None:
    net = LocalNetwork()
    executor = Executor(net)
    await executor.bus.ready()
    view = View(now=0.0, motion=m.MotionStatus(id="go", state="active"))

    async def run(bus: Bus, config: None) -> None:
        joints = bus.reader(topics.JOINT_STATES)
        watchdog = LivenessWatchdog(lambda: joints.received, lambda: 0.2)
        writer = bus.writer(PICK_PLACE_STATUS)
        runner = TaskRunner(bus, Idle(), lambda: view, writer, lambda: 1.0, watchdog)
        await bus.ready()
        await runner.run(())

    operator = net.bus("operator")
    status, joints = operator.reader(PICK_PLACE_STATUS), executor.bus.writer(topics.JOINT_STATES)
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


async def test_repeatedly_refused_motion_is_requested_at_growing_intervals() -> None:
    net, times, errors = LocalNetwork(), [], set()
    loop = asyncio.get_running_loop()
    enough = asyncio.Event()

    class Persistent(Script):
        def on_goal(self, answer: m.MotionStatus | m.GripperState, view: Any) -> None:
            super().on_goal(answer, view)
            errors.add(answer.error)

        def step(self, view: Any) -> list[Command]:
            repeat, self.status.message = not times or self.status.message == "rejected", ""
            gripper = m.GripperCommand(id=f"{len(times)}", width=0.0)
            arm = m.ExecuteRequest(id=f"{len(times)}", trajectory=m.JointTrajectory(joint_names=["a"], points=[]))
            return [gripper if len(times) % 2 else arm] if repeat else []

    def note() -> None:
        times.append(loop.time())
        if len(times) == 6:
            enough.set()

    async def refuse(request: m.ExecuteRequest) -> m.MotionStatus:
        note()
        return m.MotionStatus(id=request.id, state="rejected", error="clock_ahead")

    async def refuse_gripper(request: m.GripperCommand) -> m.GripperState:
        note()
        raise Refused("clock_ahead", "the same")

    executor = net.bus("trajectory_executor")
    executor.serve(topics.MOTION_EXECUTE, refuse)
    executor.serve(topics.GRIPPER_COMMAND, refuse_gripper)
    await executor.ready()

    async def run(bus: Bus, config: None) -> None:
        runner = TaskRunner(bus, Persistent(), lambda: None, bus.writer(PICK_PLACE_STATUS), lambda: 1.0)
        await bus.ready()
        await runner.run(())

    async with running_service(net, run, None, name="smart_pick_place"), asyncio.timeout(30):
        await enough.wait()
    assert errors == {"clock_ahead"}
    waits = [after - before for before, after in pairwise(times)]
    assert waits[1] >= 0.1 and waits[2] >= 0.2 and waits[3] >= 0.4 and waits[4] >= 0.8
