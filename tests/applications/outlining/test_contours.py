import cv2
import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from applications.outlining.contour_choice import (
    CHOSEN,
    NAMES,
    ContourTracker,
    NoSuchContour,
    annotate_contours,
    choose,
    colour_name,
    described,
    parse_choice,
)
from applications.outlining.contours import (
    SHORTEST,
    ContourOptions,
    channel_of,
    find_contours,
    is_hole,
    normals,
    refine,
    smoothed,
)
from applications.outlining.solids import simplified
from applications.outlining.topics import Contours, OutlineSelect
from common.errors import DecodeError
from common.messages import Color, Header
from common.transport.codec import decode, encode
from tests.applications.outlining.outline_scenes import WORLDS, seen_world, world

SEED = ContourOptions(subpixel=False)


def picture(*rectangles, size=(120, 160)):
    """Rectangles (left, top, width, height, bgr) on black."""
    drawn = np.zeros((*size, 3), np.uint8)
    for left, top, width, height, color in rectangles:
        drawn[top : top + height, left : left + width] = color
    return drawn


RED, BLUE, GREEN, YELLOW, GREY = (0, 0, 255), (255, 0, 0), (0, 255, 0), (0, 255, 255), (178, 178, 178)


@pytest.mark.parametrize("name", WORLDS)
def test_default_sees_every_object_and_nothing_else(name):
    contours = find_contours(seen_world(name)[1], ContourOptions())
    assert len([c for c in contours if not is_hole(contours, c.index)]) == len(world(name).objects)
    assert not any(c.touches_border for c in contours)


def test_hole_of_a_ring_one_pixel_thin_is_detected():
    seen = picture()
    for u, v in ((50, 49), (49, 50), (51, 50), (50, 51)):
        seen[v, u] = RED
    found = find_contours(seen, SEED)
    assert [is_hole(found, each.index) for each in sorted(found, key=lambda each: each.parent)] == [False, True]


@pytest.mark.parametrize("spots", ["small ones", "rings, each in another"])
def test_largest_contours_are_sent_when_there_are_too_many(spots):
    seen = picture((4, 4, 40, 30, BLUE), size=(1400, 1500))
    if spots == "small ones":
        seen[60::6, 60::6] = RED
    else:
        for at in range(60, 700, 4):
            cv2.rectangle(seen, (at, at), (1499 - at, 1399 - at), RED)
    found = find_contours(seen, SEED)
    decoded = decode(Contours, encode(Contours(header=Header(), width=1500, height=1400, contours=found)))
    assert 10 < len(decoded.contours) <= 1000
    assert all(is_hole(found, each.index) == (colour_name(each.color) == "black") for each in found)
    assert choose(found, OutlineSelect(rule="colour", colour="blue")).area == 39 * 29


@pytest.mark.parametrize("tree, problem", [
    ([(0, -1, 2)], "contour 2 is selected, of 1"), ([(0, -1, -2)], "contour -2 is selected"),
    ([(1, -1, 0)], "indices"), ([(0, 3, 0)], "within 3"), ([(0, -2, 0)], "within -2"), ([(0, 0, 0)], "within 0"),
    ([(0, 1, 0), (1, 2, 0), (2, 1, 0)], "contour 0 lies within 1"),
])
def test_inconsistent_contours_are_rejected(tree, problem):
    contours = [{"index": index, "label": "a", "pixels": [(1.0, 1.0)], "parent": parent} for index, parent, _ in tree]
    message = {"header": {}, "width": 4, "height": 4, "contours": contours, "selected": tree[0][2]}
    with pytest.raises(DecodeError, match=problem):
        decode(Contours, msgpack.packb(message))


@pytest.mark.parametrize("channel, seen", [("grey", ["green"]), ("maximum", ["blue", "green", "red"])])
def test_maximum_and_grey_channels_also_see_the_ground_at_the_border(channel, seen):
    contours = find_contours(seen_world("w5")[1], ContourOptions(channel=channel, subpixel=False))
    assert sorted(colour_name(c.color) for c in contours if not c.touches_border) == seen
    assert {colour_name(c.color) for c in contours if c.touches_border} == {"grey"}


def test_contour_pixels_are_unique_connected_and_on_the_edge():
    contour, = find_contours(picture((10, 20, 30, 12, YELLOW)), SEED)
    edge = {(u, v) for u in range(10, 40) for v in range(20, 32) if u in (10, 39) or v in (20, 31)}
    assert set(contour.pixels) == edge and len(contour.pixels) == len(edge)
    steps = np.diff([*contour.pixels, contour.pixels[0]], axis=0)
    assert np.abs(steps).max() == 1 and contour.label == "Object_0"


def test_a_ring_has_its_hole_as_a_child_and_the_island_in_it_is_an_object():
    drawn = picture((10, 10, 90, 90, YELLOW), (30, 30, 50, 50, (0, 0, 0)), (50, 50, 10, 10, RED))
    contours = find_contours(drawn, SEED)
    by_color = {colour_name(c.color): c for c in contours}
    ring, hole, island = by_color["yellow"], by_color["black"], by_color["red"]
    assert (ring.parent, hole.parent, island.parent) == (-1, ring.index, hole.index)
    assert [is_hole(contours, c.index) for c in (ring, hole, island)] == [False, True, False]
    assert choose(contours, OutlineSelect()).index == ring.index


def test_small_contours_can_be_left_out_and_the_indices_stay_in_order():
    drawn = picture((10, 10, 40, 40, RED), (80, 30, 2, 2, BLUE), (100, 30, 30, 30, GREEN))
    contours = find_contours(drawn, SEED.model_copy(update={"min_area": 10.0}))
    assert [c.index for c in contours] == [0, 1] and {colour_name(c.color) for c in contours} == {"red", "green"}


@given(edge=st.floats(20, 23), angle=st.floats(0, 6.28))
def test_refined_points_lie_on_a_straight_edge_whatever_its_direction(edge, angle):
    u, v = np.meshgrid(np.arange(64), np.arange(64))
    fine = (np.arange(8) + 0.5) / 8 - 0.5
    across = np.array([np.cos(angle), np.sin(angle)])
    height = (u - 32) * across[0] + (v - 32) * across[1]
    covered = np.mean([[height + a * across[0] + b * across[1] < edge for a in fine] for b in fine], axis=(0, 1))
    inside = np.hypot(u - 32, v - 32) < 31
    drawn = np.zeros((64, 64, 3), np.uint8)
    drawn[..., 1] = np.rint(255 * covered * inside)
    contour = max(find_contours(drawn, ContourOptions()), key=lambda c: c.area)
    along = (np.array(contour.pixels) - 32) @ np.array([-across[1], across[0]])
    off = (np.array(contour.pixels) - 32) @ across - edge
    on_edge = (np.abs(along) < 15) & (off > -3)
    assert on_edge.sum() > 10 and np.abs(off[on_edge]).max() < 0.2 and abs(off[on_edge].mean()) < 0.12


TURNED = np.radians(17)
TURNS = np.linspace(0, 2 * np.pi, 720, endpoint=False)


def box(width, height):
    """A turned rectangle (4, 2) [px]."""
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * (width / 2, height / 2)
    return corners @ [(np.cos(TURNED), np.sin(TURNED)), (-np.sin(TURNED), np.cos(TURNED))] + 150.0


def wheel(radius, teeth=0, high=1.5, wave=np.sin):
    """A circle (720, 2) [px], with waves for teeth, or teeth of another form."""
    r = radius + high * wave(teeth * TURNS)
    return 150.3 + r[:, None] * np.column_stack([np.cos(TURNS), np.sin(TURNS)])


def square(turned):
    return np.sign(np.sin(turned))


def outlined(shape, noise):
    """The contour of a shape (n, 2) [px] in a picture with so much noise [0..255], and how far off each point is."""
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
    assert len(simplified(even, 0.2)) < turns, "an outline that zigzags is not followed at an even speed"
    monkeypatch.setattr("applications.outlining.contours.SHORTEST", np.inf)
    rough, off_rough = outlined(shape, 12.0)
    assert off.mean() < 0.7 * off_rough.mean() and len(simplified(rough, 0.2)) > turns


@pytest.mark.parametrize("shape", [box(120, 80), box(14, 14), box(20, 12), wheel(70), wheel(60, 40), wheel(60, 24),
                                   wheel(60, 20, 1.0), wheel(60, 25, 0.3),
                                   wheel(70, 24, 0.5, square), wheel(70, 16, 0.3, square)])
def test_clean_contours_and_details_in_noise_stay_unchanged(shape, monkeypatch):
    clean, _ = outlined(shape, 0.0)
    _, off = outlined(shape, 12.0)
    monkeypatch.setattr("applications.outlining.contours.SHORTEST", np.inf)
    assert np.array_equal(outlined(shape, 0.0)[0], clean)
    assert off.mean() < 1.1 * outlined(shape, 12.0)[1].mean()


def test_short_contour_is_not_smoothed():
    few = np.random.default_rng(0).normal(0, 5, (SHORTEST - 1, 2))
    assert smoothed(few) is few


def test_normals_point_out_of_the_object_at_its_edge_and_into_a_hole():
    angles = np.linspace(0, 2 * np.pi, 100, endpoint=False)
    circle = 50 + 20 * np.column_stack([np.cos(angles), np.sin(angles)])
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


def test_empty_image_has_no_contour_to_select():
    assert find_contours(picture(), ContourOptions()) == []
    with pytest.raises(NoSuchContour, match="the picture has no contour"):
        choose([], OutlineSelect())
    assert described([]) == "none"


def test_auto_selects_the_largest_contour_off_the_border():
    contours = find_contours(picture((0, 0, 80, 80, RED), (100, 20, 20, 20, BLUE), (100, 60, 30, 30, GREEN)), SEED)
    assert colour_name(choose(contours, OutlineSelect()).color) == "green"
    assert colour_name(choose(contours, OutlineSelect(rule="colour", colour="Blue")).color) == "blue"
    with pytest.raises(NoSuchContour, match="every red contour touches the border"):
        choose(contours, OutlineSelect(rule="colour", colour="red"))
    red = next(c for c in contours if c.touches_border)
    assert choose(contours, OutlineSelect(rule="index", index=red.index)) is red


@pytest.mark.parametrize("wanted, said", [
    (OutlineSelect(rule="index", index=5), r"no contour 5; choices: 0 \(Object_0, red\)"),
    (OutlineSelect(rule="index"), "no index is given"),
    (OutlineSelect(rule="colour", colour="green"), r"no green contour; choices: 0 \(Object_0, red\)"),
    (OutlineSelect(rule="colour", colour="beige"), "'beige' is no colour; choices: red, orange"),
])
def test_missing_contour_is_rejected_with_the_choices(wanted, said):
    contours = find_contours(picture((20, 20, 30, 30, RED)), SEED)
    with pytest.raises(NoSuchContour, match=said):
        choose(contours, wanted)


@pytest.mark.parametrize("text, rule, value", [
    ("auto", "auto", None), (3, "index", 3), ("3", "index", 3), ("Object_2", "index", 2), ("gray", "colour", "gray")])
def test_text_is_parsed_to_a_selection(text, rule, value):
    wanted = parse_choice(text)
    assert wanted.rule == rule and value in (None, wanted.index, wanted.colour)


def test_empty_text_selects_nothing_and_nonsense_is_rejected():
    assert parse_choice("none") is parse_choice("") is None
    with pytest.raises(NoSuchContour, match="choices: none, auto, an index, red"):
        parse_choice("largest")


@pytest.mark.parametrize("rgb, name", [
    ((1, 1, 0), "yellow"), ((1, 0, 0), "red"), ((0, 1, 0), "green"), ((0, 0, 1), "blue"), ((0, 0, 0), "black"),
    ((1, 1, 1), "white"), ((0.7, 0.7, 0.7), "grey"), ((1, 0, 0.05), "red"), ((1, 0.5, 0), "orange")])
def test_colors_have_their_common_names(rgb, name):
    assert colour_name(Color(r=rgb[0], g=rgb[1], b=rgb[2])) == name and name in NAMES


def test_selected_object_is_followed_and_not_replaced():
    here = find_contours(picture((20, 20, 30, 30, RED), (80, 60, 20, 20, BLUE)), SEED)
    following = ContourTracker(OutlineSelect())
    chosen, said = following.find(here)
    assert colour_name(here[chosen].color) == "red" and not said
    moved = find_contours(picture((25, 22, 30, 30, RED), (80, 60, 20, 20, BLUE), (100, 5, 50, 50, GREEN)), SEED)
    assert colour_name(moved[following.find(moved)[0]].color) == "red"
    hidden = find_contours(picture((80, 60, 20, 20, BLUE), (100, 5, 50, 50, GREEN)), SEED)
    assert following.find(hidden)[0] == -1 and "not seen any more" in following.find(hidden)[1]
    assert colour_name(moved[following.find(moved)[0]].color) == "red"


def test_selection_without_match_is_retried_and_a_rejected_one_changes_nothing():
    following = ContourTracker(OutlineSelect(rule="colour", colour="blue"))
    assert following.find(find_contours(picture((20, 20, 30, 30, RED)), SEED))[0] == -1
    both = find_contours(picture((20, 20, 30, 30, RED), (80, 60, 20, 20, BLUE)), SEED)
    assert colour_name(both[following.find(both)[0]].color) == "blue"
    with pytest.raises(NoSuchContour):
        following.select(both, OutlineSelect(rule="index", index=9))
    assert colour_name(both[following.find(both)[0]].color) == "blue"
    assert ContourTracker(None).find(both) == (-1, f"no object is chosen; choices: {described(both)}")


def test_annotation_draws_the_selected_contour_on_a_copy():
    drawn = picture((20, 20, 60, 60, RED), (100, 60, 20, 20, BLUE))
    before = drawn.copy()
    contours = find_contours(drawn, SEED)
    red = choose(contours, OutlineSelect())
    shown = annotate_contours(drawn, contours, red.index)
    np.testing.assert_array_equal(drawn, before)
    assert (shown == CHOSEN).all(axis=2).sum() > 200
    assert cv2.absdiff(shown, drawn)[62:78, 102:118].any() or cv2.absdiff(shown, drawn)[55:85, 90:130].any()
