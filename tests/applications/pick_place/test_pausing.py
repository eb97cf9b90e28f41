"""Pause, resume, stop and start, the same for both tasks: the robot is held on its path and goes on along it."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from common import messages as m
from tests.applications.outlining.outline_double import HOME, OutlineDouble
from tests.applications.pick_place.cell_double import CellDouble

Double = CellDouble | OutlineDouble
TASKS = {"pick_place": lambda: CellDouble([(0.40, -0.30)]), "outline": OutlineDouble}
BUSY = {"pick_place": "pre-grasp", "outline": "trace"}  # a motion of the task


@pytest.fixture(params=TASKS)
def cell(request: pytest.FixtureRequest) -> Double:
    """A cell whose task is in the middle of a motion."""
    double: Double = TASKS[request.param]()
    double.until(BUSY[request.param])
    return double


def executed(cell: Double) -> int:
    return sum(isinstance(r, m.ExecuteRequest) for r in cell.requests)


def wait(cell: Double, steps: int = 100) -> list[m.Message]:
    return [request for _ in range(steps) for request in cell.step()]


def test_pause_holds_the_arm_and_resume_lets_the_same_motion_go_on(cell: Double) -> None:
    goal, count = cell.motion.id, executed(cell)
    (hold,) = cell.tell("pause")
    assert isinstance(hold, m.HoldRequest) and hold.hold and "paused" in hold.reason
    assert wait(cell) == []
    assert cell.task.status.paused and (cell.motion.id, cell.motion.state) == (goal, "active")
    (release,) = cell.tell("resume")
    assert isinstance(release, m.HoldRequest) and not release.hold
    while cell.motion.id == goal and cell.motion.state == "active":
        assert executed(cell) == count
        cell.step()
    cell.until("DONE")
    assert cell.task.status.failures == 0
    assert not [r for r in cell.requests if isinstance(r, m.StopRequest)]


def test_trace_that_was_paused_is_not_done_again() -> None:
    cell = OutlineDouble()
    cell.until("TRACING")
    cell.tell("pause")
    wait(cell)
    cell.tell("resume")
    cell.until("DONE")
    assert cell.moves() == ["approach", "descend", "trace", "retreat", "home"]
    assert cell.status.closed


def test_start_after_a_pause_goes_on_as_well(cell: Double) -> None:
    cell.tell("pause")
    wait(cell)
    cell.tell("start")
    cell.until("DONE")
    assert cell.task.status.failures == 0


def test_no_time_counts_while_held_and_a_slow_motion_is_given_time(cell: Double) -> None:
    cell.task.p = cell.task.p.model_copy(update={"goal_timeout": 5.0, "overtime": 2.0})
    before = cell.task.status.moving_seconds
    cell.tell("pause")
    wait(cell, 300)
    cell.tell("resume")
    cell.motion = cell.motion.model_copy(update={"speed_scaling": 0.1})
    cell._arrival += 20.0
    goal = cell.motion.id
    while cell.motion.id == goal and cell.motion.state == "active":
        cell.step()
    cell.step()
    assert cell.motion.state != "cancelled" and cell.task.status.failures == 0
    assert 20 < cell.task.status.moving_seconds - before < 22


def test_motion_that_does_not_end_is_still_stopped(cell: Double) -> None:
    cell.task.p = cell.task.p.model_copy(update={"goal_timeout": 5.0, "overtime": 2.0})
    cell.tell("pause")
    wait(cell)
    cell.tell("resume")
    cell._arrival = math.inf
    asked = wait(cell, 80)
    assert any(isinstance(r, m.StopRequest) for r in asked)
    assert cell.task.status.failures == 1


def test_stop_ends_the_motion_and_start_begins_anew(cell: Double) -> None:
    goal = cell.motion.id
    (stop,) = cell.tell("stop")
    assert isinstance(stop, m.StopRequest) and stop.id == goal
    assert wait(cell) == []
    assert not cell.task.status.started
    cell.tell("start")
    cell.until("DONE")


def test_stop_while_paused_ends_the_motion_and_the_next_start_lets_go(cell: Double) -> None:
    cell.tell("pause")
    wait(cell)
    cell.tell("stop")
    assert cell.motion.state == "cancelled" and cell.motion.held
    assert wait(cell) == []
    status = cell.task.status
    assert (status.paused, status.started) == (False, False)
    cell.tell("start")
    assert not cell.motion.held
    cell.until("DONE")
    assert status.failures == 0


def test_stop_stops_also_what_somebody_else_moves() -> None:
    cell = CellDouble([])
    cell.until("DONE")
    cell.motion = m.MotionStatus(id="other", state="active")
    (stop,) = cell.tell("stop")
    assert isinstance(stop, m.StopRequest) and stop.id == ""


@pytest.mark.parametrize("make", TASKS.values(), ids=TASKS)
@pytest.mark.parametrize("told", ["resume", "start"])
def test_task_that_finds_the_robot_held_stays_paused_until_told(make: Callable[[], Double], told: str) -> None:
    cell = make()
    cell.motion = m.MotionStatus(id="of a task before", state="active", held=True)
    assert wait(cell) == []
    assert cell.task.status.paused and "held" in cell.task.status.message
    cell.tell(told)
    assert not cell.motion.held
    assert wait(cell) == []  # what was begun is let finish
    cell.motion = m.MotionStatus(id="of a task before", state="succeeded")
    cell.until("DONE")


@pytest.mark.parametrize("make", TASKS.values(), ids=TASKS)
def test_start_before_anything_is_known_lets_a_held_robot_go(make: Callable[[], Double]) -> None:
    cell = make()
    cell.motion = m.MotionStatus(held=True)
    cell.tell("start")
    assert not cell.motion.held
    cell.until("DONE")


def test_nothing_is_begun_while_somebody_else_holds_the_robot(cell: Double) -> None:
    goal = cell.motion.id
    cell.motion = cell.motion.model_copy(update={"held": True})
    assert wait(cell) == []
    assert not cell.task.status.paused
    cell.motion = cell.motion.model_copy(update={"held": False})
    cell.until("DONE")
    assert goal and cell.task.status.failures == 0


def test_ball_that_falls_while_paused_is_noticed_and_picked_after_the_resume() -> None:
    cell = CellDouble([(0.40, -0.30)])
    cell.until("across")
    cell.tell("pause")
    wait(cell, 5)
    cell.drop()
    wait(cell)
    assert cell.motion.state == "cancelled"
    cell.tell("resume")
    cell.until("DONE")
    assert cell.contained == 1


@pytest.mark.parametrize("make", TASKS.values(), ids=TASKS)
def test_task_waits_for_what_somebody_else_began_and_counts_no_failure(make: Callable[[], Double]) -> None:
    cell = make()
    answer, refused = cell.answer, []

    def busy(request: m.Message) -> None:
        if isinstance(request, m.ExecuteRequest) and not refused:
            refused.append(request.id)
            cell.requests.append(request)
            cell.motion = m.MotionStatus(header=m.Header(stamp=int(cell.now * 1e9)), id="operator", state="active")
            cell.task.on_goal(m.MotionStatus(id=request.id, state="rejected", error="busy", message="busy"),
                              cell.view())
            return
        answer(request)

    cell.answer = busy  # type: ignore[method-assign]
    wait(cell)
    assert len(refused) == 1 and executed(cell) == 1
    cell.motion = m.MotionStatus(id="operator", state="succeeded")
    cell.until("DONE")
    assert cell.task.status.failures == 0


def test_arm_that_somebody_else_moved_goes_home_before_the_next_outline() -> None:
    cell = OutlineDouble()
    cell.until("DONE")
    cell.motion = m.MotionStatus(id="operator", state="active")
    cell.step()
    cell.q = [0.5, *HOME[1:]]
    cell.motion = m.MotionStatus(id="operator", state="succeeded")
    cell.tell("start")
    cell.until("DONE")
    assert cell.moves()[5:7] == ["retreat", "home"]
