"""Point to point, straight lines and arcs with trapezoidal profiles."""

from itertools import pairwise

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.planning.planners.ptp import synchronised, trapezoid
from common.planning.trajectory import TimedPath, end_accelerations, sample
from common.robot.transforms import tool_down
from tests.common.planning.planner_checks import AROUND, LEFT, RIGHT, assert_sound, wall, with_planner
from tests.common.planning.planning_scenes import CELL, ROBOT, last, scene, solid, to_joints, to_pose


def test_point_to_point_has_three_phases_shared_by_all_joints():
    pipeline = with_planner("ptp", deceleration=0.5)
    request = to_joints(LEFT, RIGHT)
    timed = assert_sound(pipeline, request, AROUND, pipeline.plan(request, AROUND))
    assert len(timed.times) == 8  # two for each change of acceleration, within the jerk limit
    begin, end = (values[1::2] for values in end_accelerations(timed))
    assert np.allclose(begin, end, atol=1e-6)
    assert np.allclose(begin[1], 0, atol=1e-6)
    assert np.allclose(np.abs(begin[2]), 0.5 * np.abs(begin[0]), rtol=1e-3, atol=1e-6)
    limit = CELL.motion.velocity_scaling * ROBOT.velocity
    assert 0.97 < (np.abs(timed.velocities) / limit).max() <= 1


def test_point_to_point_reports_the_waypoint_of_a_collision():
    response = with_planner("ptp", steps=20).plan(to_joints(LEFT, RIGHT), wall())
    assert f"waypoint {response.attempts[-1].waypoint} of 20" in response.message


def tool_along(timed: TimedPath, count: int = 400) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times [s], (N, 4, 4) poses of the tool, and (N - 1,) its speed [m/s] between them."""
    times = np.linspace(0, timed.duration, count)
    poses = np.array([ROBOT.fk(q) for q in sample(timed, times)])
    speeds = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) / np.diff(times)
    return times, poses, speeds


def test_line_has_a_trapezoidal_profile_of_the_tool():
    pipeline = with_planner("lin", speed=0.5, acceleration=1.0, deceleration=2.0)
    request = to_pose(tool_down(0.5, 0.3, 0.2), RIGHT)  # scaled to 0.1 m/s, 0.2 m/s^2 and 0.4 m/s^2
    timed = assert_sound(pipeline, request, scene(box=False), pipeline.plan(request, scene(box=False)))
    times, poses, speeds = tool_along(timed)
    assert speeds.max() == pytest.approx(0.1, rel=0.01)
    assert timed.duration == pytest.approx(0.6 / 0.1 + 0.05 / 0.2 + 0.05 / 0.4, rel=0.01)
    changes = np.diff(speeds) / times[1]
    assert np.median(changes[:20]) == pytest.approx(0.2, rel=0.03)
    assert np.median(changes[-10:]) == pytest.approx(-0.4, rel=0.03)
    T_start, T_goal = ROBOT.fk(RIGHT), tool_down(0.5, 0.3, 0.2)
    way = (T_goal - T_start)[:3, 3]
    shares = (poses[:, :3, 3] - T_start[:3, 3]) @ way / (way @ way)
    assert np.linalg.norm(poses[:, :3, 3] - T_start[:3, 3] - shares[:, None] * way, axis=1).max() < 2e-4


def test_turn_in_place_respects_the_rotation_speed():
    pipeline = with_planner("lin")
    request = to_pose(ROBOT.fk(RIGHT) @ _turned(1.2), RIGHT)
    timed = assert_sound(pipeline, request, AROUND, pipeline.plan(request, AROUND))
    times, poses, speeds = tool_along(timed)
    R = poses[:, :3, :3]
    turns = [np.linalg.norm(pin.log3(a.T @ b)) for a, b in pairwise(R)]
    assert max(turns) / times[1] == pytest.approx(0.2 * 1.57, rel=0.02)
    assert speeds.max() < 0.01


def _turned(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


def test_line_is_slower_where_a_joint_is_at_its_limit():
    pipeline = with_planner("lin", speed=3.0, acceleration=50, deceleration=50)
    request = to_pose(tool_down(0.5, 0.3, 0.2), RIGHT)
    timed = assert_sound(pipeline, request, scene(box=False), pipeline.plan(request, scene(box=False)))
    limit = CELL.motion.velocity_scaling * ROBOT.velocity
    assert (np.abs(timed.velocities) / limit).max() > 0.97
    assert tool_along(timed)[2].max() < 0.6


def test_blocked_line_is_reported_with_waypoint_and_pair():
    beam = solid("beam", "fixture", "box", [0.3, 0.02, 0.6], (0.5, 0.0, 0.3))
    blocked = scene(box=False)
    blocked.objects.append(beam)
    response = with_planner("lin").plan(to_pose(tool_down(0.5, 0.3, 0.2), RIGHT), blocked)
    assert response.error == "collision"
    assert f"waypoint {response.attempts[-1].waypoint} of 120: " in response.message
    assert "collides with beam" in response.message
    assert 0.1 < response.fraction < 0.5


def test_line_ends_exactly_at_the_pose():
    T = tool_down(0.45, 0.1, 0.35, 0.7)
    response = with_planner("lin").plan(to_pose(T, RIGHT), AROUND)
    assert np.allclose(ROBOT.fk(last(response)), T, atol=1e-4)


values = st.floats(0.01, 10)


@given(length=values, speed=values, acceleration=values, deceleration=values)
def test_trapezoid_covers_the_length_within_its_limits(length, speed, acceleration, deceleration):
    profile = trapezoid(length, speed, acceleration, deceleration)
    times = np.linspace(0, profile.duration, 200)
    s, ds, dds = np.array([profile.at(t) for t in times]).T
    assert s[0] == 0
    assert s[-1] == pytest.approx(length)
    assert ds[-1] == pytest.approx(0, abs=1e-9)
    assert ds.max() <= speed * (1 + 1e-9)
    assert dds.max() <= acceleration * (1 + 1e-9)
    assert dds.min() >= -deceleration * (1 + 1e-9)
    assert (np.diff(s) >= -1e-9).all()
    step = times[1]
    assert np.allclose(np.diff(s), 0.5 * step * (ds[1:] + ds[:-1]), atol=(acceleration + deceleration) * step**2)


joints = st.lists(st.floats(-3, 3), min_size=3, max_size=3).map(np.array)


@given(start=joints, goal=joints, braking=st.floats(0.1, 1))
def test_synchronised_joints_have_one_joint_at_its_limit(start, goal, braking):
    velocity, acceleration = np.array([1.0, 2.0, 0.5]), np.array([3.0, 1.0, 2.0])
    timed = synchronised(start, goal, velocity, acceleration, braking * acceleration)
    assert np.allclose(timed.positions[[0, -1]], [start, goal])
    begin, end = end_accelerations(timed)
    for found in (begin, end):
        assert (found <= acceleration * (1 + 1e-6) + 1e-6).all()
        assert (found >= -acceleration * (1 + 1e-6) - 1e-6).all()
    assert (np.abs(timed.velocities) <= velocity * (1 + 1e-9)).all()
    if np.abs(goal - start).max() > 1e-3:
        share = [
            (np.abs(timed.velocities) / velocity).max(),
            (np.abs(begin[0]) / acceleration).max(),
            (np.abs(end[-1]) / (braking * acceleration)).max(),
        ]
        assert max(share) == pytest.approx(1, abs=1e-3)
