"""Accuracy of the perceived outline in both modes, for objects anywhere."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from applications.outlining.contours import ContourOptions, find_contours, is_hole
from applications.outlining.top_face import TopFaceOptions, top_face
from common.perception.depth import DepthError
from common.sim.objects import world_object
from common.sim.ray_caster import Mesh, cast, empty_view
from common.sim.sensors import DepthSensorParameters, simulate_depth
from common.sim.solids import fixture_mesh
from tests.applications.outlining.outline_scenes import WORLDS, dense, distances, seen, seen_world, upright, world

SEED, FINE = (ContourOptions(subpixel=False), TopFaceOptions(rounding=0.001)), (ContourOptions(), TopFaceOptions())
L_SHAPE = world("w4").objects[0].polygon
ELSEWHERE = {
    "tall box far off the axis": upright(shape="box", x=0.56, y=0.18, size=(0.08, 0.06), height=0.2, yaw=0.4),
    "cube 0.1 m off the axis": upright(shape="box", x=0.5, y=0.1, size=(0.1, 0.1), height=0.1),
    "box with one wall along a ray": upright(shape="box", x=0.54, y=0.03, size=(0.06, 0.06), height=0.15),
    "tall cylinder over the edge of the base": upright(shape="cylinder", x=0.41, y=0.15, radius=0.03, height=0.25),
    "flat cylinder": upright(shape="cylinder", x=0.45, y=-0.05, radius=0.03, height=0.02),
    "low box in the corner of the base": upright(shape="box", x=0.41, y=-0.2, size=(0.05, 0.05), height=0.03),
    "tall ring": upright(shape="ring", x=0.55, y=0.15, radius=0.05, inner_radius=0.03, height=0.1),
    "tall L-shape": upright(shape="prism", x=0.55, y=-0.15, polygon=L_SHAPE, height=0.15, yaw=2.0),
}


def outlines(scene, objects, mode):
    """The perceived and the true outline of each object and hole of a scene."""
    camera, picture, depth = scene
    truth = [world_object(o) for o in objects]
    contours = find_contours(picture, mode[0])
    for contour in contours:
        hole = is_hole(contours, contour.index)
        face = top_face(contour.pixels, depth, camera, mode[1], hole=hole)
        middle = face.outline[:, :2].mean(axis=0)
        thing = min(truth, key=lambda o: float(np.linalg.norm(np.mean(o.outline, axis=0) - middle)))
        yield face, thing, np.array(thing.hole if hole else thing.outline)


@pytest.mark.parametrize("name", WORLDS)
def test_outlines_of_both_modes_are_accurate(name):
    found = list(outlines(seen_world(name), world(name).objects, SEED))
    assert len(found) == {"w5": 3, "w6": 2}.get(name, 1)
    for face, thing, true in found:
        off = distances(dense(face.outline), true)
        assert off.max() < 1.2e-3 and off.mean() < 0.4e-3
        assert (face.top, face.base) == pytest.approx((thing.base + thing.height, 1), abs=1e-5)
        np.testing.assert_allclose(face.outline * 1000, np.rint(face.outline * 1000), atol=1e-6)
    for face, thing, true in outlines(seen_world(name), world(name).objects, FINE):
        off = distances(dense(face.outline), true)
        assert off.max() < 0.25e-3 and off.mean() < 0.03e-3
        assert distances(dense(true), face.outline).max() < 0.4e-3  # no part is missing; corners are a little rounded
        assert face.upright and face.filled == 0 and face.outline[:, 2] == pytest.approx(thing.base + thing.height)
        step = np.roll(face.outline, -1, axis=0)[:, :2] - face.outline[:, :2]
        lengths = np.linalg.norm(step, axis=1)
        both_long = (lengths > 2e-4) & (np.roll(lengths, -1) > 2e-4)
        back = (step * np.roll(step, -1, axis=0)).sum(axis=1) < -0.5 * lengths * np.roll(lengths, -1)
        assert not (back & both_long).any(), "the outline never turns back"


@pytest.mark.parametrize("name", ELSEWHERE)
def test_visible_walls_do_not_degrade_the_outline(name):
    scene = seen([ELSEWHERE[name]])
    for face, _, true in outlines(scene, [ELSEWHERE[name]], FINE):
        off = distances(dense(face.outline), true)
        assert off.max() < 0.3e-3 and off.mean() < 0.04e-3 and distances(dense(true), face.outline).max() < 0.5e-3
    for face, _, true in outlines(scene, [ELSEWHERE[name]], SEED):
        off = distances(dense(face.outline), true)
        assert off.max() < 1.3e-3 and off.mean() < 0.45e-3


@given(x=st.floats(0.43, 0.57), y=st.floats(-0.18, 0.18), yaw=st.floats(0, 3.2), height=st.floats(0.01, 0.2),
       a=st.floats(0.03, 0.09), b=st.floats(0.03, 0.09))
@settings(max_examples=8)
def test_boxes_anywhere_are_outlined_to_half_a_millimeter(x, y, yaw, height, a, b):
    thing = upright(shape="box", x=x, y=y, yaw=yaw, height=height, size=(a, b))
    for face, _, true in outlines(seen([thing]), [thing], FINE):
        assert distances(dense(face.outline), true).max() < 0.5e-3


def test_depth_noise_hardly_moves_the_outline():
    thing = ELSEWHERE["tall box far off the axis"]
    camera, picture, depth = seen([thing])
    noisy = (depth + np.random.default_rng(0).normal(0, 0.001, depth.shape)).astype(np.float32)
    for face, _, true in outlines((camera, picture, noisy), [thing], FINE):
        assert distances(dense(face.outline), true).max() < 0.4e-3 and face.top == pytest.approx(1.2, abs=2e-4)


@pytest.mark.parametrize("name", ["w3", "w6"])
def test_stereo_depth_with_frayed_edges_hardly_moves_the_outline(name):
    camera, picture, depth = seen_world(name)
    stereo = DepthSensorParameters(baseline=0.075)
    measured = simulate_depth(depth, camera, stereo, np.random.default_rng(1))
    for face, thing, true in outlines((camera, picture, measured), world(name).objects, FINE):
        assert face.filled > 0
        assert face.top == pytest.approx(thing.base + thing.height, abs=1e-3)
        off = distances(dense(face.outline), true)
        assert off.max() < 0.6e-3 and off.mean() < 0.2e-3


def contour_of(scene, mode=SEED):
    return find_contours(scene[1], mode[0])[0].pixels


@pytest.mark.parametrize("mode", [SEED, FINE])
def test_missing_depth_is_filled_from_the_object_and_counted(mode):
    scene = camera, _, depth = seen_world("w2")
    pixels = contour_of(scene, mode)
    whole = top_face(pixels, depth, camera, mode[1])
    holed = depth.copy()
    u, v = np.rint(np.mean(pixels, axis=0)).astype(int)
    right = int(max(p[0] for p in pixels))
    holed[v - 15 : v + 15, right - 2 : right + 1] = np.nan
    face = top_face(pixels, holed, camera, mode[1])
    assert face.filled == 30
    np.testing.assert_allclose(face.outline, whole.outline, atol=1e-9)
    holed[v - 25 : v + 25, u - 200 : u + 200] = np.nan
    with pytest.raises(DepthError, match=r"of the 816 pixels of the contour have no valid depth, more than 5%"):
        top_face(pixels, holed, camera, mode[1])


@pytest.mark.parametrize("size", [3, 7])
@pytest.mark.parametrize("mode", [SEED, FINE], ids=["seed", "fine"])
def test_single_wrong_depth_is_not_the_top_of_a_small_object(size, mode):
    camera, picture, depth = seen([])
    part = slice(384, 384 + size), slice(512, 512 + size)
    picture[part], depth[part] = (0, 255, 255), 1.7
    depth[384 + size // 2, 512 + size // 2] = 1.2
    face = top_face(find_contours(picture, mode[0])[0].pixels, depth, camera, mode[1])
    assert face.top == pytest.approx(2.75 - 1.7, abs=1e-6) and len(face.outline) > 3


def test_object_out_of_range_is_reported():
    scene = camera, _, depth = seen_world("w3")
    far = np.where(depth < 1.7, np.float32(np.nan), depth)
    with pytest.raises(DepthError, match="within the camera's range"):
        top_face(contour_of(scene), far, camera, TopFaceOptions())


@pytest.mark.parametrize("wide", [0.07, 0.03])
def test_sloping_walls_do_not_shift_the_outline(wide):
    """A truncated pyramid: its contour is that of its foot (or of its top, where it hangs over)."""
    around = world("w2")
    camera, _, _ = seen_world("w2")
    low, high = ([(sx * w, sy * w) for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1))] for w in (wide, 0.05))
    corners = np.array([(0.5 + x, 0.1 + y, z) for ring, z in ((low, 1.0), (high, 1.1)) for x, y in ring])
    faces = [(4, 5, 6), (4, 6, 7), *((i, (i + 1) % 4, 4 + (i + 1) % 4) for i in range(4)),
             *((i, 4 + (i + 1) % 4, 4 + i) for i in range(4))]
    meshes = [fixture_mesh(f) for f in around.fixtures] + [Mesh(corners[np.array(faces)], (1.0, 1.0, 0.0))]
    view = cast(meshes, camera, empty_view(camera, (0.7, 0.7, 0.7)))
    depth = view.depth_within(0.1, 2.25)
    face = top_face(find_contours(view.colour, ContourOptions())[0].pixels, depth, camera, TopFaceOptions())
    assert not face.upright
    assert distances(dense(face.outline), corners[4:]).max() < 0.6e-3


def test_contour_pixels_are_centres_of_pixels():
    """A shift by half a pixel would be 0.25 mm: the middle of a symmetric object shows none."""
    for mode, close in ((SEED, 0.1e-3), (FINE, 0.02e-3)):
        face, _, _ = next(outlines(seen_world("w3"), world("w3").objects, mode))
        middle = dense(face.outline).mean(axis=0)
        assert math.dist(middle, (0.5, 0.0)) < close
