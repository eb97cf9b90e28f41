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
from common.planning.kernel.library import library
from common.planning.pipeline import PlanningPipeline
from common.planning.planners import lerp, load_planner, planner_names
from common.planning.problem import Cancel, Region
from common.planning.trajectory import timed_path
from common.planning.validation import fine_samples
from common.robot.transforms import tool_down
from tests.common.planning.checks import PIPELINE, assert_sound, last, planned, seconds, with_planner
from tests.common.planning.requests import LEFT, RIGHT, above, to_joints, to_pose
from tests.common.planning.scenes import CELL, EMPTY, ROBOT, TABLE, wall

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


@pytest.mark.usefixtures("no_kernel")
def test_ompl_plans_where_the_kernel_is_not_built():
    request = to_joints(LEFT, RIGHT, planning_attempts=1)
    response = PlanningPipeline(ROBOT, CELL.motion, CELL.pipeline).plan(request, wall())
    assert_sound(PIPELINE, request, wall(), response)
    assert response.planner == "ompl"


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.slow
def test_each_algorithm_of_ompl_finds_a_path_around_a_wall(algorithm):
    request = to_joints(LEFT, RIGHT, planning_attempts=1, planning_time=20)
    planned(with_planner("ompl", algorithm=algorithm, improving_time=0.3), request, wall())


def test_unknown_planner_or_option_is_refused_with_the_choices():
    with pytest.raises(ConfigError, match=r"pipeline.planners.ompl.algorithm.*RRTConnect"):
        with_planner("ompl", algorithm="Dijkstra")
    with pytest.raises(ConfigError, match=r"pipeline.planners.lerp.steps"):
        with_planner("lerp", steps=0)
    with pytest.raises(UnknownName, match=r"cartesian, .*joint_move, .*ompl"):
        load_planner("dijkstra", {})
    with pytest.raises(ConfigError, match="is not a module: there is no missing in"):
        load_planner("missing.planner", {})
    with pytest.raises(ConfigError, match=r"plan\(\) and Options"):
        load_planner("common.planning.path", {})
    assert {"cartesian", "joint_move", "lerp", "ompl"} <= set(planner_names())


def test_another_seed_gives_another_path_and_the_best_attempt_is_returned():
    def plan(seed: int, attempts: int):
        request = to_joints(LEFT, RIGHT, seed=seed, planner="ompl", planning_attempts=attempts)
        response = PIPELINE.plan(request, wall())
        assert len(response.attempts) == attempts
        return response

    paths = [timed_path(plan(seed, 1).trajectory).positions for seed in (1, 2)]
    assert paths[0].shape != paths[1].shape or not np.allclose(*paths)
    assert seconds(plan(3, 6)) <= seconds(plan(3, 1)) * 1.05


def test_sampled_path_ends_in_the_region_of_the_goal():
    T, tolerance = tool_down(0.5, 0.3, 0.2, 0.3), Vector3(x=0.04, y=0.04, z=0.04)
    request = to_pose(T, RIGHT, planner="ompl", position_tolerance=tolerance, tilt_tolerance=0.25, yaw_tolerance=3.14)
    end = ROBOT.fk(planned(PIPELINE, request, wall()).positions[-1])
    assert distance_outside(Region(T, np.full(3, 0.02), 0.25, 3.14), end) < 1e-3


def test_tool_follows_a_straight_line_and_turns_evenly():
    T_goal, start = tool_down(0.55, 0.1, 0.3, 0.8), above(0.4, -0.2, 0.2)
    T_start = ROBOT.fk(start)
    way = T_goal[:3, 3] - T_start[:3, 3]
    for q in fine_samples(planned(PIPELINE, to_pose(T_goal, start, straight=True), EMPTY), 0.01)[0]:
        T = ROBOT.fk(q)
        share = (T[:3, 3] - T_start[:3, 3]) @ way / (way @ way)
        assert np.linalg.norm(T[:3, 3] - T_start[:3, 3] - share * way) < 5e-4
        assert abs(math.atan2(T[1, 0], T[0, 0]) - 0.8 * share) < 0.01 and T[2, 2] < -0.9999


@pytest.mark.parametrize("algorithm", ["AORRTC", "RRTConnect"])
def test_planning_ends_when_its_time_is_up(algorithm):
    request = to_joints(LEFT, RIGHT, planning_time=0.05, planning_attempts=100)  # an attempt takes 4 ms or less
    began = time.thread_time()
    response = with_planner("ompl", algorithm=algorithm, improving_time=60).plan(request, wall())
    assert time.thread_time() - began < 5
    assert response.ok or response.error == "timeout"
    assert len(response.attempts) < 100


def test_planning_ends_when_it_is_cancelled():
    cancel = Cancel()
    threading.Timer(0.1, cancel.set).start()
    began = time.thread_time()
    improving = with_planner("ompl", algorithm="AORRTC", improving_time=60)
    improving.plan(to_joints(LEFT, RIGHT, planning_time=60), wall(), cancel=cancel)
    assert time.thread_time() - began < 10


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


@pytest.mark.parametrize("planner", ["lerp", "chomp", "trajopt"])
def test_free_path_is_the_straight_line_in_joint_space(planner):
    positions = planned(with_planner(planner), to_joints(LEFT, RIGHT), TABLE).positions
    span = LEFT - RIGHT
    share = (positions - RIGHT) @ span / (span @ span)
    assert np.allclose(positions, RIGHT + share[:, None] * span, atol=1e-9) and (np.diff(share) > 0).all()


@pytest.mark.parametrize(("planner", "steps"), [("lerp", 10), ("lerp", 40), ("ptp", 20)])
def test_collision_is_reported_with_its_waypoint(planner, steps):
    response = with_planner(planner, steps=steps).plan(to_joints(LEFT, RIGHT), wall())
    waypoint = response.attempts[-1].waypoint
    assert f"waypoint {waypoint} of {steps}" in response.message and 0.2 < waypoint / steps < 0.6
    if planner == "lerp":
        assert response.fraction == pytest.approx((waypoint - 1) / steps)


def test_another_ik_solution_is_tried_when_the_line_to_the_first_is_blocked(monkeypatch):
    second = above(0.4, -0.2, 0.3)
    monkeypatch.setattr(lerp, "joint_goals", lambda *_, **__: [LEFT, second])
    response = with_planner("lerp").plan(to_pose(tool_down(0.4, -0.2, 0.3), RIGHT), wall())
    assert np.allclose(last(response), second, atol=1e-6)
