"""Every planner in the same cases: trivial, normal, unreachable, blocked, cancelled."""

import re

import numpy as np
import pytest

from common.robot.transforms import tool_down
from tests.common.planning.checks import CANCELLED, assert_refused, last, planned, with_planner
from tests.common.planning.requests import LEFT, RIGHT, above, to_joints, to_pose
from tests.common.planning.scenes import ROBOT, TABLE, scene, solid, wall

JOINT_GOALS = ["chomp", "joint_move", "lerp", "ompl", "ptp", "rrt_connect", "trajopt"]
POSE_GOALS = ["cartesian", "chomp", "lerp", "lin", "ompl", "ptp", "rrt_connect", "trajopt"]
ALL = sorted({*JOINT_GOALS, *POSE_GOALS})
QUICK = {"chomp": {"iterations": 10, "restarts": 0}, "trajopt": {"iterations": 5, "restarts": 0}}
PIPELINES = {name: with_planner(name) for name in ALL}
GIVING_UP = {name: with_planner(name, **QUICK.get(name, {})) for name in ALL}


def request_for(planner, T, start, **more):
    """A pose goal, or the joint positions that reach it for planners without pose goals."""
    return to_pose(T, start, **more) if planner in POSE_GOALS else to_joints(above(*T[:3, 3]), start, **more)


@pytest.mark.parametrize("planner", JOINT_GOALS)
def test_joint_goal_is_reached(planner):
    trajectory = planned(PIPELINES[planner], to_joints(LEFT, RIGHT), TABLE)
    assert np.allclose(trajectory.positions[-1], LEFT, atol=1e-6)


@pytest.mark.parametrize("planner", POSE_GOALS)
def test_pose_goal_is_reached(planner):
    T = tool_down(0.5, -0.05, 0.2, 0.3)
    trajectory = planned(PIPELINES[planner], to_pose(T, above(0.4, -0.3, 0.2)), TABLE)
    assert np.allclose(ROBOT.fk(trajectory.positions[-1]), T, atol=2e-4)


@pytest.mark.parametrize("planner", ALL)
def test_goal_at_the_start_needs_no_motion(planner):
    request = to_pose(ROBOT.fk(LEFT), LEFT) if planner in POSE_GOALS else to_joints(LEFT, LEFT)
    assert np.allclose(planned(PIPELINES[planner], request, TABLE).positions, LEFT, atol=1e-3)


@pytest.mark.parametrize("planner", POSE_GOALS)
def test_pose_out_of_reach_or_inside_an_obstacle_is_refused(planner):
    assert_refused(PIPELINES[planner].plan(to_pose(tool_down(2.0, 0, 0.2), RIGHT), TABLE), "no_ik", "")
    crate = scene((), solid("crate", "fixture", "box", [0.2, 0.2, 0.2], (0.5, 0.3, 0.2)), box=False)
    response = PIPELINES[planner].plan(to_pose(tool_down(0.5, 0.3, 0.2), RIGHT), crate)
    assert response.error in ("goal_in_collision", "collision")
    assert response.colliding[1] == "crate" and "crate" in response.message


@pytest.mark.parametrize(("place", "why"), [
    ((0.05, 0.0, 0.1), "panda_joint4 would be at -3.45, not in -3.07 to -0.07 rad"),
    ((0.9, 0.0, 0.1), "can be reached: the arm cannot reach it"),
    ((1.4, 0.0, 0.1), "it is 1.42 m from the first joint; the arm reaches 1."),
])
@pytest.mark.parametrize("planner", ["ptp", "rrt_connect"])
def test_unreachable_pose_is_reported_with_the_reason(planner, place, why):
    response = PIPELINES[planner].plan(to_pose(tool_down(*place), RIGHT), scene(box=False))
    assert_refused(response, "no_ik", why)
    assert why in response.attempts[-1].message


@pytest.mark.parametrize("planner", [name for name in ALL if name not in ("ompl", "rrt_connect")])
def test_blocked_path_is_reported_with_waypoint_and_pair(planner):
    request = request_for(planner, tool_down(0.5, 0.3, 0.2), RIGHT, stage="transfer")
    if planner in JOINT_GOALS:
        request = to_joints(LEFT, RIGHT, stage="transfer")
    response = GIVING_UP[planner].plan(request, wall(height=2.0))
    assert_refused(response, "collision", "")
    assert response.colliding[1] == "wall"
    assert re.match(rf"transfer: {planner}: .*\w+ collides with wall", response.message)
    assert {attempt.planner for attempt in response.attempts} == {planner}
    if planner != "joint_move":  # it checks a single edge
        found = re.search(r"waypoint (\d+) of \d+", response.message)
        assert int(found[1]) == response.attempts[-1].waypoint
    if planner in ("cartesian", "lin"):
        assert 0.1 < response.fraction < 0.6


@pytest.mark.parametrize("planner", ["chomp", "ompl", "rrt_connect", "trajopt"])
def test_path_around_a_wall_is_found(planner):
    low = wall(height=0.3, depth=0.3)
    request = to_joints(LEFT, RIGHT)
    assert not PIPELINES["lerp"].plan(request, low).ok
    assert np.allclose(planned(PIPELINES[planner], request, low).positions[-1], LEFT, atol=1e-6)


@pytest.mark.parametrize("planner", ALL)
def test_cancelled_planner_reports_it_or_has_finished(planner):
    response = PIPELINES[planner].plan(request_for(planner, tool_down(0.5, 0.3, 0.2), RIGHT), wall(), cancel=CANCELLED)
    assert not response.ok
    assert response.error == "cancelled" or planner == "joint_move"


@pytest.mark.parametrize("planner", ALL)
def test_same_request_gives_the_same_answer_and_a_slower_one_takes_longer(planner):
    durations, ends = [], []
    for scaling in (0.1, 0.4, 0.4):
        more = {"velocity_scaling": scaling, "acceleration_scaling": scaling, "seed": 5}
        request = request_for(planner, tool_down(0.5, 0.0, 0.3, 0.2), RIGHT, **more)
        response = PIPELINES[planner].plan(request, TABLE)
        last(response)
        durations.append(response.trajectory.points[-1].time_from_start)
        ends.append([point.positions for point in response.trajectory.points])
    assert durations[0] > 1.5 * durations[1] and ends[1] == ends[2]


@pytest.mark.parametrize("planner", ALL)
def test_lowest_speed_share_of_a_request_is_planned(planner):
    durations = []
    for scaling in (1e-3, 1e-4):
        request = request_for(planner, tool_down(0.5, 0.0, 0.3, 0.2), RIGHT, velocity_scaling=scaling, seed=5)
        response = PIPELINES[planner].plan(request, TABLE)
        last(response)
        durations.append(response.trajectory.points[-1].time_from_start)
    assert durations[1] == pytest.approx(10 * durations[0], rel=0.1)
