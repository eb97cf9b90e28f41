"""Paths of several straight lines of the tool: they stay on the lines at the requested speed."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.messages import PathGoal, PlanningScene, PlanRequest
from common.planning.pipeline import PlanningPipeline
from common.planning.trajectory import TimedPath, sample, timed_path
from common.robot.transforms import matrix_to_pose, tool_down
from tests.common.planning.planning_scenes import CELL, HOME, ROBOT, above, scene, solid

PIPELINE = PlanningPipeline(ROBOT, CELL.motion, CELL.pipeline)
EMPTY = scene(box=False)
HEIGHT = 0.2
SQUARE = [(0.45, -0.05), (0.55, -0.05), (0.55, 0.05), (0.45, 0.05), (0.45, -0.05)]


def circle(radius: float, count: int) -> list[tuple[float, float]]:
    angles = np.linspace(0, 2 * math.pi, count + 1)
    return [(0.5 + radius * math.cos(a), radius * math.sin(a)) for a in angles]


def along(points, start=None, **goal) -> PlanRequest:
    poses = [matrix_to_pose(tool_down(x, y, HEIGHT)) for x, y in points]
    more = {k: goal.pop(k) for k in ("velocity_scaling", "allowed_collisions") if k in goal}
    path = PathGoal(waypoints=poses, **{"step": 0.001, "min_fraction": 0.99, **goal})
    q = above(*points[0], HEIGHT) if start is None else start
    return PlanRequest(id="1", stage="trace", start=list(q), goal=path, **more)


def traced(request: PlanRequest, of: PlanningScene = EMPTY) -> TimedPath:
    response = PIPELINE.plan(request, of)
    assert response.ok, response.message
    assert response.fraction == 1.0
    return timed_path(response.trajectory)


def tips(trajectory: TimedPath, dt: float = 0.002) -> np.ndarray:
    times = np.arange(0, trajectory.duration, dt)
    return np.array([ROBOT.fk(q)[:3, 3] for q in sample(trajectory, times)])


def off_lines(tip: np.ndarray, points) -> np.ndarray:
    """Distance [m] of each tip (N, 3) from the polyline."""
    a = np.column_stack([np.array(points), np.full(len(points), HEIGHT)])
    edges = np.diff(a, axis=0)
    offset = tip[:, None, :] - a[None, :-1, :]
    share = np.clip((offset * edges).sum(-1) / (edges * edges).sum(-1), 0, 1)
    return np.linalg.norm(offset - share[..., None] * edges, axis=-1).min(axis=1)


@settings(max_examples=12, deadline=None)
@given(st.lists(st.tuples(st.integers(-60, 60), st.integers(-60, 60)), min_size=3, max_size=8, unique=True))
def test_tool_stays_within_0_1_mm_of_any_polyline(offsets):
    points = [(0.5 + x / 1000, y / 1000) for x, y in [*offsets, offsets[0]]]
    trajectory = traced(along(points, tool_speed=0.1))
    tip = tips(trajectory)
    assert off_lines(tip, points).max() < 1e-4
    ends = ROBOT.fk(trajectory.positions[0])[:3, 3], ROBOT.fk(trajectory.positions[-1])[:3, 3]
    assert np.linalg.norm(ends[0] - ends[1]) < 1e-4
    for x, y in points:  # no corner is skipped
        assert np.linalg.norm(tip - (x, y, HEIGHT), axis=1).min() < 4e-4  # the tips are 0.2 mm apart


@pytest.mark.parametrize("points", [SQUARE, circle(0.05, 360), circle(0.05, 20)], ids=["square", "circle", "polygon"])
def test_tool_has_constant_speed_away_from_corners(points):
    speed = 0.05
    trajectory = traced(along(points, tool_speed=speed, velocity_scaling=0.5))
    dt = 0.002
    tip = tips(trajectory, dt)
    moved = np.linalg.norm(np.diff(tip, axis=0), axis=1) / dt
    assert moved.max() < 1.02 * speed
    corners = np.array(points if len(points) < 30 else points[:1])
    away = np.linalg.norm(tip[:-1, None, :2] - corners[None], axis=-1).min(axis=1) > 0.005
    assert np.abs(moved[away] - speed).max() < 0.1 * speed


def test_tool_does_not_stop_at_corners():
    trajectory = traced(along(SQUARE, tool_speed=0.05, velocity_scaling=0.5))
    inside = (trajectory.times > 0.2) & (trajectory.times < trajectory.duration - 0.2)
    assert np.abs(trajectory.velocities[inside]).max(axis=1).min() > 1e-3


def test_without_a_speed_the_path_is_as_fast_as_limits_allow():
    slow, fast = traced(along(circle(0.05, 90), tool_speed=0.05)), traced(along(circle(0.05, 90)))
    assert fast.duration < 0.8 * slow.duration
    assert (np.abs(fast.velocities) <= 0.2 * ROBOT.velocity * 1.001).all()
    assert (np.abs(fast.accelerations) <= 0.2 * ROBOT.acceleration * 1.001).all()


def test_rotations_of_the_tool_are_followed():
    yaws = [0.0, 0.5, 0.5, -0.3]
    places = [(0.45, 0.0), (0.5, 0.05), (0.5, 0.05 + 1e-3), (0.5, 0.05 + 1e-3)]
    poses = [tool_down(x, y, HEIGHT, yaw) for (x, y), yaw in zip(places, yaws, strict=True)]
    goal = PathGoal(waypoints=[matrix_to_pose(T) for T in poses], tool_speed=0.05)
    trajectory = traced(PlanRequest(id="1", start=list(above(0.45, 0.0, HEIGHT)), goal=goal))
    assert np.allclose(ROBOT.fk(trajectory.positions[-1]), poses[-1], atol=2e-4)


def test_path_out_of_reach_is_refused_with_point_and_reason():
    points = [(0.6, 0.0), (0.65, 0.1), (1.2, 0.1), (0.6, 0.0)]
    response = PIPELINE.plan(along(points), EMPTY)
    assert not response.ok
    assert response.error == "no_ik"
    assert response.message.startswith("trace: cartesian: point 3 of 4, at (0.7")
    assert "cannot reach it" in response.message or "limits" in response.message
    assert 0.1 < response.fraction < 0.5


def test_path_into_an_obstacle_is_refused_with_the_pair():
    wall = solid("wall", "fixture", "box", [0.1, 0.02, 0.25], (0.5, 0.15, 0.1))
    around = EMPTY.model_copy(update={"objects": [*EMPTY.objects, wall]})
    response = PIPELINE.plan(along([(0.5, -0.2), (0.5, -0.1), (0.5, 0.2)]), around)
    assert response.error == "collision"
    assert response.colliding[1] == "wall"
    assert "point 3 of 3" in response.message and "collides with wall" in response.message


def test_min_fraction_decides_about_a_partial_path():
    points = [(0.5, 0.0), (0.6, 0.0), (1.2, 0.0)]
    assert not PIPELINE.plan(along(points, min_fraction=0.9), EMPTY).ok
    response = PIPELINE.plan(along(points, min_fraction=0.1), EMPTY)
    assert response.ok
    assert 0.1 < response.fraction < 0.9


def test_path_that_starts_elsewhere_is_refused():
    response = PIPELINE.plan(along(SQUARE, start=HOME), EMPTY)
    assert response.error == "start_mismatch"
    assert "away from the path's first pose" in response.message


def test_path_of_one_position_needs_no_motion():
    for points in ([SQUARE[0]], [SQUARE[0]] * 3):
        trajectory = traced(along(points))
        assert np.abs(np.diff(trajectory.positions, axis=0)).max() < 1e-9


@pytest.mark.parametrize("planner", ["ompl", "joint_move"])
def test_planners_without_paths_refuse_them(planner):
    request = along(SQUARE).model_copy(update={"planner": planner})
    response = PIPELINE.plan(request, EMPTY)
    assert response.error == "no_planner"


def test_noise_of_a_measured_contour_does_not_slow_the_tool():
    rng = np.random.default_rng(3)
    noisy = [(x + rng.uniform(-4e-5, 4e-5), y + rng.uniform(-4e-5, 4e-5)) for x, y in circle(0.05, 240)[:-1]]
    points = [*noisy, noisy[0]]
    dt = 0.002
    tip = tips(traced(along(points, tool_speed=0.05)), dt)
    assert off_lines(tip, points).max() < 1e-4
    moved = np.linalg.norm(np.diff(tip, axis=0), axis=1) / dt
    away = np.linalg.norm(tip[:-1, :2] - points[0], axis=1) > 0.005
    assert np.abs(moved[away] - 0.05).max() < 0.005
