"""Point to point, straight lines and arcs with trapezoidal profiles."""

from itertools import pairwise

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from pydantic import ValidationError

from common.messages import ArcGoal, PlanRequest, Pose, Vector3
from common.planning.planners.circ import NoArc, circle_about, circle_through
from common.planning.planners.ptp import trapezoid
from common.planning.trajectory import TimedPath, end_accelerations, sample
from common.robot.transforms import matrix_to_pose, rpy_to_matrix, tool_down, transform
from tests.common.planning.checks import planned, tool_places, with_planner
from tests.common.planning.requests import LEFT, RIGHT, to, to_joints, to_pose
from tests.common.planning.scenes import CELL, EMPTY, ROBOT, TABLE, scene, solid

LIMIT = CELL.motion.velocity_scaling * ROBOT.velocity


def test_point_to_point_has_three_phases_shared_by_all_joints():
    timed = planned(with_planner("ptp", deceleration=0.5), to_joints(LEFT, RIGHT), TABLE)
    assert len(timed.times) == 8  # two for each change of acceleration, within the jerk limit
    begin, end = (values[1::2] for values in end_accelerations(timed))
    assert np.allclose(begin, end, atol=1e-6) and np.allclose(begin[1], 0, atol=1e-6)
    assert np.allclose(np.abs(begin[2]), 0.5 * np.abs(begin[0]), rtol=1e-3, atol=1e-6)
    assert 0.97 < (np.abs(timed.velocities) / LIMIT).max() <= 1


def tool_along(timed: TimedPath) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times [s], (N, 4, 4) poses of the tool, and (N - 1,) its speed [m/s] between them."""
    times = np.linspace(0, timed.duration, 400)
    poses = np.array([ROBOT.fk(q) for q in sample(timed, times)])
    return times, poses, np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) / np.diff(times)


def test_line_has_a_trapezoidal_profile_of_the_tool():
    T_start, T_goal = ROBOT.fk(RIGHT), tool_down(0.5, 0.3, 0.2)
    pipeline = with_planner("lin", speed=0.5, acceleration=1.0, deceleration=2.0)
    timed = planned(pipeline, to_pose(T_goal, RIGHT), EMPTY)  # scaled to 0.1 m/s, 0.2 m/s^2 and 0.4 m/s^2
    times, poses, speeds = tool_along(timed)
    assert speeds.max() == pytest.approx(0.1, rel=0.01)
    assert timed.duration == pytest.approx(0.6 / 0.1 + 0.05 / 0.2 + 0.05 / 0.4, rel=0.01)
    changes = np.diff(speeds) / times[1]
    assert np.median(changes[:20]) == pytest.approx(0.2, rel=0.03)
    assert np.median(changes[-10:]) == pytest.approx(-0.4, rel=0.03)
    way = (T_goal - T_start)[:3, 3]
    shares = (poses[:, :3, 3] - T_start[:3, 3]) @ way / (way @ way)
    assert np.linalg.norm(poses[:, :3, 3] - T_start[:3, 3] - shares[:, None] * way, axis=1).max() < 2e-4


def test_turn_in_place_respects_the_rotation_speed():
    goal = ROBOT.fk(RIGHT) @ transform(rpy_to_matrix(0.0, 0.0, 1.2), (0, 0, 0))
    times, poses, speeds = tool_along(planned(with_planner("lin"), to_pose(goal, RIGHT), TABLE))
    turns = [np.linalg.norm(pin.log3(a.T @ b)) for a, b in pairwise(poses[:, :3, :3])]
    assert max(turns) / times[1] == pytest.approx(0.2 * 1.57, rel=0.02) and speeds.max() < 0.01


def test_line_is_slower_where_a_joint_is_at_its_limit():
    fast = with_planner("lin", speed=3.0, acceleration=50, deceleration=50)
    timed = planned(fast, to_pose(tool_down(0.5, 0.3, 0.2), RIGHT), EMPTY)
    assert (np.abs(timed.velocities) / LIMIT).max() > 0.97 and tool_along(timed)[2].max() < 0.6


values = st.floats(0.01, 10)


@given(length=values, speed=values, acceleration=values, deceleration=values)
def test_trapezoid_covers_the_length_within_its_limits(length, speed, acceleration, deceleration):
    profile = trapezoid(length, speed, acceleration, deceleration)
    times = np.linspace(0, profile.duration, 200)
    s, ds, dds = np.array([profile.at(t) for t in times]).T
    assert s[0] == 0 and s[-1] == pytest.approx(length)
    assert ds[-1] == pytest.approx(0, abs=1e-9) and ds.max() <= speed * (1 + 1e-9)
    assert dds.max() <= acceleration * (1 + 1e-9) and dds.min() >= -deceleration * (1 + 1e-9)
    assert (np.diff(s) >= -1e-9).all()
    step = times[1]
    assert np.allclose(np.diff(s), 0.5 * step * (ds[1:] + ds[:-1]), atol=(acceleration + deceleration) * step**2)



DX, DY = np.array([0.1, 0, 0]), np.array([0, 0.1, 0])
START = ROBOT.fk(RIGHT)[:3, 3]
POINTS = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array)


def to_arc(T, **circle) -> PlanRequest:
    points = {name: Vector3(x=p[0], y=p[1], z=p[2]) for name, p in circle.items()}
    return to(ArcGoal(pose=matrix_to_pose(T), **points), RIGHT)


@given(start=POINTS, via=POINTS, goal=POINTS)
def test_circle_passes_its_three_points_in_order(start, via, goal):
    try:
        circle = circle_through(start, via, goal)
    except NoArc:
        return
    assume(circle.radius < 10)
    arc = circle.points(np.linspace(0, 1, 2001))
    assert np.allclose(arc[[0, -1]], [start, goal], atol=1e-6)
    assert np.linalg.norm(arc - via, axis=1).min() < 2 * circle.length / 2000 + 1e-6
    assert np.allclose(np.linalg.norm(arc - circle.centre, axis=1), circle.radius, atol=1e-6)


@given(centre=POINTS, one=POINTS, other=POINTS)
def test_circle_about_a_centre_takes_the_shorter_arc(centre, one, other):
    assume(min(np.linalg.norm(one), np.linalg.norm(other)) > 0.05)
    one, other = 0.3 * one / np.linalg.norm(one), 0.3 * other / np.linalg.norm(other)
    try:
        circle = circle_about(centre + one, centre, centre + other)
    except NoArc:
        return
    assert circle.angle <= np.pi
    assert np.allclose(circle.points(np.linspace(0, 1, 101))[-1], centre + other, atol=1e-6)


@pytest.mark.parametrize(("make", "points", "text"), [
    (circle_through, (START, START + DY, START + 2 * DY), "straight line"),
    (circle_through, (START, START, START + DY), "three different points"),
    (circle_about, (START, START + DY, START + 2 * DY), "plane of the circle"),
    (circle_about, (START, START + DY, START + 2 * DX), "0.1000 m from the start and 0.2236"),
])
def test_points_that_define_no_circle_are_refused(make, points, text):
    with pytest.raises(NoArc, match=text):
        make(*points)


@pytest.mark.parametrize(("how", "point", "circle_of"), [
    ("via", (0.5, 0.0, 0.5), circle_through), ("center", (0.3, 0, 0.2), circle_about)])
def test_tool_follows_the_arc_at_its_speed(how, point, circle_of):
    T = tool_down(0.5, 0.3, 0.2, 0.3)
    timed = planned(with_planner("circ", speed=0.5), to_arc(T, **{how: point}), EMPTY)
    assert np.allclose(ROBOT.fk(timed.positions[-1]), T, atol=2e-4)
    circle = circle_of(START, np.array(point), T[:3, 3])
    away = tool_places(timed, 0.01) - circle.centre
    assert np.abs(away @ np.cross(circle.x, circle.y)).max() < 5e-4
    assert np.abs(np.linalg.norm(away, axis=1) - circle.radius).max() < 5e-4
    assert circle.length / 0.1 < timed.duration < circle.length / 0.1 + 1


def test_colliding_arc_is_reported_with_waypoint_and_pair():
    beam = scene((), solid("beam", "fixture", "box", [0.1, 0.02, 0.1], (0.5, 0.0, 0.5)), box=False)
    response = with_planner("circ").plan(to_arc(tool_down(0.5, 0.3, 0.2), via=(0.5, 0.0, 0.5)), beam)
    assert (response.error, response.colliding[1]) == ("collision", "beam")
    assert f"point {response.attempts[-1].waypoint + 1} of " in response.message
    assert 0.1 < response.fraction < 0.5


@pytest.mark.parametrize(("planner", "via", "error", "text"), [
    ("circ", (1.0, 0.0, 0.2), "no_ik", ""),
    ("circ", (0.5, 0.0, 0.2), "bad_goal", "straight line"),
    *((name, (0.5, 0.0, 0.5), "no_planner", "") for name in ("cartesian", "joint_move", "lerp", "lin", "ompl", "ptp")),
])
def test_impossible_arc_is_refused(planner, via, error, text):
    response = with_planner(planner).plan(to_arc(tool_down(0.5, 0.3, 0.2), via=via), EMPTY)
    assert response.error == error and text in response.message
    assert error != "no_ik" or 0 < response.fraction < 0.5


@pytest.mark.parametrize("points", [{}, {"via": Vector3(), "center": Vector3()}])
def test_arc_needs_one_circle(points):
    with pytest.raises(ValidationError, match="either via or center"):
        ArcGoal(pose=Pose(), **points)
