import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from pydantic import ValidationError

from common.messages import ArcGoal, PlanRequest, Pose, Vector3
from common.planning.planners.circ import NoArc, circle_about, circle_through
from common.planning.validation import fine_samples
from common.robot.transforms import matrix_to_pose, tool_down
from tests.common.planning.planner_checks import RIGHT, assert_sound, with_planner
from tests.common.planning.planning_scenes import ROBOT, last, scene, solid

EMPTY = scene(box=False)
DX, DY = np.array([0.1, 0, 0]), np.array([0, 0.1, 0])
START = ROBOT.fk(RIGHT)[:3, 3]
POINTS = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array)
SHARES = np.linspace(0, 1, 101)


def to_arc(T, **circle) -> PlanRequest:
    points = {name: Vector3(x=p[0], y=p[1], z=p[2]) for name, p in circle.items()}
    return PlanRequest(id="1", start=list(RIGHT), goal=ArcGoal(pose=matrix_to_pose(T), **points))


@given(start=POINTS, via=POINTS, goal=POINTS)
def test_circle_passes_its_three_points_in_order(start, via, goal):
    try:
        circle = circle_through(start, via, goal)
    except NoArc:
        return
    assume(circle.radius < 10)
    arc = circle.points(np.linspace(0, 1, 2001))
    assert np.allclose(arc[0], start, atol=1e-6)
    assert np.allclose(arc[-1], goal, atol=1e-6)
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
    assert np.allclose(circle.points(SHARES)[-1], centre + other, atol=1e-6)


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: circle_through(START, START + DY, START + 2 * DY), "straight line"),
        (lambda: circle_through(START, START, START + DY), "three different points"),
        (lambda: circle_about(START, START + DY, START + 2 * DY), "plane of the circle"),
        (lambda: circle_about(START, START + DY, START + 2 * DX), "0.1000 m from the start and 0.2236"),
    ],
)
def test_points_that_define_no_circle_are_refused(make, text):
    with pytest.raises(NoArc, match=text):
        make()


@pytest.mark.parametrize("how", ["via", "center"])
def test_tool_follows_the_arc_at_its_speed(how):
    pipeline = with_planner("circ", speed=0.5)
    T = tool_down(0.5, 0.3, 0.2, 0.3)
    point = (0.3, 0, 0.2) if how == "center" else (0.5, 0.0, 0.5)
    request = to_arc(T, **{how: point})
    response = pipeline.plan(request, EMPTY)
    timed = assert_sound(pipeline, request, EMPTY, response)
    assert np.allclose(ROBOT.fk(last(response)), T, atol=2e-4)
    circle = (circle_about if how == "center" else circle_through)(START, np.array(point), T[:3, 3])
    path, _ = fine_samples(timed, 0.01)
    way = np.array([ROBOT.fk(q)[:3, 3] for q in path])
    normal = np.cross(circle.x, circle.y)
    assert np.abs((way - circle.centre) @ normal).max() < 5e-4
    assert np.abs(np.linalg.norm(way - circle.centre, axis=1) - circle.radius).max() < 5e-4
    assert timed.duration > circle.length / 0.1
    assert timed.duration < circle.length / 0.1 + 1


def test_colliding_arc_is_reported_with_waypoint_and_pair():
    beam = solid("beam", "fixture", "box", [0.1, 0.02, 0.1], (0.5, 0.0, 0.5))
    blocked = EMPTY.model_copy(update={"objects": [*EMPTY.objects, beam]})
    response = with_planner("circ").plan(to_arc(tool_down(0.5, 0.3, 0.2), via=(0.5, 0.0, 0.5)), blocked)
    assert response.error == "collision"
    assert response.colliding[1] == "beam"
    assert f"point {response.attempts[-1].waypoint + 1} of " in response.message
    assert 0.1 < response.fraction < 0.5


@pytest.mark.parametrize(("planner", "via", "error", "text"), [
    ("circ", (1.0, 0.0, 0.2), "no_ik", ""),
    ("circ", (0.5, 0.0, 0.2), "bad_goal", "straight line"),
    *((name, (0.5, 0.0, 0.5), "no_planner", "") for name in ("cartesian", "joint_move", "lerp", "lin", "ompl", "ptp")),
])
def test_impossible_arc_is_refused(planner, via, error, text):
    response = with_planner(planner).plan(to_arc(tool_down(0.5, 0.3, 0.2), via=via), EMPTY)
    assert response.error == error
    assert text in response.message
    if error == "no_ik":
        assert 0 < response.fraction < 0.5


@pytest.mark.parametrize("points", [{}, {"via": Vector3(), "center": Vector3()}])
def test_arc_needs_one_circle(points):
    with pytest.raises(ValidationError, match="either via or center"):
        ArcGoal(pose=Pose(), **points)
