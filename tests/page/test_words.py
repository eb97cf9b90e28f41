from __future__ import annotations

from typing import get_args

import pytest

from applications.outlining.topics import OutlineState, OutlineStatus
from applications.pick_place.topics import PickPlaceStatus, TaskState
from common.application import find_application
from common.errors import ConfigError, NoResponder, RemoteError, ZencellError
from common.messages import (
    GoalState,
    GripperState,
    JointTrajectory,
    JointTrajectoryPoint,
    MotionStatus,
    PlanResponse,
    ServiceStatus,
    TaskStatus,
)
from page import status_text as words
from page.markup import block, row, span
from page.status_text import TaskText


def test_every_state_has_a_word() -> None:
    for application, states in (("pick_place", TaskState), ("outlining", OutlineState)):
        assert set(get_args(states)) <= set(TaskText.of(find_application(application)).states)
    assert set(words.GOAL_STATES) == set(get_args(GoalState))
    states = get_args(ServiceStatus.model_fields["state"].annotation)
    assert set(words.SERVICE_STATES) == {*states, "gone"}


@pytest.mark.parametrize(
    ("status", "said"),
    [
        (None, "Not known yet"),
        (PickPlaceStatus(), "Waiting for start"),
        (PickPlaceStatus(started=True), "Waiting"),
        (PickPlaceStatus(state="GRASPING", started=True, target="track_2"), "Taking track_2"),
        (PickPlaceStatus(state="GRASPING", started=True, paused=True), "Paused"),
        (PickPlaceStatus(state="PLACING"), "Stopped"),
        (PickPlaceStatus(state="DONE", started=True), "Done"),
        (PickPlaceStatus(state="ERROR", paused=True), "Failed"),
        (OutlineStatus(state="TRACING", started=True, object="Object_1"), "Tracing Object_1"),
        (OutlineStatus(state="SELECTING", started=True), "Waiting for a choice"),
    ],
)
def test_task_is_told_in_words(status: PickPlaceStatus | OutlineStatus | None, said: str) -> None:
    application = "outlining" if isinstance(status, OutlineStatus) else "pick_place"
    assert TaskText.of(find_application(application)).state(status)[0] == said


def test_task_of_an_application_without_a_page_is_told_in_words_that_fit_any() -> None:
    status = TaskStatus(state="MOVING_IT", started=True, subject="cube", done=1, total=4, figures={"mean_mm": 0.2})
    told = TaskText.of(None)
    assert told.state(status)[0] == "Moving it cube" and told.done(status, None) == 0.25
    assert told.counters(status, 0) == {"done": 1, "of": 4, "mean mm": 0.2, "retries": 0, "failures": 0}


def test_arm_and_fingers_are_told_in_words() -> None:
    assert words.motion(MotionStatus(state="active", progress=0.25)) == "moving, 25 % of this motion"
    assert words.motion(MotionStatus(state="active", progress=0.25, held=True)) == "held on its path"
    assert words.gripper(GripperState(width=0.08)) == "fingers 80 mm apart"
    assert words.gripper(GripperState(width=0.06, holding=True)) == "fingers hold something"
    assert words.gripper(GripperState(width=0.06, holding=True, outcome="slipping")).endswith(", which slips")
    assert words.gripper(GripperState(width=0.0)) == "fingers closed"


def test_failed_plan_names_the_colliding_pair_once() -> None:
    failed = PlanResponse(id="a", ok=False, error="collision", message="operator: waypoint 3",
                          colliding=("panda_hand", "table"))
    assert words.plan(failed) == "operator: waypoint 3; panda_hand would touch table"
    named = failed.model_copy(update={"message": "panda_hand touches table"})
    assert words.plan(named) == "panda_hand touches table"


def test_plan_that_was_found_tells_planner_and_length() -> None:
    points = [JointTrajectoryPoint(time_from_start=t, positions=[0.0], velocities=[0.0], accelerations=[0.0])
              for t in (0.0, 2.5)]
    found = PlanResponse(id="a", ok=True, planner="ompl", seconds=0.12,
                         trajectory=JointTrajectory(joint_names=["a"], points=points))
    assert words.plan(found) == "Planned by ompl in 120 ms: a motion of 2.5 s"


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (RemoteError("motion/plan", "no_scene", "there is no planning scene yet"), "there is no planning scene yet"),
        (NoResponder("task/command"), "nobody answers task/command now"),
        (ConfigError("speed", 3, "must be 1"), "speed: 3 must be 1"),
    ],
)
def test_problems_are_told_without_what_only_programs_need(error: ZencellError, said: str) -> None:
    assert words.problem(error) == said


def test_no_value_is_taken_for_markup() -> None:
    evil = '"><img src=x onerror=alert(1)>'
    assert "<img" not in span(evil, evil) + block("", evil, state=evil) + row(span(evil, "dim"), service=evil)
