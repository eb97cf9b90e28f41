"""Triangles of solids, and outlines of objects."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from common.config import Fixture, ObjectConfig
from common.sim import solids
from common.sim.objects import object_mesh, world_object
from common.sim.solids import band_triangles, circle, extrude, fixture_mesh, primitive, triangulate

LETTER = np.array([(-4, -3), (4, -3), (4, -1), (1, -1), (1, 4), (-1, 4), (-1, -1), (-4, -1)], float)


def area(triangles):
    a, b = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    return float(np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum() / 2)


def shoelace(outline):
    """Area of an outline, positive if it is counterclockwise."""
    x, y = np.asarray(outline).T
    return float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)) / 2


def volume(corners):
    """Of a closed surface, whatever the sense of its triangles, seen from a point within it: sum of cones."""
    middle = corners.reshape(-1, 3).mean(axis=0)
    a, b, c = (corners[:, k] - middle for k in range(3))
    return float(np.abs(np.einsum("ni,ni->n", a, np.cross(b, c))).sum() / 6)


@given(seed=st.integers(0, 10**6), count=st.integers(3, 24), turn=st.floats(0, 7))
def test_triangles_of_a_polygon_have_its_area_and_do_not_overlap(seed, count, turn):
    radii = np.random.default_rng(seed).uniform(0.2, 1.0, count)
    angles = turn + np.linspace(0, 2 * math.pi, count, endpoint=False)
    star = radii[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    c, s = math.cos(turn), math.sin(turn)
    for outline in (star, star[::-1], LETTER @ np.array([[c, s], [-s, c]])):  # ears of the letter contain corners
        assert area(triangulate(outline)) == pytest.approx(abs(shoelace(outline)), rel=1e-9)


def test_self_intersecting_polygon_takes_bounded_time(monkeypatch):
    calls, is_ear = [], solids.is_ear
    monkeypatch.setattr(solids, "is_ear", lambda *given: calls.append(given) or is_ear(*given))
    triangles = triangulate(np.random.default_rng(1).uniform(-0.1, 0.1, (200, 2)))
    assert triangles.shape == (198, 3, 2) and len(calls) < 2000


def test_band_between_two_circles_has_the_difference_of_their_areas():
    outer, inner = circle(0.06), circle(0.04)[::3]
    assert area(band_triangles(outer, inner)) == pytest.approx(shoelace(outer) - shoelace(inner), rel=2e-3)


@pytest.mark.parametrize(("shape", "size", "expected"), [
    ("box", [0.2, 0.3, 0.4], 0.024), ("cylinder", [0.1, 0.5], math.pi * 0.01 * 0.5),
    ("sphere", [0.1], 4 / 3 * math.pi * 0.001)])
def test_primitives_are_closed_and_have_their_volume(shape, size, expected):
    corners = primitive(shape, size)
    assert volume(corners) == pytest.approx(expected, rel=0.02)
    edges = np.rint(np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]]) * 1e6)
    pairs = [frozenset(map(tuple, edge.tolist())) for edge in edges if (edge[0] != edge[1]).any()]
    assert all(pairs.count(pair) % 2 == 0 for pair in set(pairs))


def test_fixture_mesh_is_at_its_pose():
    mesh = fixture_mesh(Fixture(id="b", dimensions=[0.25, 0.75, 1.0], position=(0.5, 0, 0.5), rpy=(0, 0, math.pi / 2)))
    np.testing.assert_allclose(mesh.corners.reshape(-1, 3).min(axis=0), [0.125, -0.125, 0], atol=1e-12)
    np.testing.assert_allclose(mesh.corners.reshape(-1, 3).max(axis=0), [0.875, 0.125, 1], atol=1e-12)
    with pytest.raises(ValueError, match="no triangles for a cone; choices: box"):
        primitive("cone", [1])


def test_object_mesh_extends_from_its_support_to_its_top_around_its_hole():
    size = {"radius": 0.06, "inner_radius": 0.04, "height": 0.03}
    ring = world_object(ObjectConfig(id="r", shape="ring", x=0.5, y=0, z=1.0, **size))
    corners = object_mesh(ring).corners
    assert (corners[..., 2].min(), corners[..., 2].max()) == pytest.approx((1.0, 1.03))
    radii = np.linalg.norm(corners[..., :2] - (0.5, 0), axis=-1)
    assert (radii.min(), radii.max()) == pytest.approx((0.04, 0.06))
    assert np.hypot(*(np.array(ring.hole) - (0.5, 0)).T) == pytest.approx(0.04)
    assert len(extrude(circle(1.0)[::90], np.empty((0, 2)), 0, 1)) == 4 + 4 + 8


@pytest.mark.parametrize(("options", "expected"), [
    ({"shape": "box", "size": (0.1, 0.2)}, 0.02),
    ({"shape": "cylinder", "radius": 0.05}, math.pi * 0.0025),
    ({"shape": "prism", "polygon": [(0, 0), (0, 0.1), (0.1, 0)]}, 0.005),
])
def test_outline_is_counterclockwise_with_the_area_of_the_shape(options, expected):
    thing = ObjectConfig.model_validate({"id": "thing", "x": 0.5, "y": 0.1, "yaw": 0.4, "height": 0.1, **options})
    assert shoelace(world_object(thing).outline) == pytest.approx(expected, rel=1e-3)


def test_yaw_rotates_counterclockwise_about_the_position():
    thing = ObjectConfig(id="box", shape="box", size=(0.2, 0.1), x=0.5, y=0.1, yaw=math.pi / 2, height=0.1)
    assert np.array(world_object(thing).outline)[1] == pytest.approx([0.55, 0.2])


def test_shape_without_its_dimensions_is_rejected():
    with pytest.raises(ValidationError, match="ring needs radius and inner_radius"):
        ObjectConfig(id="ring", shape="ring", x=0, y=0, height=0.03)
