"""The task engine with a minimal task."""

from __future__ import annotations

import pytest

from common import messages as m
from common.config import load_cell
from common.errors import ConfigError
from common.tasks.decisions import TaskConfig
from common.tasks.engine import Task
from common.tasks.stages import AwaitImage, Command, DwellTimer, Grip, Move, View

CELL = load_cell("panda")
THERE = m.PoseGoal(pose=m.Pose(position=m.Vector3(x=0.4, z=0.3)))


class Fetch(Task[View]):
    """Takes what lies in front of it, once."""

    def decide(self, view: View) -> None:
        if not self.has_fresh_image(view):
            return
        if view.holding:
            self.end("DONE", "it is in the hand")
        else:
            self.queue += [Move("reach", "REACHING", goal=THERE), Grip("close", "REACHING", width=0.0, holds=True),
                         Move("lift", "LIFTING", goal=THERE, carries=True), AwaitImage()]


class Cell:
    """A fake planner, arm and gripper controlled by the test."""

    def __init__(self, **robot: object) -> None:
        config = TaskConfig(robot=CELL.robot.model_copy(update=robot), run=CELL.run)
        self.task = Fetch(config, m.TaskStatus(), "t")
        self.now, self.objects, self.asked = 100.0, [thing("cube", 0.4)], list[Command]()
        self.motion, self.gripper = m.MotionStatus(), m.GripperState(width=0.08)

    @property
    def view(self) -> View:
        scene = m.PlanningScene(header=m.Header(stamp=int(self.now * 1e9)), objects=self.objects)
        return View(self.now, scene, self.gripper, self.motion, [0.0] * 7, m.Pose(position=m.Vector3(x=0.3, z=0.2)))

    def step(self) -> list[Command]:
        """One step; plans are made at once, motions and grips are started."""
        self.now += 0.1
        asked = self.task.step(self.view)
        for command in asked:
            self.answer(command)
        self.asked += asked
        return asked

    def answer(self, command: Command) -> None:
        header = m.Header(stamp=int(self.now * 1e9))
        if isinstance(command, m.PlanRequest):
            point = m.JointTrajectoryPoint(
                time_from_start=1.0, positions=[len(self.asked)], velocities=[0.0], accelerations=[0.0])
            self.task.on_plan(m.PlanResponse(id=command.id, ok=True, scene_stamp=7, trajectory=m.JointTrajectory(
                joint_names=["j"], points=[point])), self.view)
        elif isinstance(command, m.ExecuteRequest):
            self.motion = m.MotionStatus(header=header, id=command.id, state="active")
            self.task.on_goal(self.motion, self.view)
        elif isinstance(command, m.GripperCommand):
            self.gripper = m.GripperState(header=header, id=command.id, state="active", moving=True)
            self.task.on_goal(self.gripper, self.view)

    def until(self, stage: str) -> None:
        """Step, with every motion and grip before that stage well done."""
        for _ in range(100):
            self.step()
            if self.task.running is not None and self.task.running.stage.name == stage:
                return
            self.finish()
        raise AssertionError(f"never {stage}: {self.task.status}")

    def finish(self, state: str = "succeeded") -> None:
        running = self.task.running
        if running is None:
            return
        if running.moves_arm:
            self.motion = self.motion.model_copy(update={"state": state})
        else:
            width = running.stage.width
            self.gripper = self.gripper.model_copy(update={
                "state": state, "moving": False, "holding": width == 0.0, "width": width})

    def plans(self) -> list[m.PlanRequest]:
        return [r for r in self.asked if isinstance(r, m.PlanRequest)]


def thing(name: str, x: float, y: float = 0.0) -> m.CollisionObject:
    return m.CollisionObject(id=name, role="target", shape="box", dimensions=[0.05, 0.05, 0.05],
                             pose=m.Pose(position=m.Vector3(x=x, y=y, z=0.025)))


def test_queue_is_planned_ahead_executed_and_ended() -> None:
    cell = Cell()
    cell.until("reach")
    cell.step()
    assert [p.stage for p in cell.plans()] == ["reach", "lift"], "the lift is planned while the arm reaches"
    assert [bool(p.start) for p in cell.plans()] == [False, True]
    assert [p.release for p in cell.plans()] == [True, False]
    cell.until("lift")
    assert cell.task.status.state == "LIFTING"
    cell.finish()
    cell.step()
    cell.step()
    status = cell.task.status
    assert (status.state, status.message, status.failures, len(status.plans)) == ("DONE", "it is in the hand", 0, 2)


def test_decision_after_awaiting_an_image_uses_a_later_one() -> None:
    cell = Cell()
    cell.until("lift")
    cell.finish()
    view = cell.view
    assert cell.task.step(view) == [] and cell.task.status.state == "LIFTING", "its picture is from before"
    assert cell.task.images_after == view.now


@pytest.mark.parametrize("where", ["during", "before"])
def test_lost_object_is_a_failure_and_is_taken_again(where: str) -> None:
    cell = Cell()
    cell.until("lift" if where == "during" else "close")
    if where == "before":
        cell.finish()
        view = cell.view
        view.trouble = "the planner is gone"
        assert cell.task.step(view) == []  # the fingers have closed, the carrying motion has not started
    cell.gripper = cell.gripper.model_copy(update={"holding": False})
    asked = cell.step()
    assert any(isinstance(command, m.StopRequest) for command in asked) == (where == "during")
    assert cell.task.status.failures == 1 and f"fell {where} lift" in cell.task.status.message
    cell.motion = cell.motion.model_copy(update={"state": "cancelled"})
    cell.until("reach")


def test_empty_grasp_opens_retreats_and_goes_home() -> None:
    cell = Cell()
    cell.until("close")
    cell.gripper = cell.gripper.model_copy(update={"state": "succeeded", "moving": False, "holding": False})
    cell.until("open")
    cell.until("retreat")
    retreat = next(plan for plan in cell.plans() if plan.stage == "retreat")
    assert isinstance(retreat.goal, m.PoseGoal) and retreat.goal.pose.position.z == pytest.approx(0.3)
    assert ("panda_hand", "cube") in retreat.allowed_collisions
    cell.until("home")
    cell.until("reach")
    assert (cell.task.status.failures, cell.task.status.retries) == (1, 1)


def test_new_object_near_the_path_causes_new_plans() -> None:
    cell = Cell()
    cell.until("close")
    cell.objects = [*cell.objects, thing("other", 0.5)]
    cell.until("lift")
    assert [p.stage for p in cell.plans()] == ["reach", "lift", "lift"]


def test_failure_sends_the_arm_home_and_too_many_end_in_error() -> None:
    cell = Cell()
    for _ in range(cell.task.failure_limit - 1):
        cell.until("reach")
        cell.finish("aborted")
        cell.until("home")
    cell.until("reach")
    cell.finish("aborted")
    cell.step()
    assert cell.task.status.state == "ERROR" and "10 failures in a row" in cell.task.status.message
    assert cell.step() == []
    cell.task.command("start", cell.view)
    cell.until("reach")


def test_rejected_plans_are_retried_with_a_pause() -> None:
    cell = Cell()
    answer, began = cell.answer, cell.now

    def refuse(command: Command) -> None:
        if isinstance(command, m.PlanRequest) and cell.now - began < 5.0:
            cell.task.on_plan(m.PlanResponse(id=command.id, ok=False, message="unknown object 'cube'"), cell.view)
        else:
            answer(command)

    cell.answer = refuse  # type: ignore[method-assign]
    cell.until("lift")
    assert 5 <= cell.task.status.failures < cell.task.failure_limit
    assert cell.now - began < 10.0


def late_answer(cell: Cell, state: str) -> None:
    """Another client commanded the fingers; a repeated request returns the result."""
    running = cell.task.running
    assert running is not None
    cell.gripper = m.GripperState(
        header=m.Header(stamp=int(cell.now * 1e9)), id="another", state="succeeded", width=0.0, holding=True)
    cell.now += 1.0
    cell.task.on_goal(m.GripperState(
        header=m.Header(stamp=int(cell.now * 1e9)), id=running.command.id, state=state, holding=True), cell.view)


def test_hardware_fault_is_decided_again_without_a_failure() -> None:
    cell = Cell()
    cell.until("lift")
    cell.motion = cell.motion.model_copy(update={
        "state": "aborted", "error": "hardware_fault", "message": "the cable", "fault": "the cable"})
    for _ in range(50):
        assert not cell.step(), "nothing is asked for of an arm that does not work"
    assert cell.task.status.message == "the arm cannot be moved: the cable" and cell.task.status.failures == 0
    cell.motion = cell.motion.model_copy(update={"fault": ""})
    cell.step()
    assert "cable" not in cell.task.status.message
    assert cell.task.status.state == "DONE" and cell.task.status.failures == 0, "it sees that it has what it wanted"


def test_replaced_gripper_command_is_decided_again_without_a_failure() -> None:
    cell = Cell()
    cell.until("close")
    late_answer(cell, "cancelled")
    cell.step()
    assert cell.task.running is None and cell.task.status.message.startswith("close was cancelled")
    cell.step()
    assert cell.task.status.state == "DONE" and cell.task.status.failures == 0


def test_grip_that_ended_before_its_answer_continues() -> None:
    cell = Cell()
    cell.until("close")
    late_answer(cell, "succeeded")
    cell.step()
    assert cell.task.running is not None and cell.task.running.stage.name == "lift"


def test_answer_ahead_of_the_status_waits_for_it() -> None:
    cell = Cell()
    cell.until("close")
    running = cell.task.running
    assert running is not None
    done = m.GripperState(
        header=m.Header(stamp=int(cell.now * 1e9)), id=running.command.id, state="succeeded", width=0.0, holding=True)
    cell.gripper = m.GripperState(width=0.08)  # as it was before the grip
    cell.task.on_goal(done, cell.view)
    cell.step()
    assert cell.task.running is running
    cell.gripper = done
    cell.step()
    assert cell.task.running is not None and cell.task.running.stage.name == "lift"


def test_progress_resets_the_failure_count() -> None:
    cell = Cell()
    for k in range(30):
        cell.until("reach")
        cell.finish("aborted")
        cell.until("home")
        cell.task.status.done = k
    assert cell.task.status.state == "HOMING" and cell.task.status.failures == 30


def test_start_after_the_end_restarts_the_time() -> None:
    cell = Cell()
    cell.task.status.state = "DONE"
    cell.now += 1000
    cell.task.command("start", cell.view)
    cell.step()
    cell.step()
    assert cell.task.status.task_seconds == pytest.approx(0.1)


def test_missing_gripper_is_reported() -> None:
    with pytest.raises(ConfigError, match=r"robot\.gripper: is missing: the task needs a robot with one"):
        _ = Cell(gripper=None).task.gripper


def test_ids_are_unique() -> None:
    cell = Cell()
    assert len({cell.task.new_id() for _ in range(1000)}) == 1000


def test_dwell_timer_counts_from_the_first_occurrence() -> None:
    patience = DwellTimer()
    assert [patience.elapsed("a", 1.0), patience.elapsed("a", 3.0), patience.elapsed("b", 4.0)] == [0.0, 2.0, 0.0]
    patience.reset()
    assert patience.elapsed("b", 9.0) == 0.0


def test_motions_are_planned_with_the_future_finger_width() -> None:
    cell = Cell()
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


def test_changed_finger_width_causes_a_new_plan() -> None:
    cell = Cell()
    cell.gripper.width = 0.03
    cell.step()
    cell.gripper.width = 0.06
    cell.until("reach")
    assert [p.gripper_width for p in cell.plans() if p.stage == "reach"] == [0.03, 0.06]


def test_wrong_grasp_is_released_and_slipping_reported() -> None:
    cell = Cell()
    cell.until("close")
    cell.gripper = cell.gripper.model_copy(update={
        "state": "aborted", "outcome": "too_narrow", "message": "a pencil", "holding": True, "moving": False})
    cell.step()
    status = cell.task.status
    assert (status.message, status.retries, status.failures) == ("close: a pencil", 1, 1)
    cell.until("open")
    cell.finish()
    cell.until("lift")
    cell.gripper = cell.gripper.model_copy(update={"outcome": "slipping", "message": "it slips"})
    assert cell.step() == [] and status.message == "lift: it slips"
    cell.gripper = cell.gripper.model_copy(update={"holding": False, "message": "it slipped out"})
    assert any(isinstance(command, m.StopRequest) for command in cell.step())
    assert status.message == "what the hand held fell during lift: it slipped out"


def blocked(cell: Cell, *held_by: m.Holder) -> None:
    """The arm is held by these, the scene monitor with its reason."""
    interlocks = [m.Interlock(kind="held", by=by, reason="mug is in the way of hand", since=1) for by in held_by]
    cell.motion = cell.motion.model_copy(update={
        "held": bool(held_by), "held_by": list(held_by), "interlocks": interlocks})


def test_blocked_motion_continues_or_is_planned_again() -> None:
    cell = Cell()
    cell.until("reach")
    for _ in range(3):
        blocked(cell, "scene_monitor")
        for _ in range(8):
            cell.step()
        blocked(cell)
        cell.step()
    assert cell.task.running is not None and cell.task.status.failures == 0
    reach = cell.motion.id
    blocked(cell, "scene_monitor")
    asked = [command for _ in range(12) for command in cell.step()]
    assert [(type(c), c.id, c.by) for c in asked] == [(m.StopRequest, reach, "requester")]
    assert cell.task.status.message == "reach: mug is in the way of hand" and cell.task.status.failures == 1
    blocked(cell)
    cell.motion = cell.motion.model_copy(update={"state": "cancelled"})
    cell.step()
    cell.step()
    assert cell.plans()[-1].stage == "home" and cell.task.status.state == "HOMING"


def test_obstacle_has_no_effect_during_a_hold_or_planner_outage() -> None:
    cell = Cell()
    cell.until("reach")
    blocked(cell, "scene_monitor", "operator")
    for _ in range(30):
        assert cell.step() == []
    blocked(cell, "scene_monitor")
    for _ in range(8):
        assert cell.step() == [], "time starts when the operator has released"


def test_held_object_is_carried_on_after_a_stop() -> None:
    cell = Cell()
    cell.until("lift")
    blocked(cell, "scene_monitor")
    for _ in range(12):
        cell.step()
    assert not cell.task.queue, "not home: it is decided again from here"


def test_execute_request_names_plan_and_scene() -> None:
    cell = Cell()
    cell.until("reach")
    executed = next(c for c in cell.asked if isinstance(c, m.ExecuteRequest))
    assert executed.plan == cell.plans()[0].id and executed.scene_stamp == 7


def test_overriding_a_private_method_of_the_engine_is_rejected() -> None:
    with pytest.raises(TypeError, match=r"Mine\._count: Task already has a private method of that name; rename yours"):
        class Mine(Task[View]):
            def _count(self, view: View) -> None:
                """A user task with a name that the engine uses."""


class Drop(Task[View]):
    """Release the object and leave."""

    def decide(self, view: View) -> None:
        if view.holding:
            self.queue += [Grip("release", "DROPPING", width=0.08, carries=True, holds=False),
                         Move("leave", "LEAVING", goal=THERE), Grip("close", "LEAVING", width=0.0, holds=True)]


def opening(width: float = 0.0705) -> Cell:
    """Fingers that were about 6 cm are so far apart, and open on."""
    cell = Cell()
    cell.task = Drop(cell.task.p, m.TaskStatus(), "t")
    cell.gripper = m.GripperState(width=0.06, holding=True)
    cell.step()
    assert cell.task.running is not None and cell.task.running.stage.name == "release"
    cell.step()  # the way is planned meanwhile
    cell.gripper = cell.gripper.model_copy(update={"holding": False, "width": width})
    cell.step()
    return cell


def running(cell: Cell) -> str:
    return cell.task.running.stage.name if cell.task.running else ""


def test_arm_leaves_once_the_released_object_is_clear() -> None:
    assert running(opening(0.0695)) == "release"
    cell = opening(0.0705)
    assert running(cell) == "leave" and cell.motion.state == "active" and cell.gripper.state == "active"
    assert [p.gripper_width for p in cell.plans()] == [0.08], "with the fingers as they will stand, once"
    cell.gripper = cell.gripper.model_copy(update={"state": "succeeded", "moving": False, "width": 0.08})
    cell.motion = cell.motion.model_copy(update={"progress": 0.9})
    cell.until("close")
    assert cell.task.status.failures == 0 and not any(isinstance(c, m.StopRequest) for c in cell.asked)


def test_arm_stays_while_opening_fingers_still_hold() -> None:
    cell = opening(0.0695)
    cell.gripper = cell.gripper.model_copy(update={"holding": True, "width": 0.075})
    cell.step()
    assert running(cell) == "release"


def test_motion_stops_halfway_for_slow_fingers() -> None:
    cell = opening()
    cell.motion = cell.motion.model_copy(update={"progress": 0.49})
    assert not any(isinstance(c, m.StopRequest) for c in cell.step())
    cell.motion = cell.motion.model_copy(update={"progress": 0.5})
    (stop,) = cell.step()
    assert isinstance(stop, m.StopRequest) and stop.id == cell.motion.id and not cell.task.queue
    cell.motion = cell.motion.model_copy(update={"state": "cancelled"})
    cell.step()
    assert running(cell) == "open" and cell.task.status.message == "the fingers have not opened yet"
    cell.finish()
    cell.step()
    assert running(cell) == "" and cell.task.status.failures == 0


def test_stuck_fingers_stop_the_arm() -> None:
    cell = opening()
    cell.gripper = cell.gripper.model_copy(update={"state": "aborted", "moving": False, "message": "they stopped"})
    (stop,) = [c for c in cell.step() if isinstance(c, m.StopRequest)]
    assert stop.id == cell.motion.id
    assert cell.task.status.failures == 1 and cell.task.status.message == "the fingers did not open: they stopped"


def test_fingers_commanded_by_another_client_do_not_stop_the_arm() -> None:
    cell = opening()
    cell.gripper = m.GripperState(id="another's", state="active", moving=True, width=0.07)
    cell.motion = cell.motion.model_copy(update={"progress": 0.9})
    assert not any(isinstance(c, m.StopRequest) for c in cell.step()) and running(cell) == "leave"
