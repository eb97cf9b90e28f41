"""Contours in images: their tree, their pixels, and sub-pixel points on noisy edges."""

import cv2
import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from applications.outlining.contour_choice import choose, colour_name
from applications.outlining.contours import (
    ContourOptions,
    channel_of,
    find_contours,
    is_hole,
    normals,
    refine,
)
from applications.outlining.solids import simplified
from applications.outlining.topics import Contours, OutlineSelect
from common.errors import DecodeError
from common.messages import Header
from common.transport.codec import decode, encode
from tests.applications.outlining.outline_scenes import (
    BLUE,
    GREEN,
    RED,
    SEED,
    WORLDS,
    YELLOW,
    rectangles,
    seen_world,
    world,
)


@pytest.mark.parametrize("name", WORLDS)
def test_every_object_is_detected_and_nothing_else(name):
    contours = find_contours(seen_world(name)[1], ContourOptions())
    assert len([c for c in contours if not is_hole(contours, c.index)]) == len(world(name).objects)
    assert not any(c.touches_border for c in contours)


def test_hole_of_a_ring_one_pixel_thin_is_detected():
    image = rectangles()
    for u, v in ((50, 49), (49, 50), (51, 50), (50, 51)):
        image[v, u] = RED
    found = find_contours(image, SEED)
    assert [is_hole(found, each.index) for each in sorted(found, key=lambda each: each.parent)] == [False, True]


@pytest.mark.parametrize("spots", ["small ones", "rings, each in another"])
def test_largest_contours_are_sent_when_there_are_too_many(spots):
    image = rectangles((4, 4, 40, 30, BLUE), size=(1400, 1500))
    if spots == "small ones":
        image[60::6, 60::6] = RED
    else:
        for at in range(60, 700, 4):
            cv2.rectangle(image, (at, at), (1499 - at, 1399 - at), RED)
    found = find_contours(image, SEED)
    decoded = decode(Contours, encode(Contours(header=Header(), width=1500, height=1400, contours=found)))
    assert 10 < len(decoded.contours) <= 1000
    assert all(is_hole(found, each.index) == (colour_name(each.color) == "black") for each in found)
    assert choose(found, OutlineSelect(rule="colour", colour="blue")).area == 39 * 29


@pytest.mark.parametrize(("tree", "problem"), [
    ([(0, -1, 2)], "contour 2 is selected, of 1"), ([(0, -1, -2)], "contour -2 is selected"),
    ([(1, -1, 0)], "indices"), ([(0, 3, 0)], "within 3"), ([(0, -2, 0)], "within -2"), ([(0, 0, 0)], "within 0"),
    ([(0, 1, 0), (1, 2, 0), (2, 1, 0)], "contour 0 lies within 1"),
])
def test_inconsistent_contours_are_rejected(tree, problem):
    contours = [{"index": index, "label": "a", "pixels": [(1.0, 1.0)], "parent": parent} for index, parent, _ in tree]
    message = {"header": {}, "width": 4, "height": 4, "contours": contours, "selected": tree[0][2]}
    with pytest.raises(DecodeError, match=problem):
        decode(Contours, msgpack.packb(message))


@pytest.mark.parametrize(("channel", "seen"), [("grey", ["green"]), ("maximum", ["blue", "green", "red"])])
def test_maximum_and_grey_channels_also_detect_the_ground_at_the_border(channel, seen):
    contours = find_contours(seen_world("w5")[1], ContourOptions(channel=channel, subpixel=False))
    assert sorted(colour_name(c.color) for c in contours if not c.touches_border) == seen
    assert {colour_name(c.color) for c in contours if c.touches_border} == {"grey"}


def test_contour_pixels_are_unique_connected_and_on_the_edge():
    contour, = find_contours(rectangles((10, 20, 30, 12, YELLOW)), SEED)
    edge = {(u, v) for u in range(10, 40) for v in range(20, 32) if u in (10, 39) or v in (20, 31)}
    assert set(contour.pixels) == edge and len(contour.pixels) == len(edge)
    steps = np.diff([*contour.pixels, contour.pixels[0]], axis=0)
    assert np.abs(steps).max() == 1 and contour.label == "Object_0"


def test_a_ring_has_its_hole_as_a_child_and_the_island_in_it_is_an_object():
    image = rectangles((10, 10, 90, 90, YELLOW), (30, 30, 50, 50, (0, 0, 0)), (50, 50, 10, 10, RED))
    contours = find_contours(image, SEED)
    by_color = {colour_name(c.color): c for c in contours}
    ring, hole, island = by_color["yellow"], by_color["black"], by_color["red"]
    assert (ring.parent, hole.parent, island.parent) == (-1, ring.index, hole.index)
    assert [is_hole(contours, c.index) for c in (ring, hole, island)] == [False, True, False]
    assert choose(contours, OutlineSelect()).index == ring.index


def test_contours_below_the_minimum_area_are_left_out_and_the_indices_stay_in_order():
    image = rectangles((10, 10, 40, 40, RED), (80, 30, 2, 2, BLUE), (100, 30, 30, 30, GREEN))
    contours = find_contours(image, SEED.model_copy(update={"min_area": 10.0}))
    assert [c.index for c in contours] == [0, 1] and {colour_name(c.color) for c in contours} == {"red", "green"}


@given(edge=st.floats(20, 23), angle=st.floats(0, 6.28))
def test_refined_points_lie_on_a_straight_edge_whatever_its_direction(edge, angle):
    u, v = np.meshgrid(np.arange(64), np.arange(64))
    fine = (np.arange(8) + 0.5) / 8 - 0.5
    across = np.array([np.cos(angle), np.sin(angle)])
    height = (u - 32) * across[0] + (v - 32) * across[1]
    covered = np.mean([[height + a * across[0] + b * across[1] < edge for a in fine] for b in fine], axis=(0, 1))
    image = np.zeros((64, 64, 3), np.uint8)
    image[..., 1] = np.rint(255 * covered * (np.hypot(u - 32, v - 32) < 31))
    contour = max(find_contours(image, ContourOptions()), key=lambda c: c.area)
    along = (np.array(contour.pixels) - 32) @ np.array([-across[1], across[0]])
    off = (np.array(contour.pixels) - 32) @ across - edge
    on_edge = (np.abs(along) < 15) & (off > -3)
    assert on_edge.sum() > 10 and np.abs(off[on_edge]).max() < 0.2 and abs(off[on_edge].mean()) < 0.12


TURNED = np.radians(17)
TURNS = np.linspace(0, 2 * np.pi, 720, endpoint=False)


def box(width, height):
    """Return a turned rectangle (4, 2) [px]."""
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * (width / 2, height / 2)
    return corners @ [(np.cos(TURNED), np.sin(TURNED)), (-np.sin(TURNED), np.cos(TURNED))] + 150.0


def wheel(radius, teeth=0, high=1.5, wave=np.sin):
    """Return a circle (720, 2) [px] with teeth of a form."""
    r = radius + high * wave(teeth * TURNS)
    return 150.3 + r[:, None] * np.column_stack([np.cos(TURNS), np.sin(TURNS)])


def square(turned):
    return np.sign(np.sin(turned))


def outlined(shape, noise):
    """Return the contour of a shape (n, 2) [px] in an image with this noise [0..255], and the error of each point."""
    large = np.zeros((2400, 2400), np.uint8)  # 8 to a pixel
    cv2.fillPoly(large, [np.rint((shape + 0.5) * 8 - 0.5).astype(np.int32)], 255)
    covered = cv2.GaussianBlur(cv2.resize(large, (300, 300), interpolation=cv2.INTER_AREA).astype(float), (0, 0), 0.6)
    channel = 40 + covered * 180 / 255 + np.random.default_rng(0).normal(0, noise, covered.shape)
    channel = np.clip(channel, 0, 255).astype(np.uint8)
    chains, _ = cv2.findContours((channel > 130).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    points = refine(channel, max(chains, key=len).reshape(-1, 2), hole=False)
    sides = np.roll(shape, -1, axis=0) - shape
    along = ((points[:, None] - shape) * sides).sum(-1) / (sides**2).sum(-1)
    return points, np.linalg.norm(points[:, None] - shape - np.clip(along, 0, 1)[..., None] * sides, axis=-1).min(1)


@pytest.mark.parametrize(("shape", "turns"), [(box(120, 80), 45), (wheel(70), 80)])
def test_image_noise_is_smoothed_and_corners_stay_sharp(shape, turns, monkeypatch):
    even, off = outlined(shape, 12.0)
    assert off.mean() < 0.08 and off.max() < 0.6
    assert len(simplified(even, 0.2)) < turns, "the outline zigzags"
    monkeypatch.setattr("applications.outlining.contours.SHORTEST", np.inf)
    rough, off_rough = outlined(shape, 12.0)
    assert off.mean() < 0.7 * off_rough.mean() and len(simplified(rough, 0.2)) > turns


@pytest.mark.parametrize("shape", [
    box(120, 80), box(14, 14), wheel(70), wheel(60, 40), wheel(60, 25, 0.3), wheel(70, 16, 0.3, square),
    *(pytest.param(shape, marks=pytest.mark.campaign) for shape in (
        box(20, 12), wheel(60, 24), wheel(60, 20, 1.0), wheel(70, 24, 0.5, square)))])
def test_clean_contours_and_details_in_noise_stay_unchanged(shape, monkeypatch):
    clean, _ = outlined(shape, 0.0)
    _, off = outlined(shape, 12.0)
    monkeypatch.setattr("applications.outlining.contours.SHORTEST", np.inf)
    assert np.array_equal(outlined(shape, 0.0)[0], clean)
    assert off.mean() < 1.1 * outlined(shape, 12.0)[1].mean()


def test_normals_point_out_of_the_object_at_its_edge_and_into_a_hole():
    circle = 50 + 20 * np.column_stack([np.cos(TURNS), np.sin(TURNS)])
    for points in (circle, circle[::-1]):
        radial = (points - 50) / 20
        np.testing.assert_allclose(normals(points, hole=False), radial, atol=0.01)
        np.testing.assert_allclose(normals(points, hole=True), -radial, atol=0.01)
    assert not normals(np.array([[5.0, 5.0]]), hole=False).any()


@given(share=st.floats(0, 1), ground=st.integers(0, 178))
def test_every_channel_is_linear_in_the_covered_part_of_a_pixel(share, ground):
    for channel in ("grey", "maximum", "saturation"):
        ends = [float(channel_of(np.full((1, 1, 3), c, np.uint8), channel)[0, 0]) for c in (ground, YELLOW)]
        mixed = np.rint(share * np.array(YELLOW) + (1 - share) * ground).astype(np.uint8)[None, None]
        assert float(channel_of(mixed, channel)[0, 0]) == pytest.approx(ends[0] + share * (ends[1] - ends[0]), abs=2)
