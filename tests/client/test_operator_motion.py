"""Motions of an operator: planned, executed, awaited; refused while a task has the robot, stopped when cancelled."""

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
from common.time_source import wall_ns
from common.transport.local import LocalNetwork

HOME = m.JointGoal(named="home")
POINT = m.JointTrajectoryPoint(time_from_start=0.0, positions=[0.0], velocities=[0.0], accelerations=[0.0])
TRAJECTORY = m.JointTrajectory(joint_names=["j"], points=[POINT])


class Cell:
    """A fake planner and executor that record their requests."""

    def __init__(self, net: LocalNetwork) -> None:
        self.bus = net.bus("trajectory_executor")
        self.motion = self.bus.writer(topics.MOTION_STATUS)
        self.task = self.bus.writer(PICK_PLACE_STATUS)
        self.status = m.MotionStatus()
        self.requests: list[m.Message] = []
        self.received: asyncio.Queue[m.Message] = asyncio.Queue()
        self.plan_error = ""
        self.refusal: tuple[str, str] | None = None
        self.ends = True
        for topic, handler in ((topics.MOTION_PLAN, self.plan), (topics.MOTION_EXECUTE, self.execute),
                               (topics.MOTION_STOP, self.stop), (topics.MOTION_HOLD, self.hold)):
            self.bus.serve(topic, handler)  # type: ignore[arg-type]

    def record(self, request: m.Message) -> None:
        self.requests.append(request)
        self.received.put_nowait(request)

    def publish(self, **changes: object) -> m.MotionStatus:
        self.status = self.status.model_copy(update={"header": self.bus.header(), **changes})
        self.motion.put(self.status)
        return self.status

    async def plan(self, request: m.PlanRequest) -> m.PlanResponse:
        self.record(request)
        if self.plan_error:
            return m.PlanResponse(id=request.id, ok=False, error=self.plan_error,
                                  message=f"operator: {self.plan_error}")
        return m.PlanResponse(id=request.id, ok=True, trajectory=TRAJECTORY)

    async def execute(self, request: m.ExecuteRequest) -> m.MotionStatus:
        self.record(request)
        if self.refusal:
            code, message = self.refusal
            return m.MotionStatus(id=request.id, state="rejected", error=code, message=message)
        answer = self.publish(id=request.id, state="active")
        if self.ends:
            self.publish(state="succeeded", progress=1.0)
        return answer

    async def stop(self, request: m.StopRequest) -> m.MotionStatus:
        self.record(request)
        return self.publish(state="cancelled", message=request.reason)

    async def hold(self, request: m.HoldRequest) -> m.MotionStatus:
        self.record(request)
        return self.publish(held=request.hold)

    async def until(self, kind: type[m.Message]) -> m.Message:
        async with asyncio.timeout(30):
            while not isinstance(request := await self.received.get(), kind):
                pass
            return request




@pytest.fixture
async def cell() -> AsyncIterator[Cell]:
    made = Cell(LocalNetwork())
    await made.bus.ready()
    made.publish()
    yield made
    await made.bus.close()


@pytest.fixture
def operator(cell: Cell) -> OperatorMotion:
    return OperatorMotion(cell.bus, status_timeout=0.05)


def kinds(cell: Cell) -> list[str]:
    return [type(request).__name__ for request in cell.requests]


async def test_goal_is_planned_executed_and_waiting_for(cell: Cell, operator: OperatorMotion) -> None:
    status = await operator.move(HOME, planner="lerp", straight=True)
    assert (status.state, status.progress) == ("succeeded", 1.0)
    plan, execute = cell.requests
    assert isinstance(plan, m.PlanRequest) and isinstance(execute, m.ExecuteRequest)
    assert (plan.goal, plan.planner, plan.straight, plan.start) == (HOME, "lerp", True, [])
    assert execute.trajectory == TRAJECTORY


async def test_plan_alone_moves_nothing(cell: Cell, operator: OperatorMotion) -> None:
    assert (await operator.plan(HOME)).trajectory == TRAJECTORY
    cell.plan_error = "no_ik"
    assert (await operator.plan(HOME)).error == "no_ik"
    assert kinds(cell) == ["PlanRequest"] * 2


async def test_failed_plan_raises_and_moves_nothing(cell: Cell, operator: OperatorMotion) -> None:
    cell.plan_error = "no_ik"
    with pytest.raises(MotionFailed, match="operator: no_ik") as caught:
        await operator.move(HOME)
    assert caught.value.code == "no_ik" and kinds(cell) == ["PlanRequest"]


@pytest.mark.parametrize(
    ("said", "told"),
    [
        ({"started": True, "state": "GRASPING"}, "the task is GRASPING and has the robot: stop the task first"),
        ({"started": True, "state": "IDLE", "paused": True}, "the task is paused"),
    ],
)
async def test_motion_is_refused_while_a_task_has_the_robot(
    cell: Cell, operator: OperatorMotion, said: dict[str, object], told: str
) -> None:
    cell.task.put(PickPlaceStatus.model_validate(said))
    with pytest.raises(MotionFailed, match=told):
        await operator.move(HOME)
    assert cell.requests == []


@pytest.mark.parametrize("said", [{"started": True, "state": "DONE"}, {"started": True, "state": "IDLE"},
                                  {"started": False, "state": "GRASPING"}, {"started": True, "state": "ERROR"}])
async def test_motion_is_allowed_while_no_task_has_the_robot(cell: Cell, operator: OperatorMotion, said) -> None:
    cell.task.put(PickPlaceStatus.model_validate(said))
    assert (await operator.move(HOME)).state == "succeeded"


async def test_own_hold_of_an_idle_robot_is_released_first(cell: Cell, operator: OperatorMotion) -> None:
    cell.publish(held=True)
    await operator.move(HOME)
    assert kinds(cell) == ["PlanRequest", "HoldRequest", "ExecuteRequest"]
    assert not cell.status.held


def said(kind: str, by: str, since: int) -> m.Interlock:
    return m.Interlock.model_validate({"kind": kind, "by": by, "since": since})


@pytest.mark.parametrize("kind", ["held", "stopped"])
async def test_motion_is_refused_while_another_operator_stops_or_holds_the_robot(cell: Cell, kind: str) -> None:
    cell.publish(held=kind == "held", interlocks=[said(kind, "anna", 7)])
    with pytest.raises(MotionFailed, match=rf"the robot is {kind} since .* by anna"):
        await OperatorMotion(cell.bus, owner="bert", status_timeout=0.05).move(HOME)
    assert cell.requests == []


async def test_interlock_set_during_planning_is_not_acknowledged(cell: Cell) -> None:
    cell.publish(held=True, interlocks=[said("held", "anna", 7)])
    answer = cell.plan

    async def stopped(request: m.PlanRequest) -> m.PlanResponse:
        cell.publish(held=True, interlocks=[said("held", "anna", 7), said("stopped", "anna", 8)])
        return await answer(request)

    next(s for s in cell.bus._servers if s.topic is topics.MOTION_PLAN)._handler = stopped
    await OperatorMotion(cell.bus, owner="anna", status_timeout=0.05).move(HOME)
    _, hold, execute = cell.requests
    assert isinstance(hold, m.HoldRequest) and (hold.owner, hold.into_stop, hold.acknowledged) == ("anna", True, 7)
    assert isinstance(execute, m.ExecuteRequest) and (execute.owner, execute.acknowledged) == ("anna", 7)


async def test_interlock_set_between_motions_of_a_sequence_is_not_acknowledged(cell: Cell) -> None:
    cell.publish(interlocks=[said("stopped", "anna", 8)])
    await OperatorMotion(cell.bus, owner="anna", status_timeout=0.05).move(HOME, acknowledged=7)
    assert isinstance(cell.requests[-1], m.ExecuteRequest) and cell.requests[-1].acknowledged == 7


async def test_motion_of_another_client_is_not_stopped(
    cell: Cell, operator: OperatorMotion, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("common.client.operator_motion.BRAKING_TIMEOUT", 0.05)
    cell.publish(id="other", state="active", held=True)
    with pytest.raises(MotionFailed, match="follows goal 'other'") as caught:
        await operator.move(HOME)
    assert caught.value.code == "busy" and cell.requests == []


async def test_braking_motion_is_awaited(cell: Cell, operator: OperatorMotion) -> None:
    cell.publish(id="other", state="active", message="stopping: requested")
    moving = asyncio.create_task(operator.move(HOME))
    await asyncio.sleep(0)
    cell.publish(state="cancelled")
    assert (await moving).state == "succeeded"


@pytest.mark.parametrize("waiting_for", ["motion", "free"])
async def test_stop_while_the_previous_motion_is_awaited_blocks_the_robot(cell: Cell, waiting_for: str) -> None:
    operator = OperatorMotion(cell.bus, [], owner="anna")
    cell.publish(id="before", state="active", interlocks=[said("stopped", "anna", 3)])
    requests = asyncio.create_task(operator.move(HOME) if waiting_for == "motion" else operator.require_free())
    for _ in range(50):
        await asyncio.sleep(0)
    cell.publish(state="cancelled", interlocks=[said("stopped", "anna", wall_ns())])
    with pytest.raises(MotionFailed, match=r"the robot is stopped since .* by anna"):
        await requests
    assert kinds(cell) == []


async def test_earlier_stop_of_the_same_operator_blocks_only_until_standstill(cell: Cell) -> None:
    operator, since = OperatorMotion(cell.bus, [], owner="anna"), wall_ns()
    cell.publish(id="before", state="active")
    moving = asyncio.create_task(operator.move(HOME))
    for _ in range(50):
        await asyncio.sleep(0)
    cell.publish(state="cancelled", interlocks=[said("stopped", "anna", since)])
    assert (await moving).state == "succeeded"


async def test_own_stop_during_planning_blocks_the_robot(
    cell: Cell
) -> None:
    arm, note, since = Arm(Subscriptions(cell.bus), "anna", cast(Any, None)), cell.record, wall_ns()

    def stop_meanwhile(request: m.Message) -> None:
        note(request)
        if isinstance(request, m.PlanRequest):
            cell.publish(interlocks=[said("stopped", "anna", since)])

    cell.record = stop_meanwhile  # type: ignore[method-assign]
    await arm.move("home")
    execute = cell.requests[-1]
    assert isinstance(execute, m.ExecuteRequest) and execute.acknowledged is not None and execute.acknowledged < since


async def test_task_that_starts_meanwhile_is_reported(cell: Cell, operator: OperatorMotion) -> None:
    cell.refusal = ("busy", "goal 't-1' is still being followed")
    with pytest.raises(MotionFailed, match="'t-1'"):
        await operator.move(HOME)
    answer = cell.plan

    async def begin(request: m.PlanRequest) -> m.PlanResponse:
        cell.task.put(PickPlaceStatus(started=True, state="GRASPING"))
        return await answer(request)

    server = next(s for s in cell.bus._servers if s.topic is topics.MOTION_PLAN)
    server._handler = begin
    with pytest.raises(MotionFailed, match="the task is GRASPING"):
        await operator.move(HOME)


async def test_cancelled_motion_stops_the_robot(cell: Cell, operator: OperatorMotion) -> None:
    cell.ends = False
    moving = asyncio.create_task(operator.move(HOME))
    execute = await cell.until(m.ExecuteRequest)
    moving.cancel()
    with pytest.raises(asyncio.CancelledError):
        await moving
    stop = cell.requests[-1]
    assert isinstance(stop, m.StopRequest) and isinstance(execute, m.ExecuteRequest) and stop.id == execute.id


@pytest.mark.parametrize("timeout", ["5", 0, -1.0, float("nan"), None])
async def test_invalid_timeout_is_refused_before_anything_moves(
    cell: Cell, operator: OperatorMotion, timeout: Any
) -> None:
    cell.ends = False
    with pytest.raises(ConfigError, match="timeout: "):
        await operator.move(HOME, timeout=timeout)
    assert kinds(cell) == ["PlanRequest"]


async def test_any_error_while_waiting_stops_the_robot(
    cell: Cell, operator: OperatorMotion, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def breaks(*_: object) -> m.MotionStatus:
        raise RuntimeError("a bug")

    monkeypatch.setattr(operator, "_ended", breaks)
    with pytest.raises(RuntimeError, match="a bug"):
        await operator.move(HOME)
    assert kinds(cell)[-1] == "StopRequest"


async def test_motion_without_progress_is_stopped_but_not_while_held(cell: Cell, operator: OperatorMotion) -> None:
    cell.ends = False
    moving = asyncio.create_task(operator.move(HOME, timeout=0.05))
    await cell.until(m.ExecuteRequest)
    cell.publish(held=True)
    _, waiting = await asyncio.wait({moving}, timeout=0.3)
    assert waiting
    cell.publish(held=False)
    with pytest.raises(MotionFailed, match="no progress"):
        await moving
    assert kinds(cell)[-1] == "StopRequest"


@pytest.mark.parametrize(
    ("said", "told"),
    [
        ({"state": "aborted", "error": "path_tolerance", "message": "j is off"}, "the motion was aborted: j is off"),
        ({"state": "cancelled", "error": "cancelled", "message": "requested"}, "the motion was cancelled: requested"),
        ({"id": "", "state": "none"}, "was restarted and has forgotten"),
    ],
)
async def test_unsuccessful_motion_raises_one_line(
    cell: Cell, operator: OperatorMotion, said: dict[str, object], told: str
) -> None:
    cell.ends = False
    moving = asyncio.create_task(operator.move(HOME))
    await cell.until(m.ExecuteRequest)
    await asyncio.sleep(0.01)
    cell.publish(**said)
    with pytest.raises(MotionFailed, match=told):
        await moving


async def test_missing_executor_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("common.client.operator_motion.REQUEST_TIMEOUT", 0.05)
    operator = OperatorMotion(LocalNetwork().bus(), [])
    with pytest.raises(MotionFailed, match="publishes no motion status"):
        await operator.move(HOME)
