"""Arcs of the tool."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from pydantic import ValidationError

from common.messages import ArcGoal, PlanRequest, Pose, Vector3
from common.planning.planners.circ import NoArc, circle_about, circle_through
from common.robot.transforms import matrix_to_pose, tool_down
from tests.common.planning.checks import planned, tool_places, with_planner
from tests.common.planning.requests import RIGHT, to
from tests.common.planning.scenes import EMPTY, ROBOT, scene, solid

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
