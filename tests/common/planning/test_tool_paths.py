"""Paths of several straight lines of the tool: they stay on the lines at the requested speed."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.messages import PathGoal, PlanRequest
from common.planning.trajectory import TimedPath, sample, timed_path
from common.robot.transforms import tool_down
from tests.common.planning.checks import PIPELINE, assert_refused
from tests.common.planning.requests import above, down, to
from tests.common.planning.scenes import EMPTY, HOME, ROBOT, scene, solid

HEIGHT, SPEED, STEP = 0.2, 0.05, 0.002  # [m], [m/s], [s] between samples
SQUARE = [(0.45, -0.05), (0.55, -0.05), (0.55, 0.05), (0.45, 0.05), (0.45, -0.05)]


def circle(radius: float, count: int) -> list[tuple[float, float]]:
    angles = np.linspace(0, 2 * math.pi, count + 1)
    return [(0.5 + radius * math.cos(a), radius * math.sin(a)) for a in angles]


def along(points, start=None, **goal) -> PlanRequest:
    more = {k: goal.pop(k) for k in ("velocity_scaling", "planner") if k in goal}
    values = {"step": 0.001, "min_fraction": 0.99, **goal}
    path = PathGoal(waypoints=[down(x, y, HEIGHT).pose for x, y in points], **values)
    return to(path, above(*points[0], HEIGHT) if start is None else start, stage="trace", **more)


def traced(request: PlanRequest) -> TimedPath:
    response = PIPELINE.plan(request, EMPTY)
    assert response.ok, response.message
    assert response.fraction == 1.0
    return timed_path(response.trajectory)


def tips(trajectory: TimedPath) -> np.ndarray:
    return np.array([ROBOT.fk(q)[:3, 3] for q in sample(trajectory, np.arange(0, trajectory.duration, STEP))])


def speeds(tip: np.ndarray) -> np.ndarray:
    return np.linalg.norm(np.diff(tip, axis=0), axis=1) / STEP


def off_lines(tip: np.ndarray, points) -> np.ndarray:
    """Distance [m] of each tip (N, 3) from the polyline."""
    a = np.column_stack([np.array(points), np.full(len(points), HEIGHT)])
    edges = np.diff(a, axis=0)
    offset = tip[:, None, :] - a[None, :-1, :]
    share = np.clip((offset * edges).sum(-1) / (edges * edges).sum(-1), 0, 1)
    return np.linalg.norm(offset - share[..., None] * edges, axis=-1).min(axis=1)


@settings(max_examples=5, deadline=None)
@given(st.lists(st.tuples(st.integers(-60, 60), st.integers(-60, 60)), min_size=3, max_size=8, unique=True))
def test_tool_stays_within_0_1_mm_of_any_polyline(offsets):
    points = [(0.5 + x / 1000, y / 1000) for x, y in [*offsets, offsets[0]]]
    trajectory = traced(along(points, tool_speed=0.1))
    tip = tips(trajectory)
    assert off_lines(tip, points).max() < 1e-4
    ends = [ROBOT.fk(q)[:3, 3] for q in trajectory.positions[[0, -1]]]
    assert np.linalg.norm(ends[0] - ends[1]) < 1e-4
    for x, y in points:  # no corner is skipped
        assert np.linalg.norm(tip - (x, y, HEIGHT), axis=1).min() < 4e-4  # the tips are 0.2 mm apart


@pytest.mark.parametrize("points", [SQUARE, circle(0.05, 360), circle(0.05, 20)], ids=["square", "circle", "polygon"])
def test_tool_has_constant_speed_away_from_corners_and_does_not_stop_there(points):
    trajectory = traced(along(points, tool_speed=SPEED, velocity_scaling=0.5))
    tip = tips(trajectory)
    assert speeds(tip).max() < 1.02 * SPEED
    corners = np.array(points if len(points) < 30 else points[:1])
    away = np.linalg.norm(tip[:-1, None, :2] - corners[None], axis=-1).min(axis=1) > 0.005
    assert np.abs(speeds(tip)[away] - SPEED).max() < 0.1 * SPEED
    inside = (trajectory.times > 0.2) & (trajectory.times < trajectory.duration - 0.2)
    assert np.abs(trajectory.velocities[inside]).max(axis=1).min() > 1e-3


def test_without_a_speed_the_path_is_as_fast_as_limits_allow():
    slow, fast = traced(along(circle(0.05, 90), tool_speed=SPEED)), traced(along(circle(0.05, 90)))
    assert fast.duration < 0.8 * slow.duration
    assert (np.abs(fast.velocities) <= 0.2 * ROBOT.velocity * 1.001).all()
    assert (np.abs(fast.accelerations) <= 0.2 * ROBOT.acceleration * 1.001).all()


def test_rotations_of_the_tool_are_followed():
    end = (0.5, 0.05 + 1e-3, HEIGHT, -0.3)
    poses = [(0.45, 0.0, HEIGHT, 0.0), (0.5, 0.05, HEIGHT, 0.5), (*end[:3], 0.5), end]
    goal = PathGoal(waypoints=[down(*pose).pose for pose in poses], tool_speed=SPEED)
    assert np.allclose(ROBOT.fk(traced(to(goal, above(0.45, 0.0, HEIGHT))).positions[-1]), tool_down(*end), atol=2e-4)


def test_path_out_of_reach_is_refused_with_point_and_reason():
    response = PIPELINE.plan(along([(0.6, 0.0), (0.65, 0.1), (1.2, 0.1), (0.6, 0.0)]), EMPTY)
    assert_refused(response, "no_ik", "trace: cartesian: point 3 of 4, at (0.7")
    assert "cannot reach it" in response.message or "limits" in response.message
    assert 0.1 < response.fraction < 0.5


def test_path_into_an_obstacle_is_refused_with_the_pair():
    around = scene((), solid("wall", "fixture", "box", [0.1, 0.02, 0.25], (0.5, 0.15, 0.1)), box=False)
    response = PIPELINE.plan(along([(0.5, -0.2), (0.5, -0.1), (0.5, 0.2)]), around)
    assert_refused(response, "collision", "point 3 of 3")
    assert response.colliding[1] == "wall" and "collides with wall" in response.message


def test_min_fraction_decides_about_a_partial_path():
    points = [(0.5, 0.0), (0.6, 0.0), (1.2, 0.0)]
    assert not PIPELINE.plan(along(points, min_fraction=0.9), EMPTY).ok
    response = PIPELINE.plan(along(points, min_fraction=0.1), EMPTY)
    assert response.ok and 0.1 < response.fraction < 0.9


@pytest.mark.parametrize(("request_", "code", "text"), [
    (along(SQUARE, start=HOME), "start_mismatch", "away from the path's first pose"),
    (along(SQUARE, planner="ompl"), "no_planner", ""),
    (along(SQUARE, planner="joint_move"), "no_planner", ""),
])
def test_path_from_elsewhere_or_of_another_planner_is_refused(request_, code, text):
    assert_refused(PIPELINE.plan(request_, EMPTY), code, text)


@pytest.mark.parametrize("points", [[SQUARE[0]], [SQUARE[0]] * 3])
def test_path_of_one_position_needs_no_motion(points):
    assert np.abs(np.diff(traced(along(points)).positions, axis=0)).max() < 1e-9


def test_noise_of_a_measured_contour_does_not_slow_the_tool():
    noise = np.random.default_rng(3).uniform(-4e-5, 4e-5, (240, 2))
    points = [tuple(point) for point in np.array(circle(0.05, 240)[:-1]) + noise]
    points.append(points[0])
    tip = tips(traced(along(points, tool_speed=SPEED)))
    assert off_lines(tip, points).max() < 1e-4
    away = np.linalg.norm(tip[:-1, :2] - points[0], axis=1) > 0.005
    assert np.abs(speeds(tip)[away] - SPEED).max() < 0.1 * SPEED
