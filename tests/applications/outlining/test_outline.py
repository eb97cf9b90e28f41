from __future__ import annotations

import math

import pytest

from applications.outlining.task import MOST_FORGOTTEN
from applications.outlining.topics import OutlinePoints
from common import messages as m
from common.robot.transforms import pose_to_matrix, rpy_to_matrix
from tests.applications.outlining.outline_double import (
    AWAY,
    HOME,
    ROBOT,
    SQUARE,
    TOP,
    OutlineDouble,
    outline_of,
    prism,
)

WHOLE = ["approach", "descend", "trace", "retreat", "home"]


def test_selected_contour_is_traced_and_the_arm_goes_home() -> None:
    cell = OutlineDouble()
    cell.until("DONE")
    assert cell.moves() == WHOLE
    assert cell.q == HOME
    status = cell.status
    assert (status.object, status.points, status.fraction, status.closed) == ("Object_1", 4, 1.0, True)
    assert math.isclose(status.length_m, 0.4)
    assert (status.invalid_depth, status.failures, status.message) == (2, 0, "")
    assert len(status.plans) == 5


def test_nothing_moves_before_everything_is_planned_and_the_fingers_are_closed() -> None:
    cell = OutlineDouble()
    cell.until("APPROACHING")
    assert [r.stage for r in cell.plans()] == WHOLE
    assert cell.gripper.width == 0.0
    kinds = [type(r) for r in cell.requests]
    assert kinds.index(m.GripperCommand) < kinds.index(m.ExecuteRequest)


def test_closed_fingers_are_not_commanded() -> None:
    cell = OutlineDouble()
    cell.gripper = m.GripperState(width=0.0)
    cell.until("DONE")
    assert not [r for r in cell.requests if isinstance(r, m.GripperCommand)]


def test_path_is_closed_with_standoff_and_tool_speed() -> None:
    cell = OutlineDouble(standoff=0.005, tool_speed=0.03, step=0.002)
    cell.until("DONE")
    goal = next(r.goal for r in cell.plans() if r.stage == "trace")
    assert isinstance(goal, m.PathGoal)
    assert (goal.tool_speed, goal.step, goal.min_fraction) == (0.03, 0.002, 0.99)
    assert [(p.position.x, p.position.y) for p in goal.waypoints] == [*SQUARE, SQUARE[0]]
    for pose in goal.waypoints:
        assert math.isclose(pose.position.z, TOP + 0.005)
        assert abs(pose_to_matrix(pose)[:3, :3] - rpy_to_matrix(0, -math.pi, -math.pi)).max() < 1e-9
    assert cell.status.standoff == 0.005


@pytest.mark.parametrize("path", [
    outline_of(5000 * SQUARE, 0), outline_of(SQUARE, 0).model_copy(update={
        "poses": [m.Pose(position=m.Vector3(x=0.5, z=1e7))] * 4})], ids=["too long to be closed", "too far away"])
def test_path_too_long_for_a_request_ends_in_error(path: OutlinePoints) -> None:
    cell = OutlineDouble()
    cell.path = path.model_copy(update={"given": True})
    cell.until("ERROR")
    assert cell.moves() == [] and "Object_1 has too many points, or lies too far away" in cell.status.message


def test_each_motion_is_planned_from_where_the_one_before_ends() -> None:
    cell = OutlineDouble()
    cell.until("DONE")
    assert [r.start for r in cell.plans()] == [[], AWAY, AWAY, AWAY, AWAY]


def test_only_fingers_may_touch_and_only_the_traced_object() -> None:
    cell = OutlineDouble()
    cell.until("DONE")
    assert ROBOT.gripper is not None
    touching = [(link, "Object_1") for link in ROBOT.gripper.links]
    allowed = {r.stage: r.allowed_collisions for r in cell.plans()}
    assert allowed == {"approach": [], "descend": touching, "trace": touching, "retreat": touching, "home": []}


def test_inner_edge_of_a_hole_is_traced_touching_the_solid_around_it() -> None:
    cell = OutlineDouble()
    cell.objects = [prism("Object_0", 0.5, 0.0, 0.08), prism("Object_2", 0.5, 0.3, 0.02)]
    cell.until("DONE")
    trace = next(r for r in cell.plans() if r.stage == "trace")
    assert {name for _, name in trace.allowed_collisions} == {"Object_0"}


def test_path_from_a_file_need_not_surround_an_object() -> None:
    cell = OutlineDouble()
    assert cell.path is not None
    away = outline_of([(0.5, -0.3), (0.52, -0.3), (0.5, -0.28)], 0, "a.json")
    cell.path = away.model_copy(update={"given": True})
    cell.until("DONE")
    assert [r.allowed_collisions for r in cell.plans()] == [[]] * 5
    near = OutlineDouble()
    near.path = outline_of([(0.5, 0.05), (0.5, 0.1), (0.45, 0.05)], 0, "a.json").model_copy(update={"given": True})
    near.until("DONE")
    assert {name for r in near.plans() for _, name in r.allowed_collisions} == {"Object_1"}


@pytest.mark.parametrize("stage", ["approach", "descend", "trace", "retreat", "home"])
def test_impossible_motion_ends_in_error_before_the_arm_moves(stage: str) -> None:
    cell = OutlineDouble()
    cell.unplannable = lambda r: "no_ik" if r.stage == stage else ""
    cell.until("ERROR")
    assert cell.moves() == []
    assert cell.status.message == f"Object_1: {stage}: no_ik"
    assert cell.status.failures == 1
    if stage == "trace":
        assert cell.status.fraction == 0.5


def test_object_renamed_during_planning_is_traced_under_the_new_name() -> None:
    double = OutlineDouble()

    def collides(request: m.PlanRequest) -> str:
        if request.stage != "descend" or double.objects[0].id != "Object_1":
            return ""
        assert double.path is not None
        double.objects[0] = double.objects[0].model_copy(update={"id": "Object_7"})
        double.path = double.path.model_copy(update={"object": "Object_7"})
        double.colliding = ("tip", "Object_7")
        return "collision"

    double.unplannable = collides
    double.until("DONE", "ERROR")
    assert (double.status.state, double.status.subject, double.status.failures) == ("DONE", "Object_7", 1)


def test_objects_that_swap_names_during_planning_are_identified_by_position() -> None:
    double = OutlineDouble()

    def collides(request: m.PlanRequest) -> str:
        if request.stage != "descend" or double.objects[0].id != "Object_1":
            return ""
        assert double.path is not None
        double.objects = [prism("Object_2", 0.5, 0.0, 0.05), prism("Object_1", 0.5, 0.3, 0.02)]
        double.path = double.path.model_copy(update={"object": "Object_2"})
        double.colliding = ("tip", "Object_2")
        return "collision"

    double.unplannable = collides
    double.until("DONE", "ERROR")
    assert (double.status.state, double.status.subject, double.status.failures) == ("DONE", "Object_2", 1)


def moved(double: OutlineDouble, dy: float) -> None:
    """Move the object."""
    double.objects[0] = prism("Object_1", 0.5, dy, 0.05)
    double.path = outline_of([(x, y + dy) for x, y in SQUARE], double.stamp)


def test_object_moved_during_planning_is_traced_at_its_new_position() -> None:
    double = OutlineDouble()
    double.unplannable = lambda request: (request.stage == "home" and moved(double, -0.2)) or ""
    double.until("DONE", "ERROR")
    trace = [r.goal for r in double.plans() if r.stage == "trace"][-1]
    assert isinstance(trace, m.PathGoal) and double.moves() == WHOLE
    assert [p.position.y for p in trace.waypoints[:4]] == [y - 0.2 for _, y in SQUARE]
    assert double.status.state == "DONE" and double.status.failures == 1


def test_object_removed_during_planning_is_not_traced() -> None:
    double = OutlineDouble()

    def taken(request: m.PlanRequest) -> str:
        if request.stage == "home":
            gone = {"poses": [], "message": "Object_1 is not seen any more", "object": ""}
            double.path = outline_of([], double.stamp).model_copy(update=gone)
        return ""

    double.unplannable = taken
    double.until("DONE", "ERROR")
    assert (double.status.state, double.moves()) == ("ERROR", [])
    assert double.status.message == "Object_1 is not seen any more"


def test_object_that_keeps_moving_ends_in_error_before_the_arm_moves() -> None:
    double, places = OutlineDouble(), iter(range(1, 100))
    double.unplannable = lambda request: (request.stage == "home" and moved(double, 0.02 * next(places))) or ""
    double.until("DONE", "ERROR")
    assert (double.status.state, double.moves()) == ("ERROR", [])
    assert "Object_1 is not where it was" in double.status.message


def test_motion_that_fails_brings_the_arm_home_and_ends_in_error() -> None:
    cell = OutlineDouble()
    cell.abort = "trace"
    cell.until("ERROR")
    assert cell.moves() == ["approach", "descend", "trace", "retreat", "home"]
    assert cell.q == HOME
    assert cell.status.message == "trace aborted: path tolerance"
    assert not cell.status.closed


@pytest.mark.parametrize("stage", WHOLE)
def test_outline_is_complete_after_a_controller_restart(stage: str) -> None:
    cell = OutlineDouble()
    cell.until(stage)
    cell.step()
    cell.restart_controller()
    cell.until("DONE")
    traced = stage in ("retreat", "home")
    before = WHOLE[: WHOLE.index(stage) + 1]
    assert cell.moves() == [*before, "retreat", "home", *([] if traced else WHOLE)]
    assert cell.status.closed and cell.status.failures == 1 and cell.status.message == ""
    assert cell.q == HOME


@pytest.mark.parametrize("stage", WHOLE)
def test_outline_is_complete_after_a_controller_restart_before_its_answer(stage: str) -> None:
    cell = OutlineDouble()
    cell.unanswered = stage
    cell.until("DONE")
    assert cell.moves()[-len(WHOLE):] == WHOLE or stage in ("retreat", "home")
    assert cell.status.closed and cell.status.failures == 1 and cell.q == HOME


def test_repeated_controller_restarts_end_in_error() -> None:
    cell = OutlineDouble()
    for _ in range(100):
        cell.step()
        if cell.status.state == "ERROR":
            break
        if cell.motion.state == "active":
            cell.restart_controller()
    assert cell.status.state == "ERROR" and cell.status.message.endswith("was forgotten by the controller")
    assert len(cell.moves()) == MOST_FORGOTTEN + 2


def test_arm_in_contact_is_freed() -> None:
    cell = OutlineDouble()
    cell.abort = "trace"
    pair = ("robotiq_85_base_link", "Object_2")
    cell.unplannable = lambda r: "start_in_collision" if cell.moves()[-1:] == ["trace"] and (
        pair not in r.allowed_collisions and r.stage == "retreat") else ""
    cell.colliding = pair
    cell.until("ERROR")
    assert cell.moves()[-2:] == ["retreat", "home"]
    assert cell.q == HOME


def test_arm_that_cannot_go_home_stays_and_reports_it() -> None:
    cell = OutlineDouble()
    cell.abort = "trace"
    cell.unplannable = lambda r: "no_path" if "trace" in cell.moves() else ""
    cell.until("ERROR")
    assert cell.moves() == ["approach", "descend", "trace"]
    assert cell.status.message == "trace aborted: path tolerance; the arm stays where it is: home: no_path"


@pytest.mark.parametrize(
    ("path", "message"),
    [
        (None, "no contour came from the camera"),
        (OutlinePoints(message="every contour touches the border of the picture"), "touches the border"),
        (OutlinePoints(), "no object is chosen"),
        (outline_of([(0.5, 0.0)], 0), "the contour of Object_1 is a single point"),
        (outline_of([(0.5, -0.3), (0.52, -0.3), (0.5, -0.28)], 0), "the planning scene does not hold Object_1"),
    ],
)
def test_without_a_usable_contour_it_ends_in_error_with_the_reason(path: OutlinePoints | None, message: str) -> None:
    cell = OutlineDouble(selection_timeout=3.0, picture_timeout=3.0)
    cell.path = path
    cell.until("SELECTING")
    assert message in cell.status.message
    began = cell.now
    cell.until("ERROR")
    assert cell.now - began >= 2.9
    assert message in cell.status.message
    assert cell.requests == []


def test_camera_restart_does_not_count_as_selection_time() -> None:
    cell = OutlineDouble(selection_timeout=3.0, picture_timeout=30.0)
    chosen, cell.path = cell.path, OutlinePoints(message="no object is chosen")
    cell.until("SELECTING")
    came_back = cell.now + 20
    while cell.now < came_back:
        cell.camera_on = False
        cell.step()
    cell.camera_on = True
    for _ in range(10):
        cell.step()
    assert cell.status.state == "SELECTING"
    cell.path = chosen
    cell.until("DONE")


def test_zero_timeout_waits_for_a_selection_without_limit() -> None:
    cell = OutlineDouble(selection_timeout=0.0)
    chosen, cell.path = cell.path, OutlinePoints(message="no object is chosen")
    for _ in range(500):
        cell.step()
    assert cell.status.state == "SELECTING"
    cell.path = chosen
    cell.until("DONE")


def test_contour_from_before_the_return_home_is_ignored() -> None:
    cell = OutlineDouble()
    cell.until("DONE")
    cell.camera_on = False
    cell.task.command("start", cell.view())
    for _ in range(20):
        cell.step()
    assert cell.status.state == "SELECTING"
    assert cell.moves() == WHOLE
    cell.camera_on = True
    cell.until("DONE")
    assert cell.moves() == WHOLE * 2


def test_stale_image_starts_no_motion() -> None:
    cell = OutlineDouble(selection_timeout=0.0)
    cell.camera_on = False
    cell.now += 10
    for _ in range(200):
        cell.step()
    assert cell.status.state == "SELECTING" and cell.status.message == "no fresh picture"
    assert not any(isinstance(r, m.ExecuteRequest) for r in cell.requests)
    cell.camera_on = True
    cell.until("DONE")
    assert cell.moves() == WHOLE


def test_camera_frozen_during_planning_causes_a_new_plan() -> None:
    cell = OutlineDouble(selection_timeout=0.0)
    plan, frozen = cell.unplannable, []

    def freeze(request: m.PlanRequest) -> str:
        if request.stage == "home" and not frozen:
            frozen.append(request.id)
            cell.camera_on = False
            cell.now += 10
        return plan(request)

    cell.unplannable = freeze
    for _ in range(200):
        cell.step()
    assert frozen and cell.status.message == "no fresh picture"
    assert not any(isinstance(r, m.ExecuteRequest) for r in cell.requests)
    cell.camera_on = True
    cell.until("DONE")
    assert cell.moves() == WHOLE


def test_frozen_camera_ends_the_task_with_the_reason() -> None:
    cell = OutlineDouble()
    cell.camera_on = False
    cell.now += 10
    cell.until("ERROR")
    assert cell.status.message == "no fresh picture" and cell.moves() == []


def test_arm_goes_home_first() -> None:
    cell = OutlineDouble()
    cell.q = list(AWAY)
    cell.until("DONE")
    assert cell.moves() == ["retreat", "home", *WHOLE]


@pytest.mark.parametrize("colliding", [None, ("base", "Object_2")])
def test_arm_that_cannot_retreat_still_goes_home(colliding: tuple[str, str] | None) -> None:
    cell = OutlineDouble()
    cell.q, cell.colliding = list(AWAY), colliding
    cell.unplannable = lambda r: "no_ik" if r.stage == "retreat" and not cell.moves() else ""
    cell.until("DONE")
    assert cell.moves() == ["home", *WHOLE]
    assert cell.status.failures == 0


def test_motion_of_an_earlier_task_process_may_finish() -> None:
    cell = OutlineDouble()
    cell.motion = m.MotionStatus(id="other", state="active")
    for _ in range(20):
        cell.step()
    assert cell.requests == []
    cell.motion = m.MotionStatus(id="other", state="succeeded")
    cell.until("DONE")


def test_motion_stopped_by_another_client_pauses_the_task() -> None:
    cell = OutlineDouble()
    cell.until("TRACING")
    cell.motion = cell.motion.model_copy(update={"state": "cancelled", "message": "asked to"})
    cell.step()
    assert cell.status.paused
    assert "resume" in cell.status.message


def test_unstarted_task_waits() -> None:
    cell = OutlineDouble(started=False)
    for _ in range(20):
        cell.step()
    assert (cell.status.state, cell.requests) == ("IDLE", [])
    cell.task.command("start", cell.view())
    cell.until("DONE")


def test_failed_task_can_be_restarted() -> None:
    cell = OutlineDouble()
    cell.unplannable = lambda r: "no_ik"
    cell.until("ERROR")
    cell.unplannable = lambda r: ""
    cell.task.command("start", cell.view())
    cell.until("DONE")
    assert cell.moves() == WHOLE


def test_overdue_motion_is_stopped() -> None:
    cell = OutlineDouble(overtime=2.0)
    cell.until("TRACING")
    cell.arrival = math.inf
    cell.until("ERROR")
    assert [type(r) for r in cell.requests].count(m.StopRequest) == 1
    assert "took longer than 3 s" in cell.status.message
    assert cell.q == HOME


def test_rejected_motion_ends_in_error() -> None:
    cell = OutlineDouble()
    cell.refuse = "approach"
    cell.until("ERROR")
    assert cell.status.message == "approach was refused: no"


def test_nearly_complete_contour_is_done_and_not_closed() -> None:
    cell = OutlineDouble()
    cell.fraction = 0.995
    cell.until("DONE")
    assert (cell.status.fraction, cell.status.closed) == (0.995, False)


def test_missing_topics_are_named() -> None:
    cell = OutlineDouble()
    view = cell.view()
    view.gripper, view.q = None, None
    assert cell.task.step(view) == []
    assert cell.status.message == "waiting for gripper/state, joint_states"
