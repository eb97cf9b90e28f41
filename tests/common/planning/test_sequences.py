"""Sequences: of single motions with blends, and of regions passed without a stop."""

import math

import numpy as np
import pytest
from pydantic import ValidationError

from common.config import load_cell
from common.messages import ArcGoal, GoalSet, JointGoal, PlanRequest, PoseGoal, SequenceGoal, SequenceItem, Vector3
from common.planning.goal_sampling import distance_outside, nearest_pose_in, sample_pose
from common.planning.pipeline import PlanningPipeline
from common.planning.problem import Region, Result
from common.robot.transforms import tool_down
from tests.common.planning.checks import CANCELLED, PIPELINE, assert_refused, assert_sound, planned, tool_places
from tests.common.planning.requests import RIGHT, down, to
from tests.common.planning.scenes import EMPTY, HOME, ROBOT, TABLE, wall

ARC = ArcGoal(pose=down(0.5, 0.2, 0.3).pose, via=Vector3(x=0.55, y=0.1, z=0.35))
MIDDLE, ABOVE, LEFT_ABOVE = (0.5, 0.0, 0.2), (0.5, 0.0, 0.4), (0.5, 0.3, 0.4)


def line_to(x, y, z, blend_radius=0.0) -> SequenceItem:
    return SequenceItem(goal=down(x, y, z), straight=True, blend_radius=blend_radius)


def sequence(*items: SequenceItem) -> PlanRequest:
    return to(SequenceGoal(items=list(items)), RIGHT, stage="weave", planner="sequence")


def corners(radius: float) -> PlanRequest:
    return sequence(line_to(*MIDDLE, radius), line_to(*ABOVE, radius), line_to(*LEFT_ABOVE))


def stops(timed) -> int:
    """Number of stops between start and end."""
    return int((np.abs(timed.velocities[1:-1]).max(axis=1) < 1e-9).sum())


def test_lines_without_a_blend_stop_at_their_corners():
    timed = planned(PIPELINE, corners(0.0), EMPTY)
    assert stops(timed) == 2
    for corner in (MIDDLE, ABOVE, LEFT_ABOVE):
        assert np.linalg.norm(tool_places(timed) - corner, axis=1).min() < 1e-4


@pytest.mark.parametrize("radius", [0.02, 0.08])
def test_corner_is_blended_within_its_radius_without_a_stop(radius):
    timed = planned(PIPELINE, corners(radius), EMPTY)
    assert stops(timed) == 0
    way = tool_places(timed)
    for corner in (MIDDLE, ABOVE):
        assert 0.1 * radius < np.linalg.norm(way - corner, axis=1).min() < radius
    outside = np.linalg.norm(way[:, None] - np.array([MIDDLE, ABOVE]), axis=2).min(axis=1) > radius
    on_lines = np.stack([
        np.hypot(way[:, 0] - 0.5, way[:, 2] - 0.2), np.hypot(way[:, 0] - 0.5, way[:, 1]),
        np.hypot(way[:, 0] - 0.5, way[:, 2] - 0.4),
    ]).min(axis=0)
    assert on_lines[outside].max() < 3e-4
    assert np.allclose(ROBOT.fk(timed.positions[-1])[:3, 3], LEFT_ABOVE, atol=1e-4)
    assert timed.duration < planned(PIPELINE, corners(0.0), EMPTY).duration


def test_sequence_of_point_to_point_arc_and_line():
    timed = planned(PIPELINE, sequence(
        SequenceItem(goal=down(0.5, 0.0, 0.3), blend_radius=0.04), SequenceItem(goal=ARC, blend_radius=0.03),
        line_to(0.4, 0.2, 0.3), SequenceItem(goal=JointGoal(named="home"))), EMPTY)
    assert np.allclose(timed.positions[-1], HOME, atol=1e-6) and stops(timed) == 1
    assert np.linalg.norm(tool_places(timed) - (0.55, 0.1, 0.35), axis=1).min() < 1e-3


def test_colliding_blend_is_reported(monkeypatch):
    hit = Result(error="collision", message="waypoint 3 of 9: a collides with b", waypoint=3, colliding=("a", "b"))
    monkeypatch.setattr("common.planning.planners.sequence.blocked", lambda *_: hit)
    response = PIPELINE.plan(corners(0.05), EMPTY)
    text = "weave: sequence: blend of items 1 and 2 of 3: waypoint 3 of 9: a collides with b"
    assert (response.error, response.colliding, response.message) == ("collision", ("a", "b"), text)


def test_last_item_cannot_have_a_blend_radius():
    with pytest.raises(ValidationError, match="nothing follows"):
        SequenceGoal(items=[line_to(*MIDDLE, 0.1)])


BALL = (0.42, -0.18, 0.03)
RADIUS = 0.05


def about(x, y, z, side=0.04, tilt=0.25, yaw=math.pi) -> PoseGoal:
    return down(x, y, z, position_tolerance=Vector3(x=side, y=side, z=side), tilt_tolerance=tilt, yaw_tolerance=yaw)


VIA = about(BALL[0], BALL[1], BALL[2] + 0.1)
GRASP = about(*BALL, side=0.0, tilt=0.0)


def through(*goals, radius=RADIUS) -> PlanRequest:
    items = [SequenceItem(goal=goal, blend_radius=radius) for goal in goals[:-1]] + [SequenceItem(goal=goals[-1])]
    return to(SequenceGoal(items=items), HOME, seed=1, gripper_width=0.08)


def distance_from_via(timed) -> float:
    """Least distance of the tool from the intermediate region [m]."""
    away = np.abs(tool_places(timed) - (BALL[0], BALL[1], BALL[2] + 0.1)) - 0.02
    return float(np.linalg.norm(np.maximum(away, 0.0), axis=1).min())


def test_intermediate_region_is_passed_within_the_radius_without_a_stop():
    timed = planned(PIPELINE, through(VIA, GRASP), TABLE)
    assert np.abs(timed.velocities[1:-1]).max(axis=1).min() > 1e-3 and distance_from_via(timed) < RADIUS
    assert distance_outside(Region(tool_down(*BALL), np.zeros(3), 0.0, math.pi), ROBOT.fk(timed.positions[-1])) < 2e-4
    tool = tool_places(timed)
    low = tool[tool[:, 2] < BALL[2] + 0.04]
    assert np.linalg.norm(low[:, :2] - BALL[:2], axis=1).max() < 0.02, "the tool comes from above"


def test_one_motion_takes_less_time_than_separate_motions_and_is_repeatable():
    first = planned(PIPELINE, to(VIA, HOME, gripper_width=0.08), TABLE)
    second = planned(PIPELINE, to(GRASP, first.positions[-1], straight=True, gripper_width=0.08), TABLE)
    one, other = (PIPELINE.plan(through(VIA, GRASP), TABLE) for _ in range(2))
    assert one.trajectory.points[-1].time_from_start < 0.85 * (first.duration + second.duration)
    assert one.trajectory.points == other.trajectory.points


@pytest.mark.parametrize("name", ["cartesian_ompl", "chomp", "lerp", "trajopt", "pilz"])
def test_every_pipeline_passes_regions(name):
    cell = load_cell("panda", [f"pipeline={name}"])
    pipeline = PlanningPipeline(ROBOT, cell.motion, cell.pipeline)
    response = pipeline.plan(through(VIA, GRASP), TABLE)
    assert distance_from_via(assert_sound(pipeline, through(VIA, GRASP), TABLE, response)) < RADIUS
    assert response.planner == {"cartesian_ompl": "joint_move", "pilz": "sequence"}.get(name, name)


def test_blocked_segment_is_planned_by_the_planners():
    request = through(about(0.5, -0.1, 0.3), about(0.5, 0.3, 0.15))
    planned(PIPELINE, request, wall(0.35))
    lerp = request.model_copy(update={"planner": "lerp"})
    assert_refused(PIPELINE.plan(lerp, wall(0.35)), "collision", "legs: item ")


def test_reached_goal_of_a_final_set_is_reported():
    far, unreachable = about(0.3, -0.5, 0.3, side=0.0, tilt=0.0, yaw=0.0), about(1.2, 0.0, 0.6, yaw=0.0)
    for goals in ([far, GRASP, JointGoal(named="home")], [unreachable, GRASP]):
        response = PIPELINE.plan(through(VIA, GoalSet(goals=goals)), TABLE)
        assert (response.ok, response.goal_index) == (True, 1), response.message


@pytest.mark.parametrize(("request_", "code", "text"), [
    (corners(0.15), "bad_goal", "weave: sequence: blend of items 2 and 3 of 3: blend_radius 0.15 m reaches"),
    (sequence(line_to(*MIDDLE), line_to(1.2, 0.0, 0.2), line_to(*MIDDLE)), "no_ik", "item 2 of 3: waypoint "),
    (sequence(SequenceItem(goal=JointGoal(named="home"), straight=True)), "bad_goal", "item 1 of 1"),
    (through(VIA, about(0.9, 0.0, 0.9, side=0.0, yaw=0.0)), "no_ik", "legs: item 2 of 2: "),
    (through(about(0.5, 0.0, -0.1), about(0.5, 0.3, 0.2)), "goal_in_collision", "legs: item 1 of 2: "),
    (through(VIA, ARC), "no_planner", ""),
])
def test_impossible_item_or_blend_is_refused_with_its_number(request_, code, text):
    response = PIPELINE.plan(request_, TABLE)
    assert_refused(response, code, text)
    assert "waypoint" not in text or 1 / 3 < response.fraction < 2 / 3


def test_intermediate_joint_goal_is_passed_and_the_start_needs_no_motion():
    home, between = JointGoal(named="home"), JointGoal(positions=(HOME + 0.2).tolist())
    timed = planned(PIPELINE, through(between, home, radius=0.0), TABLE)
    assert np.abs(timed.positions - (HOME + 0.2)).max(axis=1).min() < 1e-6
    assert np.allclose(planned(PIPELINE, through(home, home), TABLE).positions, HOME, atol=1e-6)


def test_cancelling_ends_a_sequence():
    for request in (corners(0.02), through(VIA, GRASP)):
        assert PIPELINE.plan(request, TABLE, cancel=CANCELLED).error == "cancelled"


def test_nearest_pose_is_inside_the_region_and_inner_poses_are_unchanged():
    rng = np.random.default_rng(0)
    T = tool_down(0.5, 0.1, 0.3, 0.7)
    small = Region(T, np.array([0.02, 0.01, 0.03]), 0.2, 0.4)
    wide = Region(T, np.array([0.3, 0.3, 0.3]), 3.0, math.pi)
    for _ in range(100):
        assert distance_outside(small, nearest_pose_in(small, sample_pose(wide, rng))) < 1e-6
        inside = sample_pose(small, rng)
        np.testing.assert_allclose(nearest_pose_in(small, inside), inside, atol=1e-6)
