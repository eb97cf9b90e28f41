"""Sequences of regions: passed without a stop, in the least time, with segments of any planner."""

import math

import numpy as np
import pytest

from common.config import load_cell
from common.messages import ArcGoal, GoalSet, JointGoal, PlanRequest, PoseGoal, SequenceGoal, SequenceItem, Vector3
from common.planning.goal_sampling import distance_outside, nearest_pose_in, sample_pose
from common.planning.pipeline import PlanningPipeline
from common.planning.problem import Cancel, Region
from common.planning.validation import fine_samples
from common.robot.transforms import matrix_to_pose, tool_down
from tests.common.planning.planner_checks import assert_sound, wall, with_planner
from tests.common.planning.planning_scenes import CELL, HOME, ROBOT, SPREAD, last, scene

PIPELINE = PlanningPipeline(ROBOT, CELL.motion, CELL.pipeline)
TABLE = scene(SPREAD)
BALL = (0.42, -0.18, 0.03)
RADIUS = 0.05


def about(x, y, z, side=0.04, tilt=0.25, yaw=math.pi) -> PoseGoal:
    return PoseGoal(pose=matrix_to_pose(tool_down(x, y, z)), position_tolerance=Vector3(x=side, y=side, z=side),
                    tilt_tolerance=tilt, yaw_tolerance=yaw)


VIA = about(BALL[0], BALL[1], BALL[2] + 0.1)
GRASP = about(*BALL, side=0.0, tilt=0.0)
BEYOND = about(0.5, 0.3, 0.2)


def through(*goals, radius=RADIUS, start=HOME, **more) -> PlanRequest:
    items = [SequenceItem(goal=goal, blend_radius=radius) for goal in goals[:-1]] + [SequenceItem(goal=goals[-1])]
    return PlanRequest(id="1", start=list(start), goal=SequenceGoal(items=items), seed=1, gripper_width=0.08, **more)


def region(goal: PoseGoal) -> Region:
    side = goal.position_tolerance
    sides = np.array([side.x, side.y, side.z])
    place = goal.pose.position
    T = tool_down(place.x, place.y, place.z)
    return Region(T, sides / 2, goal.tilt_tolerance, goal.yaw_tolerance)


def passes_by(timed, goal: PoseGoal) -> float:
    """Least distance of the tool from a region [m]."""
    path, _ = fine_samples(timed, 0.003)
    place, side = goal.pose.position, goal.position_tolerance.x / 2
    away = np.abs([ROBOT.fk(q)[:3, 3] - (place.x, place.y, place.z) for q in path]) - side
    return float(np.linalg.norm(np.maximum(away, 0.0), axis=1).min())


def test_intermediate_region_is_passed_within_the_radius_without_a_stop():
    response = PIPELINE.plan(through(VIA, GRASP), TABLE)
    timed = assert_sound(PIPELINE, through(VIA, GRASP), TABLE, response)
    assert np.abs(timed.velocities[1:-1]).max(axis=1).min() > 1e-3
    assert passes_by(timed, VIA) < RADIUS
    assert distance_outside(region(GRASP), ROBOT.fk(last(response))) < 2e-4
    path, _ = fine_samples(timed, 0.003)
    tool = np.array([ROBOT.fk(q)[:3, 3] for q in path])
    low = tool[tool[:, 2] < BALL[2] + 0.04]
    assert np.linalg.norm(low[:, :2] - BALL[:2], axis=1).max() < 0.02, "the tool comes from above"


def test_one_motion_takes_less_time_than_separate_motions():
    first = PIPELINE.plan(PlanRequest(id="1", start=HOME.tolist(), goal=VIA, gripper_width=0.08), TABLE)
    second = PIPELINE.plan(PlanRequest(
        id="2", start=last(first).tolist(), goal=GRASP, straight=True, gripper_width=0.08), TABLE)
    apart = sum(response.trajectory.points[-1].time_from_start for response in (first, second))
    together = PIPELINE.plan(through(VIA, GRASP), TABLE).trajectory.points[-1].time_from_start
    assert together < 0.85 * apart


@pytest.mark.parametrize("name", ["cartesian_ompl", "chomp", "lerp", "trajopt", "pilz"])
def test_every_pipeline_passes_regions(name):
    cell = load_cell("panda", [f"pipeline={name}"])
    pipeline = PlanningPipeline(ROBOT, cell.motion, cell.pipeline)
    response = pipeline.plan(through(VIA, GRASP), TABLE)
    timed = assert_sound(pipeline, through(VIA, GRASP), TABLE, response)
    assert response.planner == {"cartesian_ompl": "joint_move", "pilz": "sequence"}.get(name, name)
    assert passes_by(timed, VIA) < RADIUS


def test_blocked_segment_is_planned_by_the_planners():
    across = wall(0.35)
    request = through(about(0.5, -0.1, 0.3), about(0.5, 0.3, 0.15))
    response = PIPELINE.plan(request, across)
    assert_sound(PIPELINE, request, across, response)
    lone = with_planner("lerp").plan(request, across)
    assert (lone.ok, lone.error) == (False, "collision")
    assert lone.message.startswith("legs: item ")


def test_reached_goal_of_a_final_set_is_reported():
    far = about(0.3, -0.5, 0.3, side=0.0, tilt=0.0, yaw=0.0)
    request = through(VIA, GoalSet(goals=[far, GRASP, JointGoal(named="home")]))
    response = PIPELINE.plan(request, TABLE)
    assert response.ok, response.message
    assert response.goal_index == 1
    unreachable = about(1.2, 0.0, 0.6, yaw=0.0)
    response = PIPELINE.plan(through(VIA, GoalSet(goals=[unreachable, GRASP])), TABLE)
    assert (response.ok, response.goal_index) == (True, 1)


def test_unreachable_item_is_reported_with_its_number():
    response = PIPELINE.plan(through(VIA, about(0.9, 0.0, 0.9, side=0.0, yaw=0.0)), TABLE)
    assert response.error == "no_ik"
    assert response.message.startswith("legs: item 2 of 2: ")
    response = PIPELINE.plan(through(about(0.5, 0.0, -0.1), BEYOND), TABLE)
    assert response.error == "goal_in_collision"
    assert response.message.startswith("legs: item 1 of 2: ")


def test_intermediate_joint_goal_is_passed_and_the_start_needs_no_motion():
    between = JointGoal(positions=(HOME + 0.2).tolist())
    response = PIPELINE.plan(through(between, JointGoal(named="home"), radius=0.0), TABLE)
    timed = assert_sound(PIPELINE, through(between, JointGoal(named="home")), TABLE, response)
    assert np.abs(timed.positions - (HOME + 0.2)).max(axis=1).min() < 1e-6
    still = PIPELINE.plan(through(JointGoal(named="home"), JointGoal(named="home")), TABLE)
    assert np.allclose(assert_sound(PIPELINE, through(VIA), TABLE, still).positions, HOME, atol=1e-6)


def test_arcs_are_left_to_other_planners():
    arc = ArcGoal(pose=matrix_to_pose(tool_down(0.5, 0.2, 0.3)), via=Vector3(x=0.55, y=0.1, z=0.35))
    assert PIPELINE.plan(through(VIA, arc), TABLE).error == "no_planner"


def test_search_ends_when_it_is_cancelled():
    cancel = Cancel()
    cancel.set()
    assert PIPELINE.plan(through(VIA, GRASP), TABLE, cancel=cancel).error == "cancelled"


def test_same_sequence_request_gives_the_same_answer():
    one, other = (PIPELINE.plan(through(VIA, GRASP), TABLE).trajectory for _ in range(2))
    assert one.points == other.points


@pytest.mark.parametrize("seed", range(4))
def test_nearest_pose_is_inside_the_region_and_inner_poses_are_unchanged(seed):
    rng = np.random.default_rng(seed)
    T = tool_down(0.5, 0.1, 0.3, 0.7)
    small = Region(T, np.array([0.02, 0.01, 0.03]), 0.2, 0.4)
    wide = Region(T, np.array([0.3, 0.3, 0.3]), 3.0, math.pi)
    for _ in range(50):
        pose = sample_pose(wide, rng)
        assert distance_outside(small, nearest_pose_in(small, pose)) < 1e-6
        inside = sample_pose(small, rng)
        np.testing.assert_allclose(nearest_pose_in(small, inside), inside, atol=1e-6)
