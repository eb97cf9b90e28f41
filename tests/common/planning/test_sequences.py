import numpy as np
import pytest
from pydantic import ValidationError

from common.messages import ArcGoal, JointGoal, PlanRequest, PoseGoal, SequenceGoal, SequenceItem, Vector3
from common.planning.planners.sequence import NoBlend, blend, blend_entry, resampled
from common.planning.problem import Cancel, Result
from common.planning.validation import fine_samples
from common.robot.transforms import matrix_to_pose, tool_down
from tests.common.planning.planner_checks import RIGHT, assert_sound, with_planner
from tests.common.planning.planning_scenes import HOME, ROBOT, last, scene

PIPELINE = with_planner("sequence")
EMPTY = scene(box=False)
MIDDLE, ABOVE, LEFT_ABOVE = (0.5, 0.0, 0.2), (0.5, 0.0, 0.4), (0.5, 0.3, 0.4)


def line_to(x, y, z, blend_radius=0.0) -> SequenceItem:
    return SequenceItem(
        goal=PoseGoal(pose=matrix_to_pose(tool_down(x, y, z))), straight=True, blend_radius=blend_radius
    )


def corners(radius: float) -> PlanRequest:
    items = [line_to(*MIDDLE, radius), line_to(*ABOVE, radius), line_to(*LEFT_ABOVE)]
    return PlanRequest(id="1", start=list(RIGHT), goal=SequenceGoal(items=items), stage="weave")


def tool_way(timed) -> np.ndarray:
    path, _ = fine_samples(timed, 0.003)
    return np.array([ROBOT.fk(q)[:3, 3] for q in path])


def stops(timed) -> int:
    """Number of stops between start and end."""
    return int((np.abs(timed.velocities[1:-1]).max(axis=1) < 1e-9).sum())


def test_lines_without_a_blend_stop_at_their_corners():
    timed = assert_sound(PIPELINE, corners(0.0), EMPTY, PIPELINE.plan(corners(0.0), EMPTY))
    assert stops(timed) == 2
    way = tool_way(timed)
    for corner in (MIDDLE, ABOVE, LEFT_ABOVE):
        assert np.linalg.norm(way - corner, axis=1).min() < 1e-4


@pytest.mark.parametrize("radius", [0.02, 0.08])
def test_corner_is_blended_within_its_radius_without_a_stop(radius):
    response = PIPELINE.plan(corners(radius), EMPTY)
    timed = assert_sound(PIPELINE, corners(radius), EMPTY, response)
    assert stops(timed) == 0
    way = tool_way(timed)
    for corner in (MIDDLE, ABOVE):
        assert 0.1 * radius < np.linalg.norm(way - corner, axis=1).min() < radius
    outside = np.linalg.norm(way[:, None] - np.array([MIDDLE, ABOVE]), axis=2).min(axis=1) > radius
    on_lines = np.stack([
        np.hypot(way[:, 0] - 0.5, way[:, 2] - 0.2), np.hypot(way[:, 0] - 0.5, way[:, 1]),
        np.hypot(way[:, 0] - 0.5, way[:, 2] - 0.4),
    ]).min(axis=0)
    assert on_lines[outside].max() < 3e-4
    assert np.allclose(ROBOT.fk(last(response))[:3, 3], LEFT_ABOVE, atol=1e-4)
    stopping = PIPELINE.plan(corners(0.0), EMPTY)
    assert timed.duration < stopping.trajectory.points[-1].time_from_start


def test_sequence_of_point_to_point_arc_and_line():
    items = [
        SequenceItem(goal=PoseGoal(pose=matrix_to_pose(tool_down(0.5, 0.0, 0.3))), blend_radius=0.04),
        SequenceItem(
            goal=ArcGoal(pose=matrix_to_pose(tool_down(0.5, 0.2, 0.3)), via=Vector3(x=0.55, y=0.1, z=0.35)),
            blend_radius=0.03,
        ),
        line_to(0.4, 0.2, 0.3),
        SequenceItem(goal=JointGoal(named="home")),
    ]
    request = PlanRequest(id="1", start=list(RIGHT), goal=SequenceGoal(items=items))
    response = PIPELINE.plan(request, EMPTY)
    timed = assert_sound(PIPELINE, request, EMPTY, response)
    assert np.allclose(last(response), HOME, atol=1e-6)
    assert stops(timed) == 1
    assert np.linalg.norm(tool_way(timed) - (0.55, 0.1, 0.35), axis=1).min() < 1e-3


def test_blend_larger_than_a_motion_is_refused():
    response = PIPELINE.plan(corners(0.15), EMPTY)
    assert response.error == "bad_goal"
    assert response.message.startswith("weave: sequence: blend of items 2 and 3 of 3: blend_radius 0.15 m reaches")


def test_impossible_item_is_reported_and_no_trajectory_is_returned():
    items = [line_to(*MIDDLE, 0.02), line_to(1.2, 0.0, 0.2), line_to(*MIDDLE)]
    request = PlanRequest(id="1", start=list(RIGHT), goal=SequenceGoal(items=items))
    response = PIPELINE.plan(request, EMPTY)
    assert response.error == "no_ik"
    assert "item 2 of 3: waypoint " in response.message
    assert response.trajectory is None
    assert 1 / 3 < response.fraction < 2 / 3


def test_colliding_blend_is_reported(monkeypatch):
    hit = Result(error="collision", message="waypoint 3 of 9: a collides with b", waypoint=3, colliding=("a", "b"))
    monkeypatch.setattr("common.planning.planners.sequence.blocked", lambda *_: hit)
    response = PIPELINE.plan(corners(0.05), EMPTY)
    assert response.error == "collision"
    assert response.colliding == ("a", "b")
    text = "weave: sequence: blend of items 1 and 2 of 3: waypoint 3 of 9: a collides with b"
    assert response.message == text


def test_straight_line_to_joint_positions_is_a_bad_goal():
    items = [SequenceItem(goal=JointGoal(named="home"), straight=True)]
    response = PIPELINE.plan(PlanRequest(id="1", start=list(RIGHT), goal=SequenceGoal(items=items)), EMPTY)
    assert response.error == "bad_goal"
    assert "item 1 of 1" in response.message


def test_cancelling_ends_a_sequence():
    cancel = Cancel()
    cancel.set()
    assert PIPELINE.plan(corners(0.02), EMPTY, cancel=cancel).error == "cancelled"


def test_last_item_cannot_have_a_blend_radius():
    with pytest.raises(ValidationError, match="nothing follows"):
        SequenceGoal(items=[line_to(*MIDDLE, 0.1)])


def test_blend_is_tangent_to_both_motions():
    before, after = np.linspace([0.0, 0.0], [1.0, 0.0], 51), np.linspace([1.0, 0.0], [1.0, 1.0], 51)
    rounded = blend(before, after)
    assert np.allclose(rounded[[0, -1]], [[0, 0], [1, 1]])
    steps = np.diff(rounded, axis=0)
    assert np.allclose(steps[0], [0.02, 0], atol=1e-3)
    assert np.allclose(steps[-1], [0, 0.02], atol=1e-3)
    assert np.abs(np.diff(steps, axis=0)).max() < 0.003
    assert 0.1 < np.linalg.norm(rounded - [1, 0], axis=1).min() < 1


def test_blend_entry_is_where_the_tool_stays_within_the_radius():
    tool = np.linspace([0.0, 0, 0], [1.0, 0, 0], 11)
    assert blend_entry(tool, tool[-1], 0.25) == 8
    with pytest.raises(NoBlend):
        blend_entry(tool, tool[-1], 1.5)
    assert np.allclose(resampled(tool, np.array([0.0, 0.55, 1.0]))[:, 0], [0, 0.55, 1])
