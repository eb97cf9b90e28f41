"""All planners share the same checks: end at the goal, limits, free of collision at a finer step, times increase."""

import math
import threading
import time

import numpy as np
import pytest
from ompl import geometric as og

from common.config import Pipeline
from common.errors import ConfigError, UnknownName
from common.messages import PlanningScene, PlanRequest, PlanResponse, Vector3
from common.planning import retiming
from common.planning.collision import CollisionWorld
from common.planning.goal_sampling import distance_outside
from common.planning.kernel.library import library
from common.planning.pipeline import PlanningPipeline
from common.planning.planners import load_planner, planner_names
from common.planning.problem import Cancel, Region
from common.planning.trajectory import timed_path
from common.planning.validation import fine_samples
from common.robot.transforms import tool_down
from tests.common.planning.planning_scenes import (
    CELL,
    HOME,
    ROBOT,
    SPREAD,
    above,
    last,
    scene,
    solid,
    to_joints,
    to_pose,
)

PIPELINE = PlanningPipeline(ROBOT, CELL.motion, CELL.pipeline)
AROUND = scene(SPREAD)
ALGORITHMS = ["RRTConnect", "RRT", "KPIECE1", "BKPIECE1", "LBKPIECE1", "AORRTC", "BITstar"]


def with_planner(name: str, **options) -> PlanningPipeline:
    entries = [{"name": name, "options": options}]
    return PlanningPipeline(ROBOT, CELL.motion, Pipeline.model_validate({"planners": entries}))


def assert_sound(request: PlanRequest, of: PlanningScene, response: PlanResponse) -> None:
    assert response.ok, response.message
    trajectory = timed_path(PlanResponse.model_validate(response.model_dump()).trajectory)
    assert (np.diff(trajectory.times) > 0).all()
    assert np.allclose(trajectory.positions[0], request.start, atol=1e-6)
    assert np.abs(trajectory.velocities[[0, -1]]).max() < 1e-9
    assert (np.abs(trajectory.velocities) <= 0.2 * ROBOT.velocity * 1.001).all()
    assert (np.abs(trajectory.accelerations) <= 0.2 * ROBOT.acceleration * 1.001).all()
    world = PIPELINE.world(request, of, request.start)
    path, _ = fine_samples(trajectory, 0.005)
    assert not any(world.collides(q) for q in path)
    assert all(ROBOT.within_limits(q) for q in path)
    assert response.attempts
    assert response.attempts[-1].error == ""


def wall() -> PlanningScene:
    """A wall across the table that blocks the straight edge between both sides."""
    extra = solid("wall", "fixture", "box", [0.5, 0.02, 0.4], (0.55, 0.0, 0.2))
    return AROUND.model_copy(update={"objects": [*scene(box=False).objects, extra]})


LEFT, RIGHT = above(0.5, 0.3, 0.2), above(0.5, -0.3, 0.2)


@pytest.mark.parametrize("planner", ["joint_move", "ompl"])
def test_joint_goal_is_reached(planner):
    request = to_joints(LEFT, RIGHT, planner=planner)
    response = PIPELINE.plan(request, AROUND)
    assert_sound(request, AROUND, response)
    assert np.allclose(last(response), LEFT, atol=1e-6)
    assert response.planner == planner


@pytest.mark.parametrize("planner", ["cartesian", "ompl"])
def test_pose_goal_is_reached(planner):
    T = tool_down(0.5, -0.05, 0.2, 0.3)
    request = to_pose(T, above(0.4, -0.3, 0.2), planner=planner)
    response = PIPELINE.plan(request, AROUND)
    assert_sound(request, AROUND, response)
    assert np.allclose(ROBOT.fk(last(response)), T, atol=2e-4)
    assert response.fraction == 1.0


def test_way_around_a_wall_is_found_where_the_straight_edge_is_blocked():
    request = to_joints(LEFT, RIGHT)
    response = PIPELINE.plan(request, wall())
    assert_sound(request, wall(), response)
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
def test_ompl_finds_the_way_where_the_kernel_is_not_built():
    pipeline = PlanningPipeline(ROBOT, CELL.motion, CELL.pipeline)
    response = pipeline.plan(to_joints(LEFT, RIGHT, planning_attempts=1), wall())
    assert_sound(to_joints(LEFT, RIGHT), wall(), response)
    assert response.planner == "ompl"


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.slow
def test_each_algorithm_of_ompl_finds_a_way_around_a_wall(algorithm):
    request = to_joints(LEFT, RIGHT, planning_attempts=1, planning_time=20)
    response = with_planner("ompl", algorithm=algorithm, improving_time=1.5).plan(request, wall())
    assert_sound(request, wall(), response)


def test_algorithm_that_is_not_known_is_refused_with_the_choices():
    with pytest.raises(ConfigError, match=r"pipeline.planners.ompl.algorithm.*RRTConnect"):
        with_planner("ompl", algorithm="Dijkstra")
    with pytest.raises(UnknownName, match=r"cartesian, .*joint_move, .*ompl"):
        load_planner("dijkstra", {})
    with pytest.raises(ConfigError, match="cannot be imported"):
        load_planner("nobody.planner", {})
    with pytest.raises(ConfigError, match=r"plan\(\) and Options"):
        load_planner("common.planning.path", {})
    assert {"cartesian", "joint_move", "lerp", "ompl"} <= set(planner_names())


def test_same_seed_gives_the_same_path_and_another_seed_another():
    def path(seed: int) -> np.ndarray:
        response = PIPELINE.plan(to_joints(LEFT, RIGHT, seed=seed, planner="ompl", planning_attempts=1), wall())
        return timed_path(response.trajectory).positions

    assert np.array_equal(path(1), path(1))
    assert path(1).shape != path(2).shape or not np.allclose(path(1), path(2))


def test_best_of_several_attempts_is_kept():
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
    assert_sound(request, wall(), response)
    assert distance_outside(Region(T, np.full(3, 0.02), 0.25, 3.14), ROBOT.fk(last(response))) < 1e-3


def test_region_knows_its_bounds():
    T = tool_down(0.5, 0.0, 0.2, 0.0)
    region = Region(T, np.full(3, 0.02), 0.2, 0.5)
    assert distance_outside(region, tool_down(0.515, 0.0, 0.2, 0.4)) < 0
    assert distance_outside(region, tool_down(0.53, 0.0, 0.2, 0.0)) == pytest.approx(0.01)
    assert distance_outside(region, tool_down(0.5, 0.0, 0.2, 0.6)) == pytest.approx(0.1)


def test_straight_line_keeps_the_tool_on_it_and_turns_it_evenly():
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


def test_line_that_ends_in_an_obstacle_says_where_and_between_what():
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


def test_line_out_of_reach_says_how_far_it_goes():
    response = PIPELINE.plan(to_pose(tool_down(1.2, -0.3, 0.2), RIGHT, straight=True), scene())
    assert response.error == "no_ik"
    assert 0 < response.fraction < 0.9
    assert "fraction" in response.message


def test_goal_where_the_robot_stands_needs_no_motion():
    for request in (to_joints(LEFT, LEFT), to_pose(ROBOT.fk(LEFT), LEFT), to_joints(LEFT, LEFT, planner="ompl")):
        response = PIPELINE.plan(request, AROUND)
        assert response.ok, response.message
        assert np.allclose(last(response), LEFT, atol=1e-6)


def test_unreachable_pose_ends_with_no_ik_from_every_planner():
    response = PIPELINE.plan(to_pose(tool_down(2.0, 0, 0.2), RIGHT, planning_time=5), AROUND)
    assert {a.error for a in response.attempts} == {"no_ik"}
    assert not response.ok


def test_pose_inside_an_obstacle_is_named():
    extra = solid("crate", "fixture", "box", [0.2, 0.2, 0.2], (0.5, 0.3, 0.2))
    blocked = scene(box=False)
    blocked.objects.append(extra)
    response = PIPELINE.plan(to_pose(tool_down(0.5, 0.3, 0.2), RIGHT, planner="ompl"), blocked)
    assert response.error == "goal_in_collision"
    assert response.colliding[1] == "crate"


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


def test_shortcuts_of_ompl_end_when_planning_is_cancelled_in_the_middle_of_them(monkeypatch):
    cancel, asked = Cancel(), []

    class CancelledAtOnce(og.PathSimplifier):
        def reduceVertices(self, path):
            cancel.set()
            monkeypatch.setattr(CollisionWorld, "edge_free", lambda *ends: asked.append(ends))
            return super().reduceVertices(path)

    monkeypatch.setattr(og, "PathSimplifier", CancelledAtOnce)
    response = PIPELINE.plan(to_joints(LEFT, RIGHT, planner="ompl"), wall(), cancel=cancel)
    assert (response.error, asked) == ("cancelled", [])


@pytest.mark.parametrize(("late", "error"), [(525, ""), (575, "timeout")])
def test_path_is_timed_within_a_tenth_of_the_budget_on_top_of_it(monkeypatch, late, error):
    monkeypatch.setattr(retiming, "monotonic", lambda: time.monotonic() + late)
    assert PIPELINE.plan(to_joints(LEFT, RIGHT, planner="ompl", planning_time=500.0), wall()).error == error


@pytest.mark.parametrize("planner", ["cartesian", "ompl"])
def test_planner_that_is_cancelled_before_it_begins_says_so(planner):
    cancel = Cancel()
    cancel.set()
    response = PIPELINE.plan(to_pose(tool_down(0.5, 0.3, 0.2), RIGHT, planner=planner), wall(), cancel=cancel)
    assert response.error == "cancelled"
