"""Prisms fill the hull of any outline."""

import math

import coal
import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from common.messages import PathGoal, PlanRequest
from common.planning.prism import convex_hull, is_line, prism
from tests.common.planning.checks import PIPELINE, assert_refused
from tests.common.planning.requests import above, down, to, touching
from tests.common.planning.scenes import only, solid

HEIGHT = 0.2
ANGLE = [(-0.05, -0.05), (0.05, -0.05), (0.05, -0.03), (-0.03, -0.03), (-0.03, 0.05), (-0.05, 0.05)]
points = st.lists(st.tuples(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2)), min_size=3, max_size=60)


def touches(body: coal.CollisionGeometry, x: float, y: float, z: float) -> bool:
    result = coal.CollisionResult()
    there = coal.Transform3s(np.eye(3), np.array([x, y, z]))
    coal.collide(body, coal.Transform3s(), coal.Sphere(1e-4), there, coal.CollisionRequest(), result)
    return bool(result.isCollision())


@settings(max_examples=20, deadline=None)
@example([(0.0, 0.0), (0.0, 0.125), (3e-35, 0.0), (-0.125, 0.0)], 0.25)
@given(points, st.floats(0.01, 0.3))
def test_prism_contains_its_points_and_nothing_outside_its_hull(outline, length):
    assume(not is_line([(round(x, 3), round(y, 3)) for x, y in outline]))
    body = prism(outline, length)
    hull = convex_hull(np.array(outline))
    for x, y in [*outline, *(np.mean(outline, axis=0),)]:
        assert touches(body, x, y, 0.0) and touches(body, x, y, 0.49 * length)
        assert not touches(body, x, y, 0.5 * length + 1e-3)
    middle = hull.mean(axis=0)
    for a, b in zip(hull, np.roll(hull, -1, axis=0), strict=True):
        out = np.array([b[1] - a[1], a[0] - b[0]]) / max(np.linalg.norm(b - a), 1e-12)
        assert (a - middle) @ out >= -1e-6  # anticlockwise
        if np.linalg.norm(b - a) > 1e-3:
            assert not touches(body, *((a + b) / 2 + 1e-3 * out), 0.0)


@pytest.mark.parametrize("count", [3, 4, 5, 64, 255, 256, 2000])
def test_number_of_corners_does_not_matter(count):
    angles = np.linspace(0, 2 * math.pi, count, endpoint=False)
    body = prism([(0.05 * math.cos(a), 0.05 * math.sin(a)) for a in angles], 0.1)
    assert touches(body, 0.0495, 0.0, 0.0) and touches(body, 0.0, 0.0, -0.0499)
    assert not touches(body, 0.0505, 0.0, 0.0) and not touches(body, 0.0, 0.0, 0.051)


def along(*places: tuple[float, float]) -> PlanRequest:
    return to(PathGoal(waypoints=[down(x, y, HEIGHT).pose for x, y in places]), above(*places[0], HEIGHT))


def test_prism_may_be_touched_by_allowed_links_only():
    around = only(solid("angle", "target", "prism", [0.1], (0.5, 0.0, 0.15), outline=ANGLE))
    inside = along((0.5, -0.01), (0.49, -0.01))  # in the hull of the angle, outside its two sides
    response = PIPELINE.plan(inside, around)
    assert (response.error, response.colliding[1]) == ("start_in_collision", "angle")
    assert PIPELINE.plan(inside.model_copy(update={"allowed_collisions": touching("angle")}), around).ok
    assert PIPELINE.plan(along((0.5, 0.3), (0.45, 0.3)), around).ok


def test_prism_without_area_is_refused_with_its_name():
    line = only(solid("line", "target", "prism", [0.1], (0.5, 0.3, 0.1), outline=[(0, 0), (0.01, 0.01), (0.02, 0.02)]))
    response = PIPELINE.plan(along((0.5, 0.0), (0.45, 0.0)), line)
    assert_refused(response, "bad_scene", "line: the 3 points of its outline lie on one line")
