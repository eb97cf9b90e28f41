"""What distinguishes the planners: OMPL, straight lines of the tool, lerp; and time limits and cancellation."""

import math
import threading
import time

import numpy as np
import pytest
from ompl import geometric as og

from common.errors import ConfigError, UnknownName
from common.messages import Vector3
from common.planning import retiming
from common.planning.collision import CollisionWorld
from common.planning.goal_sampling import distance_outside
from common.planning.joint_paths import line
from common.planning.kernel.library import library
from common.planning.pipeline import PlanningPipeline
from common.planning.planners import lerp, load_planner, planner_names
from common.planning.problem import Cancel, Region
from common.planning.trajectory import timed_path
from common.planning.validation import fine_samples
from common.robot.transforms import tool_down
from tests.common.planning.planner_checks import AROUND, LEFT, RIGHT, assert_sound, wall, with_planner
from tests.common.planning.planning_scenes import (
    CELL,
    HOME,
    ROBOT,
    above,
    last,
    scene,
    solid,
    to_joints,
    to_pose,
)

PIPELINE = PlanningPipeline(ROBOT, CELL.motion, CELL.pipeline)
ALGORITHMS = ["RRTConnect", "RRT", "KPIECE1", "BKPIECE1", "LBKPIECE1", "AORRTC", "BITstar"]


def test_pipeline_finds_a_path_around_a_wall():
    request = to_joints(LEFT, RIGHT)
    response = PIPELINE.plan(request, wall())
    assert_sound(PIPELINE, request, wall(), response)
    errors = [a.error for a in response.attempts]
    if library() is None:
        assert response.planner == "ompl" and len(errors) == 1 + CELL.motion.planning_attempts
    else:
        assert response.planner == "rrt_connect"
    assert errors[0] == "collision" and not any(errors[1:])
    assert 2 <= len(errors) <= 1 + CELL.motion.planning_attempts
    assert response.attempts[0].colliding[1] == "wall"
    assert np.allclose(last(response), LEFT, atol=1e-6)


@pytest.mark.usefixtures("no_kernel")
def test_ompl_plans_where_the_kernel_is_not_built():
    pipeline = PlanningPipeline(ROBOT, CELL.motion, CELL.pipeline)
    response = pipeline.plan(to_joints(LEFT, RIGHT, planning_attempts=1), wall())
    assert_sound(PIPELINE, to_joints(LEFT, RIGHT), wall(), response)
    assert response.planner == "ompl"


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.slow
def test_each_algorithm_of_ompl_finds_a_path_around_a_wall(algorithm):
    request = to_joints(LEFT, RIGHT, planning_attempts=1, planning_time=20)
    response = with_planner("ompl", algorithm=algorithm, improving_time=1.5).plan(request, wall())
    assert_sound(PIPELINE, request, wall(), response)


def test_unknown_algorithm_or_planner_is_refused_with_the_choices():
    with pytest.raises(ConfigError, match=r"pipeline.planners.ompl.algorithm.*RRTConnect"):
        with_planner("ompl", algorithm="Dijkstra")
    with pytest.raises(UnknownName, match=r"cartesian, .*joint_move, .*ompl"):
        load_planner("dijkstra", {})
    with pytest.raises(ConfigError, match="cannot be imported"):
        load_planner("missing.planner", {})
    with pytest.raises(ConfigError, match=r"plan\(\) and Options"):
        load_planner("common.planning.path", {})
    assert {"cartesian", "joint_move", "lerp", "ompl"} <= set(planner_names())


def test_same_seed_gives_the_same_path_and_another_seed_another():
    def path(seed: int) -> np.ndarray:
        response = PIPELINE.plan(to_joints(LEFT, RIGHT, seed=seed, planner="ompl", planning_attempts=1), wall())
        return timed_path(response.trajectory).positions

    assert np.array_equal(path(1), path(1))
    assert path(1).shape != path(2).shape or not np.allclose(path(1), path(2))


def test_best_of_several_attempts_is_returned():
    def least(attempts: int) -> float:
        request = to_joints(LEFT, RIGHT, seed=3, planner="ompl", planning_attempts=attempts)
        response = PIPELINE.plan(request, wall())
        assert len(response.attempts) == attempts
        return response.trajectory.points[-1].time_from_start

    assert least(6) <= least(1) * 1.05


def test_sampled_path_ends_in_the_region_of_the_goal():
    T = tool_down(0.5, 0.3, 0.2, 0.3)
    tolerance = Vector3(x=0.04, y=0.04, z=0.04)
    request = to_pose(
        T, RIGHT, planner="ompl", position_tolerance=tolerance, tilt_tolerance=0.25, yaw_tolerance=3.14
    )
    response = PIPELINE.plan(request, wall())
    assert_sound(PIPELINE, request, wall(), response)
    assert distance_outside(Region(T, np.full(3, 0.02), 0.25, 3.14), ROBOT.fk(last(response))) < 1e-3


def test_distance_outside_a_region():
    T = tool_down(0.5, 0.0, 0.2, 0.0)
    region = Region(T, np.full(3, 0.02), 0.2, 0.5)
    assert distance_outside(region, tool_down(0.515, 0.0, 0.2, 0.4)) < 0
    assert distance_outside(region, tool_down(0.53, 0.0, 0.2, 0.0)) == pytest.approx(0.01)
    assert distance_outside(region, tool_down(0.5, 0.0, 0.2, 0.6)) == pytest.approx(0.1)


def test_tool_follows_a_straight_line_and_turns_evenly():
    T_goal = tool_down(0.55, 0.1, 0.3, 0.8)
    start = above(0.4, -0.2, 0.2)
    T_start = ROBOT.fk(start)
    response = PIPELINE.plan(to_pose(T_goal, start, straight=True), scene(box=False))
    way = T_goal[:3, 3] - T_start[:3, 3]
    path, _ = fine_samples(timed_path(response.trajectory), 0.01)
    for q in path:
        T = ROBOT.fk(q)
        share = (T[:3, 3] - T_start[:3, 3]) @ way / (way @ way)
        assert np.linalg.norm(T[:3, 3] - T_start[:3, 3] - share * way) < 5e-4
        turned = math.atan2(T[1, 0], T[0, 0])
        assert abs(turned - 0.8 * share) < 0.01
        assert T[2, 2] < -0.9999


def test_line_into_an_obstacle_is_reported_with_waypoint_and_pair():
    extra = solid("wall", "fixture", "box", [0.3, 0.02, 0.6], (0.5, 0.0, 0.3))
    blocked = scene(box=False)
    blocked.objects.append(extra)
    response = PIPELINE.plan(to_pose(tool_down(0.5, 0.3, 0.2), RIGHT, straight=True, stage="transfer"), blocked)
    assert not response.ok
    assert response.error == "collision"
    assert response.colliding[1] == "wall"
    assert 0.1 < response.fraction < 0.6
    assert response.message.startswith(f"transfer: cartesian: waypoint {response.attempts[-1].waypoint} of 60: ")
    assert "collides with wall" in response.message
    assert {a.planner for a in response.attempts} == {"cartesian"}


def test_line_out_of_reach_is_reported_with_its_fraction():
    response = PIPELINE.plan(to_pose(tool_down(1.2, -0.3, 0.2), RIGHT, straight=True), scene())
    assert response.error == "no_ik"
    assert 0 < response.fraction < 0.9
    assert "fraction" in response.message


def test_unreachable_pose_ends_with_no_ik_of_every_planner():
    response = PIPELINE.plan(to_pose(tool_down(2.0, 0, 0.2), RIGHT, planning_time=5), AROUND)
    assert {a.error for a in response.attempts} == {"no_ik"}
    assert not response.ok


@pytest.mark.parametrize("algorithm", ["AORRTC", "RRTConnect"])
def test_planning_ends_when_its_time_is_up(algorithm):
    request = to_joints(LEFT, RIGHT, planning_time=0.05, planning_attempts=100)  # an attempt takes 4 ms or less
    began = time.monotonic()
    response = with_planner("ompl", algorithm=algorithm, improving_time=60).plan(request, wall())
    assert time.monotonic() - began < 5
    assert response.ok or response.error == "timeout"
    assert len(response.attempts) < 100


def test_planning_ends_when_it_is_cancelled():
    request = to_joints(LEFT, RIGHT, planning_time=60)
    cancel = Cancel()
    threading.Timer(0.3, cancel.set).start()
    began = time.monotonic()
    with_planner("ompl", algorithm="AORRTC", improving_time=60).plan(request, wall(), cancel=cancel)
    assert time.monotonic() - began < 10
    assert PIPELINE.plan(to_joints(HOME, RIGHT), AROUND).ok


def test_cancelling_ends_the_shortcuts_of_ompl(monkeypatch):
    cancel, checked = Cancel(), []

    class CancelledAtOnce(og.PathSimplifier):
        def reduceVertices(self, path):
            cancel.set()
            monkeypatch.setattr(CollisionWorld, "edge_free", lambda *ends: checked.append(ends))
            return super().reduceVertices(path)

    monkeypatch.setattr(og, "PathSimplifier", CancelledAtOnce)
    response = PIPELINE.plan(to_joints(LEFT, RIGHT, planner="ompl"), wall(), cancel=cancel)
    assert (response.error, checked) == ("cancelled", [])


@pytest.mark.parametrize(("late", "error"), [(525, ""), (575, "timeout")])
def test_timing_has_a_tenth_of_the_budget_more(monkeypatch, late, error):
    monkeypatch.setattr(retiming, "monotonic", lambda: time.monotonic() + late)
    assert PIPELINE.plan(to_joints(LEFT, RIGHT, planner="ompl", planning_time=500.0), wall()).error == error


def test_lerp_path_is_a_straight_line_in_joint_space():
    pipeline = with_planner("lerp")
    request = to_joints(LEFT, RIGHT)
    trajectory = assert_sound(pipeline, request, AROUND, pipeline.plan(request, AROUND))
    span = LEFT - RIGHT
    share = (trajectory.positions - RIGHT) @ span / (span @ span)
    assert np.allclose(trajectory.positions, RIGHT + share[:, None] * span, atol=1e-9)
    assert (np.diff(share) > 0).all()


def test_line_has_the_requested_number_of_steps():
    waypoints = line(RIGHT, LEFT, 40)
    assert len(waypoints) == 41
    assert np.allclose(np.diff(waypoints, axis=0), (LEFT - RIGHT) / 40)
    assert np.array_equal(waypoints[-1], LEFT)


@pytest.mark.parametrize("steps", [10, 40])
def test_collision_is_reported_with_its_waypoint(steps):
    response = with_planner("lerp", steps=steps).plan(to_joints(LEFT, RIGHT), wall())
    waypoint = response.attempts[-1].waypoint
    assert f"waypoint {waypoint} of {steps}: " in response.message
    assert 0.2 < waypoint / steps < 0.6
    assert response.fraction == pytest.approx((waypoint - 1) / steps)


def test_another_ik_solution_is_tried_when_the_line_to_the_first_is_blocked(monkeypatch):
    monkeypatch.setattr(lerp, "joint_goals", lambda *_, **__: [LEFT, above(0.4, -0.2, 0.3)])
    response = with_planner("lerp").plan(to_pose(tool_down(0.4, -0.2, 0.3), RIGHT), wall())
    assert np.allclose(last(response), above(0.4, -0.2, 0.3), atol=1e-6)


def test_lerp_does_not_accept_straight_lines_of_the_tool():
    response = with_planner("lerp").plan(to_pose(tool_down(0.5, 0.0, 0.3), RIGHT, straight=True), AROUND)
    assert response.error == "no_planner"
    assert "straight line" in response.message


def test_invalid_number_of_steps_is_refused():
    with pytest.raises(ConfigError, match=r"pipeline.planners.lerp.steps"):
        with_planner("lerp", steps=0)
