"""Texts of the page for states, plans and errors."""

from typing import get_args

import pytest

from applications.outlining.topics import OutlineState, OutlineStatus
from applications.pick_place.topics import PickPlaceStatus, TaskState
from common import messages as m
from common.application import find_application
from common.errors import ConfigError, NoResponder, RemoteError, ZencellError
from page import status_text as texts
from page.markup import block, row, span
from page.status_text import TaskText


def test_every_state_has_a_text() -> None:
    for application, states in (("pick_place", TaskState), ("outlining", OutlineState)):
        assert set(get_args(states)) <= set(TaskText.of(find_application(application)).states)
    assert set(texts.GOAL_STATES) == set(get_args(m.GoalState))
    assert set(texts.SERVICE_STATES) == {*get_args(m.ServiceStatus.model_fields["state"].annotation), "gone"}


@pytest.mark.parametrize(("status", "text"), [
    (None, "Task state unknown"),
    (PickPlaceStatus(), "Ready"),
    (PickPlaceStatus(started=True), "Waiting"),
    (PickPlaceStatus(state="GRASPING", started=True, target="track_2"), "Grasping track 2"),
    (PickPlaceStatus(state="GRASPING", started=True, paused=True), "Paused"),
    (PickPlaceStatus(state="PLACING"), "Stopped"),
    (PickPlaceStatus(state="DONE", started=True), "Done"),
    (PickPlaceStatus(state="ERROR", paused=True), "Failed"),
    (OutlineStatus(state="TRACING", started=True, object="Object_1"), "Tracing Object 1"),
    (OutlineStatus(state="SELECTING", started=True), "Waiting for a choice"),
])
def test_text_of_a_task_state(status: PickPlaceStatus | OutlineStatus | None, text: str) -> None:
    application = "outlining" if isinstance(status, OutlineStatus) else "pick_place"
    assert TaskText.of(find_application(application)).state(status)[0] == text


def test_texts_of_arm_and_gripper() -> None:
    assert texts.motion_text(m.MotionStatus(state="active", progress=0.25)) == "moving, 25 % of this motion"
    assert texts.motion_text(m.MotionStatus(state="active", progress=0.25, held=True)) == "held"
    assert texts.gripper_text(m.GripperState(width=0.08)) == "gripper open 80 mm"
    assert texts.gripper_text(m.GripperState(width=0.06, holding=True)) == "gripper holds an object"
    assert texts.gripper_text(m.GripperState(width=0.06, holding=True, outcome="slipping")).endswith(" is slipping")
    assert texts.gripper_text(m.GripperState(width=0.0)) == "gripper closed"


def test_force_at_the_tool_is_a_line_only_where_a_sensor_reports_it() -> None:
    assert texts.wrench_text(None, 60.0) == texts.wrench_text(m.Wrench(reason="no sensor"), 60.0) == ""
    pushed = m.Wrench(force=m.Vector3(x=3.0, y=0.0, z=-4.0), zeroed=True)
    assert texts.wrench_text(pushed, 60.0) == "5.0 N (x 3.0, y 0.0, z -4.0), limit 60 N"
    assert texts.wrench_text(pushed.model_copy(update={"zeroed": False}), 60.0).endswith(", not zeroed")


def test_text_of_a_plan_has_planner_and_duration_or_the_colliding_objects_once() -> None:
    points = [m.JointTrajectoryPoint(time_from_start=t, positions=[0.0], velocities=[0.0], accelerations=[0.0])
              for t in (0.0, 2.5)]
    trajectory = m.JointTrajectory(joint_names=["a"], points=points)
    found = m.PlanResponse(id="a", ok=True, planner="ompl", seconds=0.12, trajectory=trajectory)
    assert texts.plan_text(found) == "Planned by ompl in 120 ms: motion of 2.5 s"
    failed = m.PlanResponse(id="a", ok=False, error="collision", message="operator: waypoint 3",
                            colliding=("panda_hand", "table"))
    assert texts.plan_text(failed) == "operator: waypoint 3; panda_hand would collide with table"
    named = failed.model_copy(update={"message": "panda_hand touches table"})
    assert texts.plan_text(named) == "panda_hand touches table"


@pytest.mark.parametrize(("error", "text"), [
    (RemoteError("motion/plan", "no_scene", "there is no planning scene yet"), "there is no planning scene yet"),
    (NoResponder("task/command"), "the task does not respond"),
    (ConfigError("speed", 3, "must be 1"), "speed: 3 must be 1"),
])
def test_error_text_has_no_details_for_programs(error: ZencellError, text: str) -> None:
    assert texts.error_text(error) == text


def test_values_are_escaped() -> None:
    evil = '"><img src=x onerror=alert(1)>'
    assert "<img" not in span(evil, evil) + block("", evil, state=evil) + row(span(evil, "dim"), service=evil)
