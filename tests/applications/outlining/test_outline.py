"""The outlining task: its plans, what it traces, and how it ends when something fails."""

import math

import pytest

from applications.outlining.task import MOST_FORGOTTEN
from applications.outlining.topics import OutlinePoints
from common import messages as m
from common.robot.transforms import pose_to_matrix, rpy_to_matrix
from tests.applications.outlining.outline_double import AWAY, HOME, ROBOT, SQUARE, TOP, OutlineDouble, outline_of, prism

WHOLE = ["approach", "descend", "trace", "retreat", "home"]
TOUCHING = [(link, "Object_1") for link in ROBOT.gripper.links]


def executed(cell: OutlineDouble) -> list[m.Message]:
    return [r for r in cell.requests if isinstance(r, m.ExecuteRequest)]


def steps(cell: OutlineDouble, count: int) -> None:
    for _ in range(count):
        cell.step()


def goal_of(cell: OutlineDouble, stage: str) -> m.AnyGoal:
    return [r.goal for r in cell.plans() if r.stage == stage][-1]


def test_selected_contour_is_traced_and_the_arm_goes_home() -> None:
    cell = OutlineDouble(standoff=0.005, tool_speed=0.03, step=0.002)
    cell.until("DONE")
    assert cell.moves() == WHOLE and cell.q == HOME
    status = cell.status
    assert (status.object, status.points, status.fraction, status.closed) == ("Object_1", 4, 1.0, True)
    assert math.isclose(status.length_m, 0.4) and status.standoff == 0.005
    assert (status.invalid_depth, status.failures, status.message, len(status.plans)) == (2, 0, "", 5)
    goal = goal_of(cell, "trace")
    assert (goal.tool_speed, goal.step, goal.min_fraction) == (0.03, 0.002, 0.99)
    assert [(p.position.x, p.position.y) for p in goal.waypoints] == [*SQUARE, SQUARE[0]]
    for pose in goal.waypoints:
        assert math.isclose(pose.position.z, TOP + 0.005)
        assert abs(pose_to_matrix(pose)[:3, :3] - rpy_to_matrix(0, -math.pi, -math.pi)).max() < 1e-9


def test_everything_is_planned_and_the_fingers_are_closed_before_the_first_motion() -> None:
    cell = OutlineDouble()
    cell.until("APPROACHING")
    assert [r.stage for r in cell.plans()] == WHOLE
    assert [r.start for r in cell.plans()] == [[], AWAY, AWAY, AWAY, AWAY], "from where the one before ends"
    assert [r.allowed_collisions for r in cell.plans()] == [[], TOUCHING, TOUCHING, TOUCHING, []]
    kinds = [type(r) for r in cell.requests]
    assert cell.gripper.width == 0.0 and kinds.index(m.GripperCommand) < kinds.index(m.ExecuteRequest)
    cell.fraction = 0.995
    cell.until("DONE")
    cell.command("start")
    cell.until("DONE")
    assert kinds.count(m.GripperCommand) == [type(r) for r in cell.requests].count(m.GripperCommand), "closed already"
    assert (cell.status.fraction, cell.status.closed) == (0.995, False), "nearly complete"


@pytest.mark.parametrize("path", [
    outline_of(5000 * SQUARE, 0),
    outline_of(SQUARE, 0).model_copy(update={"poses": [m.Pose(position=m.Vector3(x=0.5, z=1e7))] * 4}),
], ids=["too long to be closed", "too far away"])
def test_path_too_long_for_a_request_ends_in_error(path: OutlinePoints) -> None:
    cell = OutlineDouble()
    cell.path = path.model_copy(update={"given": True})
    cell.until("ERROR")
    assert cell.moves() == [] and "Object_1 has too many points, or lies too far away" in cell.status.message


def test_inner_edge_of_a_hole_is_traced_touching_the_solid_around_it() -> None:
    cell = OutlineDouble()
    cell.objects = [prism("Object_0", 0.5, 0.0, 0.08), prism("Object_2", 0.5, 0.3, 0.02)]
    cell.until("DONE")
    trace = next(r for r in cell.plans() if r.stage == "trace")
    assert {name for _, name in trace.allowed_collisions} == {"Object_0"}


@pytest.mark.parametrize(("points", "touched"), [
    ([(0.5, -0.3), (0.52, -0.3), (0.5, -0.28)], set()), ([(0.5, 0.05), (0.5, 0.1), (0.45, 0.05)], {"Object_1"})])
def test_path_from_a_file_need_not_surround_an_object(points: list[tuple[float, float]], touched: set[str]) -> None:
    cell = OutlineDouble()
    cell.path = outline_of(points, 0, "a.json").model_copy(update={"given": True})
    cell.until("DONE")
    assert {name for r in cell.plans() for _, name in r.allowed_collisions} == touched


@pytest.mark.parametrize("stage", WHOLE)
def test_impossible_motion_ends_in_error_before_the_arm_moves(stage: str) -> None:
    cell = OutlineDouble()
    cell.unplannable = lambda r: "no_ik" if r.stage == stage else ""
    cell.until("ERROR")
    assert cell.moves() == [] and cell.status.failures == 1
    assert cell.status.message == f"Object_1: {stage}: no_ik"
    assert stage != "trace" or cell.status.fraction == 0.5
    cell.unplannable = lambda r: ""
    cell.command("start")
    cell.until("DONE")
    assert cell.moves() == WHOLE


@pytest.mark.parametrize(("name", "objects"), [
    ("Object_7", [prism("Object_7", 0.5, 0.0, 0.05), prism("Object_2", 0.5, 0.3, 0.02)]),
    ("Object_2", [prism("Object_2", 0.5, 0.0, 0.05), prism("Object_1", 0.5, 0.3, 0.02)]),  # both names are swapped
])
def test_object_renamed_during_planning_is_identified_by_its_position(name, objects) -> None:
    cell = OutlineDouble()

    def collides(request: m.PlanRequest) -> str:
        if request.stage != "descend" or cell.objects[0].id != "Object_1":
            return ""
        cell.objects = objects
        cell.path = cell.path.model_copy(update={"object": name})
        cell.colliding = ("tip", name)
        return "collision"

    cell.unplannable = collides
    cell.until("DONE", "ERROR")
    assert (cell.status.state, cell.status.subject, cell.status.failures) == ("DONE", name, 1)


def move(cell: OutlineDouble, dy: float) -> None:
    """Move the object."""
    cell.objects[0] = prism("Object_1", 0.5, dy, 0.05)
    cell.path = outline_of([(x, y + dy) for x, y in SQUARE], cell.stamp)


def test_object_moved_during_planning_is_traced_at_its_new_position() -> None:
    cell = OutlineDouble()
    cell.unplannable = lambda request: (request.stage == "home" and move(cell, -0.2)) or ""
    cell.until("DONE")
    assert cell.moves() == WHOLE and cell.status.failures == 1
    assert [p.position.y for p in goal_of(cell, "trace").waypoints[:4]] == [y - 0.2 for _, y in SQUARE]


def test_object_that_keeps_moving_ends_in_error_before_the_arm_moves() -> None:
    cell, places = OutlineDouble(), iter(range(1, 100))
    cell.unplannable = lambda request: (request.stage == "home" and move(cell, 0.02 * next(places))) or ""
    cell.until("ERROR")
    assert cell.moves() == [] and "Object_1 is not where it was" in cell.status.message


def test_object_removed_during_planning_is_not_traced() -> None:
    cell = OutlineDouble()

    def remove(request: m.PlanRequest) -> str:
        if request.stage == "home":
            gone = {"poses": [], "message": "Object_1 is not seen any more", "object": ""}
            cell.path = outline_of([], cell.stamp).model_copy(update=gone)
        return ""

    cell.unplannable = remove
    cell.until("ERROR")
    assert (cell.status.message, cell.moves()) == ("Object_1 is not seen any more", [])


@pytest.mark.parametrize(("fault", "message", "moves"), [
    ({"abort": "trace"}, "trace aborted: path tolerance", WHOLE),
    ({"refuse": "approach"}, "approach was refused: no", ["approach"]),
    ({"abort": "trace", "unplannable": lambda r: "no_path"},
     "trace aborted: path tolerance; the arm stays where it is: home: no_path", WHOLE[:3]),
])
def test_failed_motion_ends_in_error_with_the_arm_at_home_if_possible(fault, message, moves) -> None:
    cell = OutlineDouble()
    if plan := fault.pop("unplannable", None):
        cell.unplannable = lambda r: plan(r) if "trace" in cell.moves() else ""
    for name, value in fault.items():
        setattr(cell, name, value)
    cell.until("ERROR")
    assert (cell.status.message, cell.moves()) == (message, moves)
    assert not cell.status.closed and (cell.q == HOME) is (moves != WHOLE[:3])


def test_overdue_motion_is_stopped_and_the_arm_goes_home() -> None:
    cell = OutlineDouble(overtime=2.0)
    cell.until("TRACING")
    cell.arrival = math.inf
    cell.until("ERROR")
    assert "took longer than 3 s" in cell.status.message and cell.q == HOME


@pytest.mark.parametrize("answered", [True, False])
@pytest.mark.parametrize("stage", WHOLE)
def test_outline_is_complete_after_a_controller_restart(stage: str, answered: bool) -> None:
    cell = OutlineDouble()
    if answered:
        cell.until(stage)
        cell.step()
        cell.restart_controller()
    else:
        cell.unanswered = stage
    cell.until("DONE")
    traced = stage in ("retreat", "home")
    if answered:
        assert cell.moves() == [*WHOLE[: WHOLE.index(stage) + 1], "retreat", "home", *([] if traced else WHOLE)]
    else:
        assert cell.moves()[-len(WHOLE):] == WHOLE or traced
    assert (cell.status.closed, cell.status.failures, cell.status.message) == (True, 1, "")
    assert cell.q == HOME


def test_repeated_controller_restarts_end_in_error() -> None:
    cell = OutlineDouble()
    for _ in range(100):
        cell.step()
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
    assert cell.moves()[-2:] == ["retreat", "home"] and cell.q == HOME


@pytest.mark.parametrize(("path", "message"), [
    (None, "no contour received from the camera"),
    (OutlinePoints(message="every contour touches the border of the picture"), "touches the border"),
    (OutlinePoints(), "no object is chosen"),
    (outline_of([(0.5, 0.0)], 0), "the contour of Object_1 is a single point"),
    (outline_of([(0.5, -0.3), (0.52, -0.3), (0.5, -0.28)], 0), "the planning scene does not hold Object_1"),
])
def test_without_a_usable_contour_it_ends_in_error_with_the_reason(path: OutlinePoints | None, message: str) -> None:
    cell = OutlineDouble(selection_timeout=3.0, picture_timeout=3.0)
    cell.path = path
    cell.until("SELECTING")
    assert message in cell.status.message
    began = cell.now
    cell.until("ERROR")
    assert cell.now - began >= 2.9 and message in cell.status.message
    assert cell.requests == []


@pytest.mark.parametrize("timeout", [3.0, 0.0])  # the time of a camera restart does not count; 0: no limit
def test_selection_is_awaited(timeout: float) -> None:
    cell = OutlineDouble(selection_timeout=timeout, picture_timeout=30.0)
    chosen, cell.path = cell.path, OutlinePoints(message="no object is chosen")
    cell.until("SELECTING")
    cell.camera_on = timeout == 0.0
    steps(cell, 200)
    cell.camera_on = True
    steps(cell, 10)
    assert cell.status.state == "SELECTING"
    cell.path = chosen
    cell.until("DONE")


def test_contour_from_before_the_return_home_is_ignored() -> None:
    cell = OutlineDouble()
    cell.until("DONE")
    cell.camera_on = False
    cell.command("start")
    steps(cell, 20)
    assert cell.status.state == "SELECTING" and cell.moves() == WHOLE
    cell.camera_on = True
    cell.until("DONE")
    assert cell.moves() == WHOLE * 2


@pytest.mark.parametrize("stage", ["", "home"])  # of the plan during which it freezes
def test_frozen_camera_starts_no_motion(stage: str) -> None:
    cell, frozen = OutlineDouble(selection_timeout=0.0), []

    def freeze(request: m.PlanRequest | None = None) -> str:
        if not frozen and (request is None or request.stage == stage):
            frozen.append(request)
            cell.camera_on = False
            cell.now += 10
        return ""

    cell.unplannable = freeze
    if not stage:
        freeze()
    steps(cell, 200)
    assert frozen and cell.status.message == "no fresh picture" and executed(cell) == []
    cell.task.p = cell.task.p.model_copy(update={"selection_timeout": 1.0})
    cell.until("ERROR")
    assert cell.status.message == "no fresh picture" and executed(cell) == []
    cell.camera_on = True
    cell.command("start")
    cell.until("DONE")
    assert cell.moves() == WHOLE


@pytest.mark.parametrize(("can_retreat", "colliding"), [(True, None), (False, None), (False, ("base", "Object_2"))])
def test_arm_goes_home_first(can_retreat: bool, colliding: tuple[str, str] | None) -> None:
    cell = OutlineDouble()
    cell.q, cell.colliding = list(AWAY), colliding
    cell.unplannable = lambda r: "no_ik" if r.stage == "retreat" and not cell.moves() and not can_retreat else ""
    cell.until("DONE")
    assert cell.moves() == [*(["retreat"] if can_retreat else []), "home", *WHOLE]
    assert cell.status.failures == 0


def test_missing_topics_are_named() -> None:
    cell = OutlineDouble()
    view = cell.view()
    view.gripper, view.q = None, None
    assert cell.task.step(view) == []
    assert cell.status.message == "waiting for gripper/state, joint_states"
