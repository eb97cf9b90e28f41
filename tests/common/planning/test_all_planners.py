"""Every planner in the same cases: trivial, normal, unreachable, blocked, cancelled."""

import re

import numpy as np
import pytest

from common.planning.problem import Cancel
from common.robot.transforms import tool_down
from tests.common.planning.planner_checks import AROUND, LEFT, RIGHT, assert_sound, wall, with_planner
from tests.common.planning.planning_scenes import ROBOT, above, last, scene, solid, to_joints, to_pose

JOINT_GOALS = ["chomp", "joint_move", "lerp", "ompl", "ptp", "rrt_connect", "trajopt"]
POSE_GOALS = ["cartesian", "chomp", "lerp", "lin", "ompl", "ptp", "rrt_connect", "trajopt"]
ALL = sorted({*JOINT_GOALS, *POSE_GOALS})
QUICK = {"chomp": {"iterations": 30, "restarts": 1}, "trajopt": {"iterations": 15, "restarts": 1}}
PIPELINES = {name: with_planner(name) for name in ALL}
GIVING_UP = {name: with_planner(name, **QUICK.get(name, {})) for name in ALL}
AROUND_WALLS = ["chomp", "ompl", "rrt_connect", "trajopt"]
BLOCKED = [name for name in ALL if name not in ("ompl", "rrt_connect")]


def request_for(planner, T, start, **more):
    """A pose goal, or the joint positions that reach it for planners without pose goals."""
    if planner in POSE_GOALS:
        return to_pose(T, start, **more)
    return to_joints(above(*T[:3, 3]), start, **more)


@pytest.mark.parametrize("planner", JOINT_GOALS)
def test_joint_goal_is_reached(planner):
    request = to_joints(LEFT, RIGHT)
    response = PIPELINES[planner].plan(request, AROUND)
    assert_sound(PIPELINES[planner], request, AROUND, response)
    assert np.allclose(last(response), LEFT, atol=1e-6)
    assert response.fraction == 1.0


@pytest.mark.parametrize("planner", POSE_GOALS)
def test_pose_goal_is_reached(planner):
    T = tool_down(0.5, -0.05, 0.2, 0.3)
    request = to_pose(T, above(0.4, -0.3, 0.2))
    response = PIPELINES[planner].plan(request, AROUND)
    assert_sound(PIPELINES[planner], request, AROUND, response)
    assert np.allclose(ROBOT.fk(last(response)), T, atol=2e-4)
    assert response.planner == planner


@pytest.mark.parametrize("planner", ALL)
def test_goal_at_the_start_needs_no_motion(planner):
    request = to_pose(ROBOT.fk(LEFT), LEFT) if planner in POSE_GOALS else to_joints(LEFT, LEFT)
    response = PIPELINES[planner].plan(request, AROUND)
    trajectory = assert_sound(PIPELINES[planner], request, AROUND, response)
    assert np.allclose(trajectory.positions, LEFT, atol=1e-3)


@pytest.mark.parametrize("planner", POSE_GOALS)
def test_pose_out_of_reach_ends_with_no_ik(planner):
    response = PIPELINES[planner].plan(to_pose(tool_down(2.0, 0, 0.2), RIGHT), AROUND)
    assert response.error == "no_ik"
    assert response.trajectory is None


@pytest.mark.parametrize("planner", POSE_GOALS)
def test_pose_inside_an_obstacle_is_refused_with_its_name(planner):
    crate = solid("crate", "fixture", "box", [0.2, 0.2, 0.2], (0.5, 0.3, 0.2))
    blocked = scene(box=False)
    blocked.objects.append(crate)
    response = PIPELINES[planner].plan(to_pose(tool_down(0.5, 0.3, 0.2), RIGHT), blocked)
    assert response.error in ("goal_in_collision", "collision")
    assert response.colliding[1] == "crate"
    assert "crate" in response.message


@pytest.mark.parametrize("planner", BLOCKED)
def test_blocked_path_is_reported_with_waypoint_and_pair(planner):
    high = wall(height=2.0)
    request = request_for(planner, tool_down(0.5, 0.3, 0.2), RIGHT, stage="transfer")
    if planner in JOINT_GOALS:
        request = to_joints(LEFT, RIGHT, stage="transfer")
    response = GIVING_UP[planner].plan(request, high)
    assert not response.ok
    assert response.trajectory is None
    assert response.error == "collision"
    assert response.colliding[1] == "wall"
    assert re.match(rf"transfer: {planner}: .*\w+ collides with wall", response.message)
    if planner != "joint_move":  # it checks a single edge
        found = re.search(r"waypoint (\d+) of \d+", response.message)
        assert int(found[1]) == response.attempts[-1].waypoint
    assert "\n" not in response.message


@pytest.mark.parametrize("planner", AROUND_WALLS)
def test_path_around_a_wall_is_found(planner):
    low = wall(height=0.3, depth=0.3)
    request = to_joints(LEFT, RIGHT)
    assert not PIPELINES["lerp"].plan(request, low).ok
    response = PIPELINES[planner].plan(request, low)
    assert_sound(PIPELINES[planner], request, low, response)
    assert np.allclose(last(response), LEFT, atol=1e-6)


@pytest.mark.parametrize("planner", ALL)
def test_cancelled_planner_reports_it_or_has_finished(planner):
    cancel = Cancel()
    cancel.set()
    request = request_for(planner, tool_down(0.5, 0.3, 0.2), RIGHT)
    response = PIPELINES[planner].plan(request, wall(), cancel=cancel)
    assert not response.ok
    assert response.error == "cancelled" or planner == "joint_move"


@pytest.mark.parametrize("planner", ALL)
def test_same_request_gives_the_same_answer(planner):
    request = request_for(planner, tool_down(0.5, 0.0, 0.3, 0.2), RIGHT, seed=5)
    one, other = (PIPELINES[planner].plan(request, AROUND) for _ in range(2))
    assert [p.positions for p in one.trajectory.points] == [p.positions for p in other.trajectory.points]


@pytest.mark.parametrize("planner", ALL)
def test_slower_request_takes_longer(planner):
    durations = []
    for scaling in (0.1, 0.4):
        request = request_for(
            planner, tool_down(0.5, 0.0, 0.3, 0.2), RIGHT, velocity_scaling=scaling, acceleration_scaling=scaling
        )
        response = PIPELINES[planner].plan(request, AROUND)
        trajectory = assert_sound(PIPELINES[planner], request, AROUND, response)
        durations.append(trajectory.duration)
    assert durations[0] > 1.5 * durations[1]
