"""Commands of a task reach the executor once, and none that a later one has superseded."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from itertools import pairwise
from typing import Any

import pytest

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
from common.transport.bus import Bus, Client
from common.transport.local import LocalNetwork

POINT = m.JointTrajectoryPoint(time_from_start=0.0, positions=[0.0], velocities=[0.0], accelerations=[0.0])
GO = m.ExecuteRequest(id="go", trajectory=m.JointTrajectory(joint_names=["j"], points=[POINT]))
HOLD = {"pause": m.HoldRequest(hold=True), "resume": m.HoldRequest(hold=False)}


class Script:
    """A task that requests motions in its first step, and forwards each command as a hold or stop."""

    def __init__(self, first: list[Command], also: list[Command]) -> None:
        self.status = PickPlaceStatus()
        self.first, self.also = first, also  # the latter are sent along with every command

    def step(self, view: Any) -> list[Command]:
        commands, self.first = self.first, []
        return commands

    def command(self, command: str, view: Any) -> list[Command]:
        return [HOLD[command].model_copy() if command in HOLD else m.StopRequest(reason=command), *self.also]

    def on_plan(self, response: m.PlanResponse, view: Any) -> None:
        raise AssertionError

    def on_goal(self, answer: m.MotionStatus | m.GripperState, view: Any) -> None:
        self.status.message = answer.state


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


class Rig:
    """A running task, an operator, and an executor that may start late."""

    def __init__(self) -> None:
        self.net = LocalNetwork()
        self.client: Client[m.TaskCommand, m.TaskStatus] = self.net.bus("operator").client(topics.TASK_COMMAND)

    @asynccontextmanager
    async def running(
        self, *also: Command, script: Script | None = None, clock: Clock | None = None, view: View | None = None,
        watched: bool = False,
    ) -> AsyncIterator[None]:
        async def run(bus: Bus, config: None) -> None:
            joints = bus.reader(topics.JOINT_STATES)
            watchdog = [LivenessWatchdog(lambda: joints.received, lambda: 0.2)] if watched else []
            task = script or Script([GO], list(also))
            runner = TaskRunner(bus, task, lambda: view, bus.writer(PICK_PLACE_STATUS), lambda: 1.0, *watchdog)
            await bus.ready()
            await runner.run(())

        async with running_service(self.net, run, None, name="smart_pick_place", clock=clock), asyncio.timeout(30):
            yield

    async def executor(self, *interlocks: m.Interlock) -> Executor:
        executor = Executor(self.net)
        executor.interlocks = list(interlocks)
        await executor.bus.ready()
        return executor

    async def command(self, *commands: str, by: str = "") -> str:
        """Send commands to the task; return its reply to the last one."""
        reply = ""
        for name in commands:
            reply = (await self.client.call(m.TaskCommand.model_validate({"command": name, "by": by}))).message
        return reply


@pytest.fixture
async def rig() -> Rig:
    return Rig()


async def test_reply_says_that_a_command_is_lost_while_no_executor_answers(rig: Rig) -> None:
    async with rig.running():
        assert NOT_ANSWERED in await rig.command("stop")
        await (await rig.executor()).next()
        assert NOT_ANSWERED not in await rig.command("pause")


async def test_reply_has_the_counts_and_figures_of_the_status(rig: Rig) -> None:
    await rig.executor()
    script = Script([GO], [])
    script.status = PickPlaceStatus(total=7, done=3, failures=2, figures={"x": 1.5}, started=True)
    async with rig.running(script=script):
        reply = await rig.client.call(m.TaskCommand(command="pause"))
        assert (reply.total, reply.done, reply.failures, reply.figures) == (7, 3, 2, {"x": 1.5})


async def test_pause_and_resume_reach_the_executor_in_order(rig: Rig) -> None:
    executor = await rig.executor()
    async with rig.running():
        assert await executor.next() == GO
        await rig.command("pause")
        assert await executor.next() == HOLD["pause"]
        await rig.command("resume")
        assert await executor.next_release()


async def test_late_executor_receives_the_newest_hold_and_no_motion_after_a_stop(rig: Rig) -> None:
    async with rig.running():
        await rig.command("pause", "resume", "pause", "stop")
        executor = await rig.executor()
        requests = [await executor.next(), await executor.next()]
        assert sorted(type(request).__name__ for request in requests) == ["HoldRequest", "StopRequest"]
        assert HOLD["pause"] in requests
        await rig.command("resume")
        assert await executor.next_release()
        assert executor.requests.empty()


async def test_late_executor_receives_the_pauses_of_two_operators(rig: Rig) -> None:
    async with rig.running():
        for operator in ("alice", "bob"):
            await rig.command("pause", by=operator)
        executor = await rig.executor()
        requests = [await executor.next() for _ in range(3)]
        assert {request.owner for request in requests if isinstance(request, m.HoldRequest)} == {"alice", "bob"}


async def test_delayed_resume_releases_no_interlock_that_is_newer_than_its_request(rig: Rig) -> None:
    fast = Clock(10.0, wall_ns() - 3_600_000_000_000)  # `since` is no cell time
    async with rig.running(clock=fast):
        before = wall_ns()
        await rig.command("resume")
        executor = await rig.executor()
        requests = [await executor.next(), await executor.next()]
        seen = [request.acknowledged for request in requests if isinstance(request, m.HoldRequest)]
        assert seen[0] is not None and before <= seen[0] <= wall_ns()


@pytest.mark.parametrize(("interlocks", "released"), [
    ([("held", "operator", 2)], 2),
    ([("held", "operator", 2), ("stopped", "bob", 1)], None),
    ([("held", "operator", 2), ("stopped", "bob", 3)], 2),
    ([("held", "watchdog", 0), ("held", "operator", 1)], 1),
], ids=["own pause", "stop of another operator in between", "later stop of another operator", "hold of a watchdog"])
async def test_delayed_resume_releases_up_to_its_own_pause(rig: Rig, interlocks, released: int | None) -> None:
    start = 2 * wall_ns()
    async with rig.running():
        await rig.command("pause", "resume")
        executor = await rig.executor(*(
            m.Interlock.model_validate({"kind": kind, "by": by, "since": start + since})
            for kind, by, since in interlocks))
        requests = [await executor.next() for _ in range(3)]
        (seen,) = [each.acknowledged for each in requests if isinstance(each, m.HoldRequest) and not each.hold]
        assert seen is not None
        assert seen < start if released is None else seen == start + released


async def test_reply_to_a_resume_that_a_stop_supersedes_does_not_call_it_pending(rig: Rig) -> None:
    await rig.executor()
    async with rig.running(), asyncio.TaskGroup() as group:
        resumed = group.create_task(rig.command("resume"))
        group.create_task(rig.command("stop"))
    assert NOT_ANSWERED not in resumed.result()


async def test_refused_or_damaged_stop_and_pause_are_sent_again(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("common.process.timing.RETRY_PERIOD", 0.01)
    accepted = asyncio.Queue[m.Message]()
    codes = {m.StopRequest: ["busy", "internal", "invalid"], m.HoldRequest: ["invalid", "busy"]}

    async def note(request: m.StopRequest | m.HoldRequest) -> m.MotionStatus:
        if codes[type(request)]:
            raise Refused(codes[type(request)].pop(), "not now")
        accepted.put_nowait(request)
        return m.MotionStatus()

    executor = rig.net.bus("trajectory_executor")
    executor.serve(topics.MOTION_STOP, note)
    executor.serve(topics.MOTION_HOLD, note)
    await executor.ready()
    async with rig.running():
        for name, request in (("pause", HOLD["pause"]), ("stop", m.StopRequest(reason="stop"))):
            assert NOT_ANSWERED not in await rig.command(name)
            assert await accepted.get() == request


async def test_holds_of_a_watchdog_and_an_operator_are_independent(rig: Rig) -> None:
    watchdog = m.HoldRequest(hold=True, reason="no joint states", by="watchdog")
    async with rig.running(watchdog):
        await rig.command("pause")
        executor = await rig.executor()
        requests = [await executor.next() for _ in range(3)]
        assert watchdog in requests and HOLD["pause"] in requests and GO in requests


async def test_missing_joint_states_are_reported_and_hold_the_arm_until_they_return(rig: Rig) -> None:
    executor = await rig.executor()
    view = View(now=0.0, motion=m.MotionStatus(id="go", state="active"))
    status, joints = rig.net.bus("reader").reader(PICK_PLACE_STATUS), executor.bus.writer(topics.JOINT_STATES)
    state = m.JointState(header=m.Header(stamp=1), name=["j"], position=[0.0])
    async with rig.running(script=Script([], []), view=view, watched=True):
        joints.put(state)
        hold = await executor.next()
        assert isinstance(hold, m.HoldRequest) and hold.hold and hold.by == "watchdog"
        while (await status.next()).message != "the arm waits: no joint states for 200 ms":
            pass
        assert view.trouble
        joints.put(state)
        release = await executor.next()
        assert isinstance(release, m.HoldRequest) and not release.hold and release.by == "watchdog"


async def test_repeatedly_refused_motion_is_requested_at_growing_intervals(rig: Rig, monkeypatch) -> None:
    delay = 0.02  # [s]
    monkeypatch.setattr("common.process.task_requests.REFUSAL_DELAY", delay)
    times, errors, enough = [], set(), asyncio.Event()

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
        times.append(asyncio.get_running_loop().time())
        if len(times) == 6:
            enough.set()

    async def refuse(request: m.ExecuteRequest) -> m.MotionStatus:
        note()
        return m.MotionStatus(id=request.id, state="rejected", error="clock_ahead")

    async def refuse_gripper(request: m.GripperCommand) -> m.GripperState:
        note()
        raise Refused("clock_ahead", "the same")

    executor = rig.net.bus("trajectory_executor")
    executor.serve(topics.MOTION_EXECUTE, refuse)
    executor.serve(topics.GRIPPER_COMMAND, refuse_gripper)
    await executor.ready()
    async with rig.running(script=Persistent([], [])):
        await enough.wait()
    assert errors == {"clock_ahead"}
    waits = [after - before for before, after in pairwise(times)]
    assert all(wait >= delay * 2**doublings for doublings, wait in enumerate(waits[1:]))
