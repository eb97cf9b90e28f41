"""Motions of an operator: planned, executed, awaited; refused while a task has the robot, stopped when cancelled."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
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
from tests.services.fake_cell import settle, trajectory

HOME = m.JointGoal(named="home")
TRAJECTORY = trajectory(["j"], 0.0)


class Cell:
    """A fake planner and executor that record their requests; `during_planning` is called before a plan is answered."""

    def __init__(self) -> None:
        self.bus = LocalNetwork().bus("trajectory_executor")
        self.motion, self.task = self.bus.writer(topics.MOTION_STATUS), self.bus.writer(PICK_PLACE_STATUS)
        self.status = m.MotionStatus()
        self.requests: list[m.Message] = []
        self.executing = asyncio.Event()
        self.plan_error, self.refusal, self.ends = "", ("", ""), True
        self.begins: dict[str, object] = {}  # further fields of the first status of a motion
        self.during_planning: Callable[[], object] = lambda: None
        self.bus.serve(topics.MOTION_PLAN, self.plan)
        self.bus.serve(topics.MOTION_EXECUTE, self.execute)
        self.bus.serve(topics.MOTION_STOP, self.stop)
        self.bus.serve(topics.MOTION_HOLD, self.hold)

    def publish(self, *interlocks: tuple[str, str, int], **changes: object) -> m.MotionStatus:
        """Publish a changed status, with interlocks of (kind, operator, time [ns])."""
        if interlocks:
            changes["interlocks"] = [m.Interlock.model_validate({"kind": kind, "by": by, "since": since})
                                     for kind, by, since in interlocks]
        self.status = self.status.model_copy(update={"header": self.bus.header(), **changes})
        self.motion.put(self.status)
        return self.status

    def put_task(self, **status: Any) -> None:
        self.task.put(PickPlaceStatus(**status))

    async def plan(self, request: m.PlanRequest) -> m.PlanResponse:
        self.requests.append(request)
        self.during_planning()
        if error := self.plan_error:
            return m.PlanResponse(id=request.id, ok=False, error=error, message=f"operator: {error}")
        return m.PlanResponse(id=request.id, ok=True, trajectory=TRAJECTORY)

    async def execute(self, request: m.ExecuteRequest) -> m.MotionStatus:
        self.requests.append(request)
        self.executing.set()
        if self.refusal[0]:
            return m.MotionStatus(id=request.id, state="rejected", error=self.refusal[0], message=self.refusal[1])
        answer = self.publish(id=request.id, state="active", **self.begins)
        if self.ends:
            self.publish(state="succeeded", progress=1.0)
        return answer

    async def stop(self, request: m.StopRequest) -> m.MotionStatus:
        self.requests.append(request)
        return self.publish(state="cancelled", message=request.reason)

    async def hold(self, request: m.HoldRequest) -> m.MotionStatus:
        self.requests.append(request)
        return self.publish(held=request.hold)

    @property
    def kinds(self) -> list[str]:
        return [type(request).__name__.removesuffix("Request") for request in self.requests]

    async def motion_of(self, operator: OperatorMotion, **options: Any) -> asyncio.Task[m.MotionStatus]:
        """Start a motion that does not end by itself, and wait until it is executed."""
        self.ends = False
        moving = asyncio.create_task(operator.move(HOME, **options))
        await asyncio.wait_for(self.executing.wait(), 30)
        await settle()
        return moving


@pytest.fixture
async def cell() -> AsyncIterator[Cell]:
    made = Cell()
    await made.bus.ready()
    made.publish()
    yield made
    await made.bus.close()


@pytest.fixture
def operator(cell: Cell) -> OperatorMotion:
    return OperatorMotion(cell.bus, owner="anna", status_timeout=0.05)


async def test_goal_is_planned_executed_and_awaited(cell: Cell, operator: OperatorMotion) -> None:
    status = await operator.move(HOME, planner="lerp", straight=True)
    assert (status.state, status.progress) == ("succeeded", 1.0)
    plan, execute = cell.requests
    assert isinstance(plan, m.PlanRequest) and isinstance(execute, m.ExecuteRequest)
    assert (plan.goal, plan.planner, plan.straight, plan.start) == (HOME, "lerp", True, [])
    assert execute.trajectory == TRAJECTORY


async def test_plan_alone_and_failed_plan_move_nothing(cell: Cell, operator: OperatorMotion) -> None:
    assert (await operator.plan(HOME)).trajectory == TRAJECTORY
    cell.plan_error = "no_ik"
    assert (await operator.plan(HOME)).error == "no_ik"
    with pytest.raises(MotionFailed, match="operator: no_ik") as caught:
        await operator.move(HOME)
    assert caught.value.code == "no_ik" and cell.kinds == ["Plan"] * 3


# --- before the motion ---


@pytest.mark.parametrize(("status", "message"), [
    ({"started": True, "state": "GRASPING"}, "the task is GRASPING and has the robot: stop the task first"),
    ({"started": True, "state": "IDLE", "paused": True}, "the task is paused"),
    ({"started": True, "state": "DONE"}, ""), ({"started": True, "state": "IDLE"}, ""),
    ({"started": False, "state": "GRASPING"}, ""), ({"started": True, "state": "ERROR"}, ""),
])
async def test_motion_is_refused_only_while_a_task_has_the_robot(cell, operator, status, message):
    cell.put_task(**status)
    if not message:
        assert (await operator.move(HOME)).state == "succeeded"
        return
    with pytest.raises(MotionFailed, match=message):
        await operator.move(HOME)
    assert cell.requests == []


async def test_own_hold_of_an_idle_robot_is_released_first(cell: Cell, operator: OperatorMotion) -> None:
    cell.publish(held=True)
    await operator.move(HOME)
    assert cell.kinds == ["Plan", "Hold", "Execute"] and not cell.status.held


@pytest.mark.parametrize("kind", ["held", "stopped"])
async def test_motion_is_refused_while_another_operator_stops_or_holds_the_robot(cell: Cell, kind: str) -> None:
    cell.publish((kind, "anna", 7), held=kind == "held")
    with pytest.raises(MotionFailed, match=rf"the robot is {kind} since .* by anna"):
        await OperatorMotion(cell.bus, owner="bert", status_timeout=0.05).move(HOME)
    assert cell.requests == []


async def test_interlock_set_during_planning_or_between_motions_is_not_acknowledged(cell, operator):
    cell.publish(("held", "anna", 7), held=True)
    cell.during_planning = lambda: cell.publish(("held", "anna", 7), ("stopped", "anna", 8), held=True)
    await operator.move(HOME)
    _, hold, execute = cell.requests
    assert isinstance(hold, m.HoldRequest) and (hold.owner, hold.into_stop, hold.acknowledged) == ("anna", True, 7)
    assert isinstance(execute, m.ExecuteRequest) and (execute.owner, execute.acknowledged) == ("anna", 7)
    await operator.move(HOME, acknowledged=7)
    assert isinstance(cell.requests[-1], m.ExecuteRequest) and cell.requests[-1].acknowledged == 7


async def test_own_stop_during_planning_blocks_the_robot(cell: Cell) -> None:
    since = wall_ns()
    cell.during_planning = lambda: cell.publish(("stopped", "anna", since))
    await Arm(Subscriptions(cell.bus), "anna", cast(Any, None)).move("home")
    execute = cell.requests[-1]
    assert isinstance(execute, m.ExecuteRequest) and execute.acknowledged is not None and execute.acknowledged < since


async def test_motion_of_another_client_is_not_stopped(cell, operator, monkeypatch):
    monkeypatch.setattr("common.client.operator_motion.BRAKING_TIMEOUT", 0.05)
    cell.publish(id="other", state="active", held=True)
    with pytest.raises(MotionFailed, match="follows goal 'other'") as caught:
        await operator.move(HOME)
    assert caught.value.code == "busy" and cell.requests == []


@pytest.mark.parametrize("request_of", ["move", "require_free"])
async def test_stop_while_a_braking_motion_is_awaited_blocks_the_robot(cell: Cell, request_of: str) -> None:
    operator, since = OperatorMotion(cell.bus, [], owner="anna"), wall_ns()
    for stop, blocks in ((since, False), (None, True)):  # before and after the request
        cell.publish(("stopped", "anna", 3), id="before", state="active", message="stopping: requested")
        request = operator.move(HOME) if request_of == "move" else operator.require_free()
        waiting = asyncio.create_task(request)
        await settle()
        assert not waiting.done()
        cell.publish(("stopped", "anna", stop or wall_ns()), state="cancelled")
        if blocks:
            with pytest.raises(MotionFailed, match=r"the robot is stopped since .* by anna"):
                await waiting
        else:
            assert (await waiting).state in ("succeeded", "cancelled")
        cell.publish(interlocks=[])
    assert cell.kinds == (["Plan", "Execute"] if request_of == "move" else [])


async def test_task_that_starts_meanwhile_is_reported(cell: Cell, operator: OperatorMotion) -> None:
    cell.refusal = ("busy", "goal 't-1' is still being followed")
    with pytest.raises(MotionFailed, match="'t-1'"):
        await operator.move(HOME)
    cell.during_planning = lambda: cell.put_task(started=True, state="GRASPING")
    with pytest.raises(MotionFailed, match="the task is GRASPING"):
        await operator.move(HOME)


# --- during the motion ---


async def test_cancelled_motion_stops_the_robot(cell: Cell, operator: OperatorMotion) -> None:
    moving = await cell.motion_of(operator)
    moving.cancel()
    with pytest.raises(asyncio.CancelledError):
        await moving
    execute, stop = cell.requests[-2:]
    assert isinstance(stop, m.StopRequest) and isinstance(execute, m.ExecuteRequest) and stop.id == execute.id


@pytest.mark.parametrize("timeout", ["5", 0, -1.0, float("nan"), None])
async def test_invalid_timeout_is_refused_before_anything_moves(cell, operator, timeout):
    with pytest.raises(ConfigError, match="timeout: "):
        await operator.move(HOME, timeout=timeout)
    assert cell.kinds == ["Plan"]


async def test_any_error_while_waiting_stops_the_robot(cell, operator, monkeypatch):
    async def breaks(*_: object) -> m.MotionStatus:
        raise RuntimeError("a bug")

    monkeypatch.setattr(operator, "_ended", breaks)
    with pytest.raises(RuntimeError, match="a bug"):
        await operator.move(HOME)
    assert cell.kinds[-1] == "Stop"


async def test_motion_without_progress_is_stopped_but_not_while_held(cell: Cell, operator: OperatorMotion) -> None:
    cell.begins = {"held": True}
    moving = await cell.motion_of(operator, timeout=0.05)
    cell.publish(held=True)
    _, waiting = await asyncio.wait({moving}, timeout=0.2)
    assert waiting
    cell.publish(held=False)
    with pytest.raises(MotionFailed, match="no progress"):
        await moving
    assert cell.kinds[-1] == "Stop"


@pytest.mark.parametrize(("status", "message"), [
    ({"state": "aborted", "error": "path_tolerance", "message": "j is off"}, "the motion was aborted: j is off"),
    ({"state": "cancelled", "error": "cancelled", "message": "requested"}, "the motion was cancelled: requested"),
    ({"id": "", "state": "none"}, "was restarted and has forgotten"),
])
async def test_unsuccessful_motion_raises_one_line(cell, operator, status, message):
    moving = await cell.motion_of(operator)
    cell.publish(**status)
    with pytest.raises(MotionFailed, match=message):
        await moving


async def test_missing_executor_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("common.client.operator_motion.REQUEST_TIMEOUT", 0.05)
    with pytest.raises(MotionFailed, match="publishes no motion status"):
        await OperatorMotion(LocalNetwork().bus(), []).move(HOME)
