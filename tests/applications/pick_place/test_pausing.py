"""Pause, resume, stop and start of both tasks, and motions of other clients."""

import math

import pytest

from common import messages as m
from tests.applications.outlining.outline_double import AWAY, OutlineDouble
from tests.applications.pick_place.cell_double import CellDouble

Double = CellDouble | OutlineDouble
TASKS = {"pick_place": lambda: CellDouble([(0.40, -0.30)]), "outline": OutlineDouble}
BUSY = {"pick_place": "pre-grasp", "outline": "trace"}  # a motion of the task


@pytest.fixture(params=TASKS)
def cell(request: pytest.FixtureRequest) -> Double:
    """A cell whose task has not done anything yet."""
    return TASKS[request.param]()


@pytest.fixture(params=TASKS)
def moving(request: pytest.FixtureRequest) -> Double:
    """A cell whose task is in the middle of a motion."""
    double = TASKS[request.param]()
    double.until(BUSY[request.param])
    return double


def executed(cell: Double) -> int:
    return sum(isinstance(r, m.ExecuteRequest) for r in cell.requests)


def wait(cell: Double, steps: int = 100) -> list[m.Message]:
    return [request for _ in range(steps) for request in cell.step()]


@pytest.mark.parametrize("command", ["resume", "start"])
def test_pause_holds_and_resume_or_start_continues_the_same_motion(moving: Double, command: str) -> None:
    goal, count = moving.motion.id, executed(moving)
    (hold,) = moving.command("pause")
    assert isinstance(hold, m.HoldRequest) and hold.hold and "paused" in hold.reason
    assert wait(moving) == []
    assert moving.task.status.paused and (moving.motion.id, moving.motion.state) == (goal, "active")
    (release,) = moving.command(command)
    assert isinstance(release, m.HoldRequest) and not release.hold
    while moving.motion.id == goal and moving.motion.state == "active":
        assert executed(moving) == count
        moving.step()
    moving.until("DONE")
    assert moving.task.status.failures == 0
    assert not [r for r in moving.requests if isinstance(r, m.StopRequest)]
    if isinstance(moving, OutlineDouble):
        assert moving.moves() == ["approach", "descend", "trace", "retreat", "home"] and moving.status.closed


def test_time_limit_excludes_holds_and_scales_with_speed(moving: Double) -> None:
    moving.task.p = moving.task.p.model_copy(update={"goal_timeout": 5.0, "overtime": 2.0})
    before = moving.task.status.moving_seconds
    moving.command("pause")
    wait(moving, 300)
    moving.command("resume")
    moving.motion = moving.motion.model_copy(update={"speed_scaling": 0.1})
    moving.arrival += 20.0
    goal = moving.motion.id
    while moving.motion.id == goal and moving.motion.state == "active":
        moving.step()
    moving.step()
    assert moving.motion.state != "cancelled" and moving.task.status.failures == 0
    assert 20 < moving.task.status.moving_seconds - before < 22


def test_endless_motion_is_stopped(moving: Double) -> None:
    moving.task.p = moving.task.p.model_copy(update={"goal_timeout": 5.0, "overtime": 2.0})
    moving.command("pause")
    wait(moving)
    moving.command("resume")
    moving.arrival = math.inf
    assert [type(r) for r in wait(moving, 80)].count(m.StopRequest) == 1
    assert moving.task.status.failures == 1


def test_stop_ends_the_motion_and_start_decides_again(moving: Double) -> None:
    goal = moving.motion.id
    (stop,) = moving.command("stop")
    assert isinstance(stop, m.StopRequest) and stop.id == goal
    assert wait(moving) == []
    assert not moving.task.status.started
    moving.command("start")
    moving.until("DONE")


def test_stop_while_paused_ends_the_motion_and_start_releases_the_hold(moving: Double) -> None:
    moving.command("pause")
    wait(moving)
    moving.command("stop")
    assert moving.motion.state == "cancelled" and moving.motion.held
    assert wait(moving) == []
    status = moving.task.status
    assert (status.paused, status.started) == (False, False)
    moving.command("start")
    assert not moving.motion.held
    moving.until("DONE")
    assert status.failures == 0


def test_ball_lost_while_paused_is_picked_after_the_resume() -> None:
    cell = CellDouble([(0.40, -0.30)])
    cell.until("across")
    cell.command("pause")
    cell.drop()
    wait(cell)
    assert cell.motion.state == "cancelled"
    cell.command("resume")
    cell.until("DONE")
    assert cell.contained == 1


def test_stop_also_stops_motions_of_other_clients() -> None:
    cell = CellDouble([])
    cell.until("DONE")
    cell.motion = m.MotionStatus(id="other", state="active")
    (stop,) = cell.command("stop")
    assert isinstance(stop, m.StopRequest) and stop.id == ""


def test_motion_stopped_by_another_client_pauses_the_task(moving: Double) -> None:
    moving.running.clear()
    moving.motion = moving.motion.model_copy(update={"state": "cancelled", "message": "asked to"})
    moving.step()
    assert moving.task.status.paused and "resume" in moving.task.status.message
    assert moving.step() == []
    moving.command("resume")
    moving.until("DONE")


@pytest.mark.parametrize("command", ["resume", "start"])
def test_task_that_finds_the_robot_held_stays_paused(cell: Double, command: str) -> None:
    cell.motion = m.MotionStatus(id="of a task before", state="active", held=True)
    assert wait(cell) == []
    assert cell.task.status.paused and "held" in cell.task.status.message
    cell.command(command)
    assert not cell.motion.held
    assert wait(cell) == []  # the running motion may finish
    cell.motion = m.MotionStatus(id="of a task before", state="succeeded")
    cell.until("DONE")


@pytest.mark.parametrize("held", [False, True])
def test_task_waits_for_start_which_releases_a_held_robot(cell: Double, held: bool) -> None:
    cell.task.status.started = False
    cell.motion = m.MotionStatus(held=held)
    assert wait(cell, 50) == [] and cell.task.status.state == "IDLE"
    cell.command("start")
    assert not cell.motion.held
    cell.until("DONE")


def test_nothing_starts_while_another_client_holds_the_robot(moving: Double) -> None:
    moving.motion = moving.motion.model_copy(update={"held": True})
    assert wait(moving) == []
    assert not moving.task.status.paused
    moving.motion = moving.motion.model_copy(update={"held": False})
    moving.until("DONE")
    assert moving.task.status.failures == 0


def test_task_waits_for_motions_of_other_clients_without_a_failure(cell: Double) -> None:
    execute, rejected = cell.execute, []

    def busy(request: m.ExecuteRequest) -> m.MotionStatus:
        if rejected:
            return execute(request)
        rejected.append(request.id)
        cell.motion = m.MotionStatus(header=cell.header, id="operator", state="active")
        return m.MotionStatus(id=request.id, state="rejected", error="busy", message="busy")

    cell.execute = busy  # type: ignore[method-assign]
    wait(cell)
    assert len(rejected) == 1 and executed(cell) == 1
    cell.motion = m.MotionStatus(id="operator", state="succeeded")
    cell.until("DONE")
    assert cell.task.status.failures == 0


def test_arm_moved_by_another_client_goes_home_before_the_next_outline() -> None:
    cell = OutlineDouble()
    cell.until("DONE")
    cell.motion = m.MotionStatus(id="operator", state="active")
    cell.step()
    cell.q = list(AWAY)
    cell.motion = m.MotionStatus(id="operator", state="succeeded")
    cell.command("start")
    cell.until("DONE")
    assert cell.moves()[5:7] == ["retreat", "home"]
