import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.config import Fixture, ObjectConfig
from common.sim import solids
from common.sim.objects import object_mesh, world_object
from common.sim.solids import band_triangles, circle, extrude, fixture_mesh, primitive, triangulate

original_is_ear = solids.is_ear


def area(triangles):
    a, b = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    return float(np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum() / 2)


def shoelace(outline):
    x, y = np.asarray(outline).T
    return abs(float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))) / 2


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
    for outline in (star, star[::-1]):
        assert area(triangulate(outline)) == pytest.approx(shoelace(outline), rel=1e-9)


@given(turn=st.floats(0, 7))
def test_ears_contain_no_other_corner(turn):
    c, s = math.cos(turn), math.sin(turn)
    letter = [(-4, -3), (4, -3), (4, -1), (1, -1), (1, 4), (-1, 4), (-1, -1), (-4, -1)]
    outline = np.array(letter, float) @ np.array([[c, s], [-s, c]])
    assert area(triangulate(outline)) == pytest.approx(shoelace(outline), rel=1e-9)


def test_self_intersecting_polygon_takes_bounded_time():
    looked_at = 0

    def counted(*given):
        nonlocal looked_at
        looked_at += 1
        return original_is_ear(*given)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(solids, "is_ear", counted)
        triangles = triangulate(np.random.default_rng(1).uniform(-0.1, 0.1, (200, 2)))
    assert triangles.shape == (198, 3, 2) and looked_at < 2000


def test_band_between_two_circles_has_the_difference_of_their_areas():
    outer, inner = circle(0.06), circle(0.04)[::3]
    assert area(band_triangles(outer, inner)) == pytest.approx(shoelace(outer) - shoelace(inner), rel=2e-3)


@pytest.mark.parametrize("shape, size, expected", [
    ("box", [0.2, 0.3, 0.4], 0.024), ("cylinder", [0.1, 0.5], math.pi * 0.01 * 0.5),
    ("sphere", [0.1], 4 / 3 * math.pi * 0.001)])
def test_primitives_are_closed_and_have_their_volume(shape, size, expected):
    corners = primitive(shape, size)
    assert volume(corners) == pytest.approx(expected, rel=0.02)
    edges = np.sort(np.rint(np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]]) * 1e6), axis=1)
    solid = edges[(np.abs(edges[:, 0] - edges[:, 1]) > 0).any(axis=1)]
    _, counts = np.unique(np.sort(solid.reshape(-1, 6).view([("", float)] * 3).reshape(-1, 2), axis=1), axis=0,
                          return_counts=True)
    assert (counts % 2 == 0).all()


def test_fixture_mesh_is_at_its_pose():
    mesh = fixture_mesh(Fixture(id="b", dimensions=[0.25, 0.75, 1.0], position=(0.5, 0, 0.5), rpy=(0, 0, math.pi / 2)))
    np.testing.assert_allclose(mesh.corners.reshape(-1, 3).min(axis=0), [0.125, -0.125, 0], atol=1e-12)
    np.testing.assert_allclose(mesh.corners.reshape(-1, 3).max(axis=0), [0.875, 0.125, 1], atol=1e-12)
    with pytest.raises(ValueError, match="no triangles for a cone; choices: box"):
        primitive("cone", [1])


def test_object_mesh_extends_from_its_support_to_its_top():
    ring = ObjectConfig(id="r", shape="ring", x=0.5, y=0, z=1.0, radius=0.06, inner_radius=0.04, height=0.03)
    corners = object_mesh(world_object(ring)).corners
    assert (corners[..., 2].min(), corners[..., 2].max()) == pytest.approx((1.0, 1.03))
    radii = np.linalg.norm(corners[..., :2] - (0.5, 0), axis=-1)
    assert radii.min() == pytest.approx(0.04) and radii.max() == pytest.approx(0.06)
    assert len(extrude(circle(1.0)[::90], np.empty((0, 2)), 0, 1)) == 4 + 4 + 8
