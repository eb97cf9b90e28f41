import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from common.perception.pinhole import Pinhole
from common.robot.transforms import rpy_to_matrix, transform
from common.sim import ray_caster
from common.sim.objects import object_mesh, world_object
from common.sim.ray_caster import NEAREST, Mesh, cast, empty_view
from common.sim.solids import fixture_mesh
from tests.applications.outlining.outline_scenes import WORLDS, seen_world, world

GREY = (178 / 255,) * 3
CAMERA = Pinhole(80.0, 80.0, 32.0, 24.0, 64, 48, transform(rpy_to_matrix(-math.pi, 0, math.pi / 2), (0.5, 0, 2.0)))
AT_ORIGIN = Pinhole(80.0, 80.0, 32, 24, 64, 48, np.eye(4))
BLACK = empty_view(AT_ORIGIN, (0, 0, 0))


def rectangle(corners, color=(1.0, 1.0, 1.0)) -> Mesh:
    return Mesh(np.array(corners, float)[[[0, 1, 2], [0, 2, 3]]], color)


def ray_by_ray(meshes, camera, pixels):
    """Depth along the optical axis and colour of what each ray meets first, triangle by triangle.

    Möller and Trumbore, "Fast, minimum storage ray/triangle intersection" (1997).
    """
    origin, directions = camera.position, camera.directions(pixels)
    depth, color = np.full(len(pixels), np.inf), np.full((len(pixels), 3), np.nan)
    forward = camera.T_world_optical[:3, 2]
    for mesh in meshes:
        for a, b, c in mesh.corners:
            e, f = b - a, c - a
            p = np.cross(directions, f)
            with np.errstate(divide="ignore", invalid="ignore"):
                inverse = 1.0 / (p @ e)
                u = (p @ (origin - a)) * inverse
                q = np.cross(origin - a, e)
                v = (directions @ q) * inverse
                t = (f @ q) * inverse
            d = t * (directions @ forward)
            met = np.isfinite(t) & (u >= 0) & (v >= 0) & (u + v <= 1) & (d > NEAREST)
            d = np.where(met, d, np.inf)
            nearer = d < depth - 1e-9
            depth[nearer], color[nearer] = d[nearer], mesh.color
    return depth, color


def triangles(seed, count):
    rng = np.random.default_rng(seed)
    middle = rng.uniform((0.2, -0.4, 0.0), (0.8, 0.4, 2.3), (count, 1, 3))
    return middle + rng.normal(0, 0.15, (count, 3, 3))


@given(seed=st.integers(0, 10**6), count=st.integers(1, 12))
@example(seed=69, count=1)  # reaches behind the camera: NEAREST cuts it, however far aside
@settings(max_examples=30, deadline=None)
def test_ray_caster_matches_single_rays_for_random_triangles(seed, count):
    corners = triangles(seed, count)
    colors = np.random.default_rng(seed).integers(0, 256, (count, 3)) / 255
    meshes = [Mesh(c[None], tuple(map(float, color))) for c, color in zip(corners, colors, strict=True)]
    view = cast(meshes, CAMERA, empty_view(CAMERA, GREY))
    u, v = np.meshgrid(np.arange(64), np.arange(48))
    depth, _ = ray_by_ray(meshes, CAMERA, np.stack([u, v], axis=-1).reshape(-1, 2).astype(float))
    expected, got = depth.reshape(48, 64), view.depth.astype(float)
    same = np.isclose(1 / got, 1 / expected, rtol=1e-4, atol=1e-6)
    assert (~same).mean() < 0.002  # rays through an edge


@pytest.mark.parametrize("name", [name if name in ("w2", "w6") else pytest.param(name, marks=pytest.mark.campaign)
                                  for name in WORLDS])
def test_ray_caster_matches_single_rays_for_the_worlds(name):
    camera, picture, depth = seen_world(name)
    objects = [object_mesh(world_object(o)) for o in world(name).objects]
    meshes = [fixture_mesh(f) for f in world(name).fixtures] + objects
    rng = np.random.default_rng(3)
    around = np.rint(camera.project(np.concatenate([m.corners for m in objects]).reshape(-1, 3))).astype(int)
    pixels = np.vstack([rng.choice(around, 60) + rng.integers(-3, 4, (60, 2)), rng.integers(0, (1024, 768), (60, 2))])
    u, v = pixels.T
    expected, color = ray_by_ray(meshes, camera, pixels.astype(float))
    expected[expected > 2.25] = np.nan
    np.testing.assert_allclose(depth[v, u], expected, atol=2e-6)
    around = [picture[y - 1 : y + 2, x - 1 : x + 2].reshape(-1, 3) for x, y in pixels]
    flat = np.array([np.ptp(colors, axis=0).max() == 0 for colors in around])
    shown = np.where(np.isnan(color), GREY, color)[:, ::-1] * 255
    np.testing.assert_allclose(picture[v, u][flat], shown[flat], atol=0.5)


def test_edge_pixel_color_equals_its_coverage():
    # a square that ends 0.3 px right of the centre of column 40 and 0.2 px below that of row 30
    x, y = (40.3 - 32) / 80, (30.2 - 24) / 80
    view = cast([rectangle([[-0.1, -0.1, 1], [x, -0.1, 1], [x, y, 1], [-0.1, y, 1]])], AT_ORIGIN, BLACK)
    covered = view.colour[..., 0] / 255
    assert covered[28, 40] == pytest.approx(0.8, abs=0.04) and covered[30, 38] == pytest.approx(0.7, abs=0.04)
    assert covered[30, 40] == pytest.approx(0.56, abs=0.1)
    assert covered[28, 39] == 1 and covered[28, 41] == 0
    assert view.depth[28, 40] == pytest.approx(1.0) and np.isinf(view.depth[28, 41])


def test_adjacent_triangles_have_no_seam():
    for angle in np.linspace(0, 1.5, 12):
        c, s = math.cos(angle), math.sin(angle)
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) @ np.array([[c, s], [-s, c]]) * 3
        view = cast([rectangle(np.column_stack([corners, np.full(4, 2.0)]))], AT_ORIGIN, BLACK)
        assert (view.colour == 255).all() and (view.depth == 2).all()


def test_existing_view_occludes_and_is_not_modified():
    def wall(z, color, width):
        return rectangle([[-width, -9, z], [width, -9, z], [width, 9, z], [-width, 9, z]], color)

    near = cast([wall(1.0, (1, 0, 0), 0.1)], AT_ORIGIN, BLACK)
    both = cast([wall(2.0, (0, 1, 0), 9)], AT_ORIGIN, near)
    together = cast([wall(1.0, (1, 0, 0), 0.1), wall(2.0, (0, 1, 0), 9)], AT_ORIGIN, BLACK)
    np.testing.assert_array_equal(both.depth, together.depth)
    assert np.abs(both.colour.astype(int) - together.colour)[:, 20].max() == 0
    assert both.colour[24, 32].tolist() == [0, 0, 255] and both.colour[24, 5].tolist() == [0, 255, 0]
    assert near.colour[24, 5].tolist() == [0, 0, 0]


def test_triangles_behind_the_camera_are_clipped():
    floor = rectangle([[-50, 0.5, -10], [50, 0.5, -10], [50, 0.5, 40], [-50, 0.5, 40]])
    view = cast([floor], AT_ORIGIN, BLACK)
    assert np.isinf(view.depth[:25]).all()
    np.testing.assert_allclose(view.depth[30:, 3], 0.5 * 80 / (np.arange(30, 48) - 24), rtol=1e-5)


def test_empty_view_has_its_color_and_no_depth():
    view = cast([], AT_ORIGIN, empty_view(AT_ORIGIN, GREY))
    assert (view.colour == 178).all() and np.isnan(view.depth_within(0.1, 2.25)).all()


def test_view_does_not_depend_on_the_batch_size(monkeypatch):
    rng = np.random.default_rng(3)
    meshes = [Mesh(triangles(seed, 20), tuple(rng.integers(0, 256, 3) / 255)) for seed in range(5)]
    meshes.append(meshes[0])  # of two at the same depth the first is seen
    one = cast(meshes, CAMERA, empty_view(CAMERA, GREY))
    monkeypatch.setattr(ray_caster, "BATCH_PIXELS", 100)
    other = cast(meshes, CAMERA, empty_view(CAMERA, GREY))
    assert np.array_equal(one.colour, other.colour) and np.array_equal(one.depth, other.depth)


def test_work_and_memory_for_a_view_are_bounded(monkeypatch, caplog):
    wall = np.array([[(-9.0, -9.0, 1.0), (9.0, -9.0, 1.0), (0.0, 12.0, 1.0)]])
    meshes = [Mesh(wall - (0, 0, 1e-3 * i), (i / 999, 0.0, 0.0)) for i in range(1000)]
    pixels: list[int] = []
    spans = ray_caster.pixel_spans

    def counted(*arguments):
        found = spans(*arguments)
        pixels.append(int((found[3] - found[2] + 1).sum()))
        return found

    monkeypatch.setattr(ray_caster, "pixel_spans", counted)
    monkeypatch.setattr(ray_caster, "BATCH_PIXELS", 20_000)
    view = cast(meshes, CAMERA, empty_view(CAMERA, GREY))
    assert view.depth[24, 32] == pytest.approx(1.0, rel=1e-6), "the first of them are seen"
    assert sum(pixels) <= 2 * ray_caster.MAX_LAYERS * 64 * 48 and max(pixels) < 20_000 + 2 * 64 * 48
    assert "901 of 1000 triangles are not drawn" in caplog.text
