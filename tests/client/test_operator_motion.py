"""A person moves the robot: plan, execute, wait; refused while a task has it, stopped when it is given up."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from typing import Any, cast

import pytest

from applications.pick_place.topics import PICK_PLACE_STATUS, PickPlaceStatus
from common import messages as m
from common import topics
from common.client.arm import Arm
from common.client.operator_motion import MotionFailed, OperatorMotion
from common.client.subscriptions import Subscriptions
from common.errors import ConfigError
from common.sources import wall_ns
from common.transport.local import LocalNetwork

HOME = m.JointGoal(named="home")
POINT = m.JointTrajectoryPoint(time_from_start=0.0, positions=[0.0], velocities=[0.0], accelerations=[0.0])
WAY = m.JointTrajectory(joint_names=["j"], points=[POINT])


class Cell:
    """Planner and executor that answer as they are told, and note what they were asked."""

    def __init__(self, net: LocalNetwork) -> None:
        self.bus = net.bus("trajectory_executor")
        self.motion = self.bus.writer(topics.MOTION_STATUS)
        self.task = self.bus.writer(PICK_PLACE_STATUS)
        self.status = m.MotionStatus()
        self.asked: list[m.Message] = []
        self.came: asyncio.Queue[m.Message] = asyncio.Queue()
        self.no_way = ""
        self.refusal: tuple[str, str] | None = None
        self.ends = True
        for topic, handler in ((topics.MOTION_PLAN, self.plan), (topics.MOTION_EXECUTE, self.execute),
                               (topics.MOTION_STOP, self.stop), (topics.MOTION_HOLD, self.hold)):
            self.bus.serve(topic, handler)  # type: ignore[arg-type]

    def note(self, request: m.Message) -> None:
        self.asked.append(request)
        self.came.put_nowait(request)

    def say(self, **changes: object) -> m.MotionStatus:
        self.status = self.status.model_copy(update={"header": self.bus.header(), **changes})
        self.motion.put(self.status)
        return self.status

    async def plan(self, request: m.PlanRequest) -> m.PlanResponse:
        self.note(request)
        if self.no_way:
            return m.PlanResponse(id=request.id, ok=False, error=self.no_way, message=f"operator: {self.no_way}")
        return m.PlanResponse(id=request.id, ok=True, trajectory=WAY)

    async def execute(self, request: m.ExecuteRequest) -> m.MotionStatus:
        self.note(request)
        if self.refusal:
            code, message = self.refusal
            return m.MotionStatus(id=request.id, state="rejected", error=code, message=message)
        answer = self.say(id=request.id, state="active")
        if self.ends:
            self.say(state="succeeded", progress=1.0)
        return answer

    async def stop(self, request: m.StopRequest) -> m.MotionStatus:
        self.note(request)
        return self.say(state="cancelled", message=request.reason)

    async def hold(self, request: m.HoldRequest) -> m.MotionStatus:
        self.note(request)
        return self.say(held=request.hold)

    async def until(self, kind: type[m.Message]) -> m.Message:
        async with asyncio.timeout(30):
            while not isinstance(request := await self.came.get(), kind):
                pass
            return request




@pytest.fixture
async def cell() -> AsyncIterator[Cell]:
    made = Cell(LocalNetwork())
    await made.bus.ready()
    made.say()
    yield made
    await made.bus.close()


@pytest.fixture
def person(cell: Cell) -> OperatorMotion:
    return OperatorMotion(cell.bus, status_timeout=0.05)


def kinds(cell: Cell) -> list[str]:
    return [type(request).__name__ for request in cell.asked]


async def test_goal_is_planned_executed_and_waited_for(cell: Cell, person: OperatorMotion) -> None:
    status = await person.move(HOME, planner="lerp", straight=True)
    assert (status.state, status.progress) == ("succeeded", 1.0)
    plan, execute = cell.asked
    assert isinstance(plan, m.PlanRequest) and isinstance(execute, m.ExecuteRequest)
    assert (plan.goal, plan.planner, plan.straight, plan.start) == (HOME, "lerp", True, [])
    assert execute.trajectory == WAY


async def test_plan_alone_moves_nothing(cell: Cell, person: OperatorMotion) -> None:
    assert (await person.plan(HOME)).trajectory == WAY
    cell.no_way = "no_ik"
    assert (await person.plan(HOME)).error == "no_ik"
    assert kinds(cell) == ["PlanRequest"] * 2


async def test_way_that_can_not_be_planned_is_told_and_nothing_moves(cell: Cell, person: OperatorMotion) -> None:
    cell.no_way = "no_ik"
    with pytest.raises(MotionFailed, match="operator: no_ik") as caught:
        await person.move(HOME)
    assert caught.value.code == "no_ik" and kinds(cell) == ["PlanRequest"]


@pytest.mark.parametrize(
    ("said", "told"),
    [
        ({"started": True, "state": "GRASPING"}, "the task is GRASPING and has the robot: stop the task first"),
        ({"started": True, "state": "IDLE", "paused": True}, "the task is paused"),
    ],
)
async def test_robot_that_a_task_has_is_left_to_it(
    cell: Cell, person: OperatorMotion, said: dict[str, object], told: str
) -> None:
    cell.task.put(PickPlaceStatus.model_validate(said))
    with pytest.raises(MotionFailed, match=told):
        await person.move(HOME)
    assert cell.asked == []


@pytest.mark.parametrize("said", [{"started": True, "state": "DONE"}, {"started": True, "state": "IDLE"},
                                  {"started": False, "state": "GRASPING"}, {"started": True, "state": "ERROR"}])
async def test_robot_that_no_task_has_is_moved(cell: Cell, person: OperatorMotion, said: dict[str, object]) -> None:
    cell.task.put(PickPlaceStatus.model_validate(said))
    assert (await person.move(HOME)).state == "succeeded"


async def test_robot_that_is_held_with_nothing_to_do_is_let_go_first(cell: Cell, person: OperatorMotion) -> None:
    cell.say(held=True)
    await person.move(HOME)
    assert kinds(cell) == ["PlanRequest", "HoldRequest", "ExecuteRequest"]
    assert not cell.status.held


def said(kind: str, by: str, since: int) -> m.Interlock:
    return m.Interlock.model_validate({"kind": kind, "by": by, "since": since})


@pytest.mark.parametrize("kind", ["held", "stopped"])
async def test_robot_that_another_person_holds_or_stopped_is_left_alone(cell: Cell, kind: str) -> None:
    cell.say(held=kind == "held", interlocks=[said(kind, "anna", 7)])
    with pytest.raises(MotionFailed, match=rf"the robot is {kind} since .* by anna"):
        await OperatorMotion(cell.bus, owner="bert", status_timeout=0.05).move(HOME)
    assert cell.asked == []


async def test_what_is_said_while_a_motion_is_planned_is_not_known_to_who_asked_for_it_before(cell: Cell) -> None:
    cell.say(held=True, interlocks=[said("held", "anna", 7)])
    answer = cell.plan

    async def stopped(request: m.PlanRequest) -> m.PlanResponse:
        cell.say(held=True, interlocks=[said("held", "anna", 7), said("stopped", "anna", 8)])
        return await answer(request)

    next(s for s in cell.bus._servers if s.topic is topics.MOTION_PLAN)._handler = stopped
    await OperatorMotion(cell.bus, owner="anna", status_timeout=0.05).move(HOME)
    _, hold, execute = cell.asked
    assert isinstance(hold, m.HoldRequest) and (hold.owner, hold.into_stop, hold.acknowledged) == ("anna", True, 7)
    assert isinstance(execute, m.ExecuteRequest) and (execute.owner, execute.acknowledged) == ("anna", 7)


async def test_what_is_said_between_the_motions_of_a_row_is_not_known_to_the_later_ones(cell: Cell) -> None:
    cell.say(interlocks=[said("stopped", "anna", 8)])
    await OperatorMotion(cell.bus, owner="anna", status_timeout=0.05).move(HOME, acknowledged=7)
    assert isinstance(cell.asked[-1], m.ExecuteRequest) and cell.asked[-1].acknowledged == 7


async def test_motion_of_somebody_else_is_not_touched(
    cell: Cell, person: OperatorMotion, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("common.client.operator_motion.COME_TO_REST", 0.05)
    cell.say(id="other", state="active", held=True)
    with pytest.raises(MotionFailed, match="follows goal 'other'") as caught:
        await person.move(HOME)
    assert caught.value.code == "busy" and cell.asked == []


async def test_motion_that_is_being_stopped_is_waited_for(cell: Cell, person: OperatorMotion) -> None:
    cell.say(id="other", state="active", message="stopping: asked to")
    moving = asyncio.create_task(person.move(HOME))
    await asyncio.sleep(0)
    cell.say(state="cancelled")
    assert (await moving).state == "succeeded"


@pytest.mark.parametrize("waited_for", ["motion", "free"])
async def test_stop_while_the_motion_before_is_waited_for_keeps_the_robot(cell: Cell, waited_for: str) -> None:
    person = OperatorMotion(cell.bus, [], owner="anna")
    cell.say(id="before", state="active", interlocks=[said("stopped", "anna", 3)])
    asked = asyncio.create_task(person.move(HOME) if waited_for == "motion" else person.require_free())
    for _ in range(50):
        await asyncio.sleep(0)
    cell.say(state="cancelled", interlocks=[said("stopped", "anna", wall_ns())])
    with pytest.raises(MotionFailed, match=r"the robot is stopped since .* by anna"):
        await asked
    assert kinds(cell) == []


async def test_stop_that_the_same_person_said_before_the_motion_keeps_it_only_until_the_robot_rests(cell: Cell) -> None:
    person, since = OperatorMotion(cell.bus, [], owner="anna"), wall_ns()
    cell.say(id="before", state="active")
    moving = asyncio.create_task(person.move(HOME))
    for _ in range(50):
        await asyncio.sleep(0)
    cell.say(state="cancelled", interlocks=[said("stopped", "anna", since)])
    assert (await moving).state == "succeeded"


async def test_stop_that_a_person_says_while_a_motion_of_a_program_of_theirs_is_planned_keeps_the_robot(
    cell: Cell
) -> None:
    arm, note, since = Arm(Subscriptions(cell.bus), "anna", cast(Any, None)), cell.note, wall_ns()

    def stop_meanwhile(request: m.Message) -> None:
        note(request)
        if isinstance(request, m.PlanRequest):
            cell.say(interlocks=[said("stopped", "anna", since)])

    cell.note = stop_meanwhile  # type: ignore[method-assign]
    await arm.move("home")
    execute = cell.asked[-1]
    assert isinstance(execute, m.ExecuteRequest) and execute.acknowledged is not None and execute.acknowledged < since


async def test_task_that_begins_meanwhile_is_named(cell: Cell, person: OperatorMotion) -> None:
    cell.refusal = ("busy", "goal 't-1' is still being followed")
    with pytest.raises(MotionFailed, match="'t-1'"):
        await person.move(HOME)
    answer = cell.plan

    async def begin(request: m.PlanRequest) -> m.PlanResponse:
        cell.task.put(PickPlaceStatus(started=True, state="GRASPING"))
        return await answer(request)

    server = next(s for s in cell.bus._servers if s.topic is topics.MOTION_PLAN)
    server._handler = begin
    with pytest.raises(MotionFailed, match="the task is GRASPING"):
        await person.move(HOME)


async def test_cancelled_motion_stops_the_robot(cell: Cell, person: OperatorMotion) -> None:
    cell.ends = False
    moving = asyncio.create_task(person.move(HOME))
    execute = await cell.until(m.ExecuteRequest)
    moving.cancel()
    with pytest.raises(asyncio.CancelledError):
        await moving
    stop = cell.asked[-1]
    assert isinstance(stop, m.StopRequest) and isinstance(execute, m.ExecuteRequest) and stop.id == execute.id


@pytest.mark.parametrize("timeout", ["5", 0, -1.0, float("nan"), None])
async def test_time_that_nobody_can_wait_for_is_told_before_anything_moves(
    cell: Cell, person: OperatorMotion, timeout: Any
) -> None:
    cell.ends = False
    with pytest.raises(ConfigError, match="timeout: "):
        await person.move(HOME, timeout=timeout)
    assert kinds(cell) == ["PlanRequest"]


async def test_whatever_ends_the_wait_for_a_motion_stops_the_robot(
    cell: Cell, person: OperatorMotion, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def breaks(*_: object) -> m.MotionStatus:
        raise RuntimeError("a bug")

    monkeypatch.setattr(person, "_ended", breaks)
    with pytest.raises(RuntimeError, match="a bug"):
        await person.move(HOME)
    assert kinds(cell)[-1] == "StopRequest"


async def test_motion_without_progress_is_stopped_but_not_while_held(cell: Cell, person: OperatorMotion) -> None:
    cell.ends = False
    moving = asyncio.create_task(person.move(HOME, timeout=0.05))
    await cell.until(m.ExecuteRequest)
    cell.say(held=True)
    _, waiting = await asyncio.wait({moving}, timeout=0.3)
    assert waiting
    cell.say(held=False)
    with pytest.raises(MotionFailed, match="no progress"):
        await moving
    assert kinds(cell)[-1] == "StopRequest"


@pytest.mark.parametrize(
    ("said", "told"),
    [
        ({"state": "aborted", "error": "path_tolerance", "message": "j is off"}, "the motion was aborted: j is off"),
        ({"state": "cancelled", "error": "cancelled", "message": "asked to"}, "the motion was cancelled: asked to"),
        ({"id": "", "state": "none"}, "was restarted and has forgotten"),
    ],
)
async def test_motion_that_ends_otherwise_is_told_in_one_line(
    cell: Cell, person: OperatorMotion, said: dict[str, object], told: str
) -> None:
    cell.ends = False
    moving = asyncio.create_task(person.move(HOME))
    await cell.until(m.ExecuteRequest)
    await asyncio.sleep(0.01)
    cell.say(**said)
    with pytest.raises(MotionFailed, match=told):
        await moving


async def test_cell_without_an_executor_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("common.client.operator_motion.REQUEST_TIMEOUT", 0.05)
    person = OperatorMotion(LocalNetwork().bus(), [])
    with pytest.raises(MotionFailed, match="publishes no motion status"):
        await person.move(HOME)
