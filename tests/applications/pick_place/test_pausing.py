"""Pause, resume, stop and start of both tasks."""

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


def test_pause_holds_and_resume_continues_the_same_motion(cell: Double) -> None:
    goal, count = cell.motion.id, executed(cell)
    (hold,) = cell.command("pause")
    assert isinstance(hold, m.HoldRequest) and hold.hold and "paused" in hold.reason
    assert wait(cell) == []
    assert cell.task.status.paused and (cell.motion.id, cell.motion.state) == (goal, "active")
    (release,) = cell.command("resume")
    assert isinstance(release, m.HoldRequest) and not release.hold
    while cell.motion.id == goal and cell.motion.state == "active":
        assert executed(cell) == count
        cell.step()
    cell.until("DONE")
    assert cell.task.status.failures == 0
    assert not [r for r in cell.requests if isinstance(r, m.StopRequest)]


def test_paused_trace_is_not_repeated() -> None:
    cell = OutlineDouble()
    cell.until("TRACING")
    cell.command("pause")
    wait(cell)
    cell.command("resume")
    cell.until("DONE")
    assert cell.moves() == ["approach", "descend", "trace", "retreat", "home"]
    assert cell.status.closed


def test_start_after_a_pause_continues(cell: Double) -> None:
    cell.command("pause")
    wait(cell)
    cell.command("start")
    cell.until("DONE")
    assert cell.task.status.failures == 0


def test_time_limit_excludes_holds_and_scales_with_speed(cell: Double) -> None:
    cell.task.p = cell.task.p.model_copy(update={"goal_timeout": 5.0, "overtime": 2.0})
    before = cell.task.status.moving_seconds
    cell.command("pause")
    wait(cell, 300)
    cell.command("resume")
    cell.motion = cell.motion.model_copy(update={"speed_scaling": 0.1})
    cell.arrival += 20.0
    goal = cell.motion.id
    while cell.motion.id == goal and cell.motion.state == "active":
        cell.step()
    cell.step()
    assert cell.motion.state != "cancelled" and cell.task.status.failures == 0
    assert 20 < cell.task.status.moving_seconds - before < 22


def test_endless_motion_is_stopped(cell: Double) -> None:
    cell.task.p = cell.task.p.model_copy(update={"goal_timeout": 5.0, "overtime": 2.0})
    cell.command("pause")
    wait(cell)
    cell.command("resume")
    cell.arrival = math.inf
    asked = wait(cell, 80)
    assert any(isinstance(r, m.StopRequest) for r in asked)
    assert cell.task.status.failures == 1


def test_stop_ends_the_motion_and_start_decides_again(cell: Double) -> None:
    goal = cell.motion.id
    (stop,) = cell.command("stop")
    assert isinstance(stop, m.StopRequest) and stop.id == goal
    assert wait(cell) == []
    assert not cell.task.status.started
    cell.command("start")
    cell.until("DONE")


def test_stop_while_paused_ends_the_motion_and_start_releases_the_hold(cell: Double) -> None:
    cell.command("pause")
    wait(cell)
    cell.command("stop")
    assert cell.motion.state == "cancelled" and cell.motion.held
    assert wait(cell) == []
    status = cell.task.status
    assert (status.paused, status.started) == (False, False)
    cell.command("start")
    assert not cell.motion.held
    cell.until("DONE")
    assert status.failures == 0


def test_stop_also_stops_motions_of_other_clients() -> None:
    cell = CellDouble([])
    cell.until("DONE")
    cell.motion = m.MotionStatus(id="other", state="active")
    (stop,) = cell.command("stop")
    assert isinstance(stop, m.StopRequest) and stop.id == ""


@pytest.mark.parametrize("make", TASKS.values(), ids=TASKS)
@pytest.mark.parametrize("command", ["resume", "start"])
def test_task_that_finds_the_robot_held_stays_paused(make: Callable[[], Double], command: str) -> None:
    cell = make()
    cell.motion = m.MotionStatus(id="of a task before", state="active", held=True)
    assert wait(cell) == []
    assert cell.task.status.paused and "held" in cell.task.status.message
    cell.command(command)
    assert not cell.motion.held
    assert wait(cell) == []  # the running motion may finish
    cell.motion = m.MotionStatus(id="of a task before", state="succeeded")
    cell.until("DONE")


@pytest.mark.parametrize("make", TASKS.values(), ids=TASKS)
def test_early_start_releases_a_held_robot(make: Callable[[], Double]) -> None:
    cell = make()
    cell.motion = m.MotionStatus(held=True)
    cell.command("start")
    assert not cell.motion.held
    cell.until("DONE")


def test_nothing_starts_while_another_client_holds_the_robot(cell: Double) -> None:
    goal = cell.motion.id
    cell.motion = cell.motion.model_copy(update={"held": True})
    assert wait(cell) == []
    assert not cell.task.status.paused
    cell.motion = cell.motion.model_copy(update={"held": False})
    cell.until("DONE")
    assert goal and cell.task.status.failures == 0


def test_ball_lost_while_paused_is_picked_after_the_resume() -> None:
    cell = CellDouble([(0.40, -0.30)])
    cell.until("across")
    cell.command("pause")
    wait(cell, 5)
    cell.drop()
    wait(cell)
    assert cell.motion.state == "cancelled"
    cell.command("resume")
    cell.until("DONE")
    assert cell.contained == 1


@pytest.mark.parametrize("make", TASKS.values(), ids=TASKS)
def test_task_waits_for_motions_of_other_clients_without_a_failure(make: Callable[[], Double]) -> None:
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


def test_arm_moved_by_another_client_goes_home_before_the_next_outline() -> None:
    cell = OutlineDouble()
    cell.until("DONE")
    cell.motion = m.MotionStatus(id="operator", state="active")
    cell.step()
    cell.q = [0.5, *HOME[1:]]
    cell.motion = m.MotionStatus(id="operator", state="succeeded")
    cell.command("start")
    cell.until("DONE")
    assert cell.moves()[5:7] == ["retreat", "home"]
