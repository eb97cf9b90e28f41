"""The task engine with a minimal task."""

from __future__ import annotations

import pytest

from common import messages as m
from common.errors import ConfigError
from common.tasks.engine import Task
from common.tasks.stages import DwellTimer, Grip, Move, View
from tests.common.tasks.engine_cell import THERE, Cell, stops, thing


@pytest.fixture
def cell() -> Cell:
    return Cell()


def test_queue_is_planned_ahead_executed_and_ended(cell: Cell) -> None:
    cell.until("reach")
    executed = next(command for command in cell.requests if isinstance(command, m.ExecuteRequest))
    assert executed.plan == cell.plans()[0].id and executed.scene_stamp == 7
    cell.step()
    assert [p.stage for p in cell.plans()] == ["reach", "lift"], "the lift is planned while the arm reaches"
    assert [bool(p.start) for p in cell.plans()] == [False, True]
    assert [p.release for p in cell.plans()] == [True, False]
    cell.until("lift")
    assert cell.status.state == "LIFTING"
    cell.finish()
    cell.steps(2)
    status = cell.status
    assert (status.state, status.message, status.failures, len(status.plans)) == ("DONE", "it is in the hand", 0, 2)


def test_decision_after_awaiting_an_image_uses_a_later_one(cell: Cell) -> None:
    cell.until("lift")
    cell.finish()
    view = cell.view()
    assert cell.task.step(view) == [] and cell.status.state == "LIFTING", "its picture is from before"
    assert cell.task.images_after == view.now


@pytest.mark.parametrize(("found", "waits"), [("an object", True), ("a motion", True), ("nothing", False)])
def test_task_that_finds_its_work_begun_waits_for_a_later_image(cell: Cell, found: str, waits: bool) -> None:
    cell.gripper = m.GripperState(width=0.04, holding=found == "an object")
    cell.motion = m.MotionStatus(state="active" if found == "a motion" else "none")
    view = cell.view()
    cell.task.step(view)
    assert (cell.task.images_after == view.now) is waits


def test_start_after_the_end_restarts_the_time(cell: Cell) -> None:
    cell.status.state = "DONE"
    cell.now += 1000
    cell.task.command("start", cell.view())
    cell.steps(2)
    assert cell.status.task_seconds == pytest.approx(0.1)


def test_missing_gripper_is_reported() -> None:
    with pytest.raises(ConfigError, match=r"robot\.gripper: is missing: the task needs a robot with one"):
        _ = Cell(gripper=None).task.gripper


def test_dwell_timer_counts_from_the_first_occurrence() -> None:
    timer = DwellTimer()
    assert [timer.elapsed("a", 1.0), timer.elapsed("a", 3.0), timer.elapsed("b", 4.0)] == [0.0, 2.0, 0.0]
    timer.reset()
    assert timer.elapsed("b", 9.0) == 0.0


def test_overriding_a_private_method_of_the_engine_is_rejected() -> None:
    with pytest.raises(TypeError, match=r"Mine\._count: Task already has a private method of that name; rename yours"):
        class Mine(Task[View]):
            def _count(self, view: View) -> None:
                """A user task with a name that the engine uses."""


# --- failures ---


@pytest.mark.parametrize("where", ["during", "before"])
def test_lost_object_is_a_failure_and_is_taken_again(cell: Cell, where: str) -> None:
    cell.until("lift" if where == "during" else "close")
    if where == "before":
        cell.finish()
        view = cell.view()
        view.trouble = "the planner is gone"
        assert cell.task.step(view) == []  # the fingers have closed, the carrying motion has not started
    cell.fingers(holding=False)
    assert bool(stops(cell.step())) == (where == "during")
    assert cell.status.failures == 1 and f"fell {where} lift" in cell.status.message
    cell.arm("cancelled")
    cell.until("reach")


def test_empty_grasp_opens_retreats_and_goes_home(cell: Cell) -> None:
    cell.until("close")
    cell.fingers(holding=False)
    cell.until("open")
    cell.until("retreat")
    retreat = next(plan for plan in cell.plans() if plan.stage == "retreat")
    assert isinstance(retreat.goal, m.PoseGoal) and retreat.goal.pose.position.z == pytest.approx(0.3)
    assert ("panda_hand", "cube") in retreat.allowed_collisions
    cell.until("home")
    cell.until("reach")
    assert (cell.status.failures, cell.status.retries) == (1, 1)


def test_wrong_grasp_is_released_and_slipping_reported(cell: Cell) -> None:
    cell.until("close")
    cell.fingers(state="aborted", outcome="too_narrow", message="a pencil", holding=True)
    cell.step()
    assert (cell.status.message, cell.status.retries, cell.status.failures) == ("close: a pencil", 1, 1)
    cell.until("open")
    cell.finish()
    cell.until("lift")
    cell.fingers(outcome="slipping", message="it slips")
    assert cell.step() == [] and cell.status.message == "lift: it slips"
    cell.fingers(holding=False, message="it slipped out")
    assert stops(cell.step()) and cell.status.message == "what the hand held fell during lift: it slipped out"


@pytest.mark.parametrize("progress", [False, True])
def test_failures_in_a_row_without_progress_end_in_error_until_a_start(cell: Cell, progress: bool) -> None:
    limit = cell.task.failure_limit
    for done in range(2 * limit if progress else limit - 1):
        cell.until("reach")
        cell.finish("aborted")
        cell.until("home")
        cell.status.done = done if progress else 0
    assert cell.status.state == "HOMING" and cell.status.failures == (2 * limit if progress else limit - 1)
    if not progress:
        cell.until("reach")
        cell.finish("aborted")
        cell.step()
        assert cell.status.state == "ERROR" and "10 failures in a row" in cell.status.message and cell.step() == []
        cell.task.command("start", cell.view())
        cell.until("reach")


def test_rejected_plans_are_retried_with_a_pause(cell: Cell) -> None:
    began = cell.now
    cell.unplannable = lambda request: "unknown object" if cell.now - began < 5.0 else ""
    cell.until("lift")
    assert 5 <= cell.status.failures < cell.task.failure_limit
    assert cell.now - began < 10.0


def test_hardware_fault_is_decided_again_without_a_failure(cell: Cell) -> None:
    cell.until("lift")
    cell.arm("aborted", error="hardware_fault", message="the cable", fault="the cable")
    assert not cell.steps(50), "nothing is asked for of an arm that does not work"
    assert cell.status.message == "the arm cannot be moved: the cable" and cell.status.failures == 0
    cell.arm("aborted", fault="")
    cell.step()
    assert "cable" not in cell.status.message
    assert cell.status.state == "DONE" and cell.status.failures == 0, "it sees that it has what it wanted"


# --- answers and states in another order than usual ---


@pytest.mark.parametrize("state", ["cancelled", "succeeded"])
def test_late_answer_of_fingers_that_another_client_commanded_is_no_failure(cell: Cell, state: str) -> None:
    cell.until("close")
    assert cell.task.running is not None
    cell.fingers(0.0, id="another", holding=True)
    cell.now += 1.0
    cell.task.on_goal(m.GripperState(
        header=cell.header, id=cell.task.running.command.id, state=state, holding=True), cell.view())
    cell.step()
    if state == "cancelled":
        assert cell.task.running is None and cell.status.message.startswith("close was cancelled")
        cell.step()
        assert cell.status.state == "DONE" and cell.status.failures == 0
    else:
        assert cell.stage == "lift"


def test_answer_ahead_of_the_status_waits_for_it(cell: Cell) -> None:
    cell.until("close")
    running = cell.task.running
    assert running is not None
    done = m.GripperState(header=cell.header, id=running.command.id, state="succeeded", width=0.0, holding=True)
    cell.gripper = m.GripperState(width=0.08)  # as it was before the grip
    cell.task.on_goal(done, cell.view())
    cell.step()
    assert cell.task.running is running
    cell.gripper = done
    cell.step()
    assert cell.stage == "lift"


# --- changes that need new plans ---


def test_new_object_near_the_path_causes_new_plans(cell: Cell) -> None:
    cell.until("close")
    cell.objects = [*cell.objects, thing("other", 0.5)]
    cell.until("lift")
    assert [p.stage for p in cell.plans()] == ["reach", "lift", "lift"]


def test_motions_are_planned_with_the_future_finger_width(cell: Cell) -> None:
    cell.gripper.width = 0.03
    cell.until("close")
    close = cell.task.running.stage
    assert [(p.stage, p.gripper_width) for p in cell.plans()] == [("reach", 0.03), ("lift", 0.03)]
    assert close.width_after(0.08) == 0.08, "what is held may be as wide"
    close.expected_width = 0.05
    assert close.width_after(0.08) == pytest.approx(0.06) and close.width_after(0.02) == 0.02
    assert Grip("open", "", width=0.08).width_after(0.0) == 0.08
    cell.finish()
    cell.until("lift")
    assert len(cell.plans()) == 2, "about what they hold they may be closer"


def test_changed_finger_width_causes_a_new_plan(cell: Cell) -> None:
    cell.gripper.width = 0.03
    cell.step()
    cell.gripper.width = 0.06
    cell.until("reach")
    assert [p.gripper_width for p in cell.plans() if p.stage == "reach"] == [0.03, 0.06]


def block(cell: Cell, *held_by: m.Holder) -> None:
    """The arm is held by these, with a reason."""
    interlocks = [m.Interlock(kind="held", by=by, reason="mug obstructs hand", since=1) for by in held_by]
    cell.arm(cell.motion.state, held=bool(held_by), held_by=list(held_by), interlocks=interlocks)


def test_blocked_motion_continues_or_is_planned_again(cell: Cell) -> None:
    cell.until("reach")
    for _ in range(3):
        block(cell, "scene_monitor")
        cell.steps(8)
        block(cell)
        cell.step()
    assert cell.task.running is not None and cell.status.failures == 0
    reach = cell.motion.id
    block(cell, "scene_monitor")
    (stop,) = cell.steps(12)
    assert isinstance(stop, m.StopRequest) and (stop.id, stop.by) == (reach, "requester")
    assert cell.status.message == "reach: mug obstructs hand" and cell.status.failures == 1
    block(cell)
    cell.arm("cancelled")
    cell.steps(2)
    assert cell.plans()[-1].stage == "home" and cell.status.state == "HOMING"


def test_obstacle_has_no_effect_while_an_operator_holds_the_arm(cell: Cell) -> None:
    cell.until("reach")
    block(cell, "scene_monitor", "operator")
    assert cell.steps(30) == []
    block(cell, "scene_monitor")
    assert cell.steps(8) == [], "time starts when the operator has released"


def test_held_object_is_not_brought_home_from_an_obstacle(cell: Cell) -> None:
    cell.until("lift")
    block(cell, "scene_monitor")
    cell.steps(12)
    assert not cell.task.queue, "it is decided again from here"


# --- the arm leaves while the fingers still open ---


class Drop(Task[View]):
    """Release the object and leave."""

    def decide(self, view: View) -> None:
        if view.holding:
            self.queue += [Grip("release", "DROPPING", width=0.08, carries=True, holds=False),
                         Move("leave", "LEAVING", goal=THERE), Grip("close", "LEAVING", width=0.0, holds=True)]


def opening(width: float = 0.0705) -> Cell:
    """Fingers that held an object of 6 cm are so far apart, and continue to open."""
    cell = Cell(Drop)
    cell.gripper = m.GripperState(width=0.06, holding=True)
    cell.step()
    assert cell.stage == "release"
    cell.step()  # the way is planned meanwhile
    cell.fingers(width, "active", holding=False)
    cell.step()
    return cell


def test_arm_leaves_once_the_released_object_is_clear() -> None:
    cell = opening(0.0695)
    assert cell.stage == "release"
    cell.fingers(0.075, "active", holding=True)
    cell.step()
    assert cell.stage == "release", "they still hold"
    cell = opening(0.0705)
    assert cell.stage == "leave" and cell.motion.state == "active" and cell.gripper.state == "active"
    assert [p.gripper_width for p in cell.plans()] == [0.08], "with the fingers as they will be, once"
    cell.fingers(0.08)
    cell.arm("active", progress=0.9)
    cell.until("close")
    assert cell.status.failures == 0 and not stops(cell.requests)


def test_motion_stops_halfway_for_slow_fingers() -> None:
    cell = opening()
    cell.arm("active", progress=0.49)
    assert not stops(cell.step())
    cell.arm("active", progress=0.5)
    assert stops(cell.step()) == [cell.motion.id] and not cell.task.queue
    cell.arm("cancelled")
    cell.step()
    assert cell.stage == "open" and cell.status.message == "the fingers have not opened yet"
    cell.finish()
    cell.step()
    assert cell.stage == "" and cell.status.failures == 0


def test_stuck_fingers_stop_the_arm_but_those_commanded_by_another_client_do_not() -> None:
    cell = opening()
    cell.fingers(state="aborted", message="they stopped")
    assert stops(cell.step()) == [cell.motion.id]
    assert cell.status.failures == 1 and cell.status.message == "the fingers did not open: they stopped"
    cell = opening()
    cell.gripper = m.GripperState(id="another's", state="active", moving=True, width=0.07)
    cell.arm("active", progress=0.9)
    assert not stops(cell.step()) and cell.stage == "leave"
