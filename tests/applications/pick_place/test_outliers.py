"""Red objects that are no balls on the table are reported: cubes, cables, discs, stacked balls."""

import math
from itertools import product

import cv2
import numpy as np
import pytest

from applications.pick_place.detections import Validation
from applications.pick_place.detector import Detector, DetectorOptions
from applications.pick_place.outliers import COVERED, FLAT, NOT_ROUND, THIN
from common.config import CameraConfig
from common.perception.pinhole import Pinhole, silhouettes
from services.vision_detector import _remark, markers
from tests.applications.pick_place.rendered import AROUND, CAMERA, SIDE, ball, camera_of, picture, red
from tests.simulated.visited import SimulatedCell

PLACES = [(0.40, 0.0), (0.50, -0.10), (0.30, 0.20), (0.60, -0.30), (0.20, -0.35)]
OTHERS = [(0.25, -0.10), (0.62, 0.05), (0.15, 0.10)]
VIEWS = pytest.mark.parametrize("around", [AROUND, SIDE], ids=["above", "side"])


def sampled(every, *axes):
    """Combinations of which each n-th is tested always and the others in a campaign."""
    return [case if k % every == 0 else pytest.param(*case, marks=pytest.mark.campaign)
            for k, case in enumerate(product(*axes))]


def look(*things, others=True, around=AROUND):
    """Return a detector that processed these, with or without other balls, and found only the others."""
    detector, nearby = Detector(around), OTHERS if others else []
    found = detector.detect(picture([*things, *(ball(x, y) for x, y in nearby)], around), camera_of(around))
    assert len(found) == len(nearby), found
    assert all(min(math.dist(one.position[:2], place) for place in OTHERS) < 0.003 for one in found)
    return detector


def cube(place, side):
    return red("box", (*place, side / 2), (side, side, side))


def cable(place, width, length):
    return red("cylinder", (*place, width / 2), (width, width, length), roll=math.pi / 2)


def disc(place, diameter):
    return red("cylinder", (*place, 0.0005), (diameter, diameter, 0.001))


@pytest.mark.parametrize(("place", "others", "side"), sampled(7, PLACES, [True, False], [0.045, 0.05, 0.06]))
def test_cube_is_detected_by_its_outline(place, side, others):
    outliers = look(cube(place, side), others=others).outliers
    assert {one.reason for one in outliers} == {NOT_ROUND} and math.dist(outliers[0].position[:2], place) < 0.03


@pytest.mark.parametrize("place", [(0.30, 0.455), (0.44, 0.455), (0.74, -0.08), (0.06, -0.12)])
def test_cube_cut_by_the_border_is_detected_by_its_outline(place):
    outliers = look(cube(place, 0.07)).outliers
    assert {one.reason for one in outliers} == {NOT_ROUND}
    assert min(math.dist(one.position[:2], place) for one in outliers) < 0.06


@pytest.mark.parametrize(("thing", "others", "reason"), [
    *((cable(place, 0.02, 0.2), True, NOT_ROUND) for place in PLACES[:3]),
    *((disc(place, 0.06), False, FLAT) for place in ((0.60, -0.30), (0.20, -0.35))),
    (disc((0.62, -0.25), 0.0624), False, FLAT),  # as large in the image as a ball
    (disc((0.40, 0.0), 0.06), True, "smaller than a ball on the table"),  # below the camera
])
def test_cable_and_disc_are_detected_by_their_shape_or_size(thing, others, reason):
    outliers = look(thing, others=others).outliers
    assert outliers and all(reason in one.reason for one in outliers)


@pytest.mark.slow
@VIEWS
def test_thin_cable_is_reported_next_to_balls(around):
    for width, place in product((0.004, 0.006, 0.008), PLACES[::2]):
        nearby = [ball(x, y) for x, y in OTHERS if math.dist((x, y), place) > 0.17]
        detector = Detector(around)
        image = picture([cable(place, width, 0.25), *nearby], around)
        assert len(detector.detect(image, camera_of(around))) == len(nearby)
        assert [one.reason for one in detector.outliers] in ([THIN], [NOT_ROUND] * (width > 0.006)), (width, place)
        assert math.dist(detector.outliers[0].position[:2], place) < 0.06


def test_red_noise_is_no_cable():
    rng = np.random.default_rng(5)
    image = picture([ball(x, y) for x, y in OTHERS])
    for share in (0.01, 0.1, 0.3, 0.7):
        noisy = image.copy()
        noisy[rng.random(image.shape[:2]) < share] = (20, 20, 200)
        detector = Detector(AROUND)
        detector.detect(noisy, CAMERA)
        assert THIN not in {one.reason for one in detector.outliers}


@VIEWS
@pytest.mark.parametrize(("place", "others", "height"), sampled(7, PLACES, [True, False], [0.079, 0.09]))
def test_ball_on_top_of_something_looks_too_large(around, place, height, others):
    outliers = look(ball(*place, height), others=others, around=around).outliers
    assert len(outliers) == 1 and "larger than a ball on the table: it lies higher" in outliers[0].reason


@VIEWS
@pytest.mark.parametrize(("place", "others"), sampled(4, PLACES, [True, False]))
def test_no_ball_of_a_stack_is_offered(around, place, others):
    outliers = look(ball(*place), ball(*place, 0.09), others=others, around=around).outliers
    assert outliers and all(marker.text for marker in markers([], around, 1, odd=outliers).markers)
    if around is SIDE:
        assert sorted("it lies higher" in one.reason for one in outliers) == [False, True]
        assert any(math.dist(one.position[:2], place) < 0.01 for one in outliers), "the lower one"


@pytest.mark.slow
@pytest.mark.parametrize("gap", [0.0, 0.006])
def test_three_balls_are_offered_only_without_one_on_top(gap):
    away = (0.06 + gap) / math.sqrt(3)
    for place, turn in zip(PLACES, (0.0, 0.7, 0.0, 0.7, 0.35), strict=True):
        at = [complex(*place) + away * np.exp(1j * (turn + third * math.tau / 3)) for third in range(3)]
        lower, top = [ball(z.real, z.imag) for z in at], ball(*place, 0.03 + math.sqrt(0.06**2 - away**2))
        assert len(Detector(AROUND).detect(picture(lower), CAMERA)) == 3, (place, turn)
        detector = Detector(AROUND)
        assert detector.detect(picture([*lower, top]), CAMERA) == [], (place, turn)
        assert {one.reason for one in detector.outliers} == {COVERED}


@pytest.mark.parametrize("blur", [0.6, 1.3])
def test_three_touching_balls_are_offered_in_a_blurred_image(blur):
    away = 0.06 / math.sqrt(3)
    at = [0.30 + 0.20j + away * np.exp(1j * third * math.tau / 3) for third in range(3)]
    places = np.array([(z.real, z.imag, 0.03) for z in at] + [(x, y, 0.03) for x, y in OTHERS[:2]])
    image = np.full((CAMERA.height, CAMERA.width, 3), 40, np.uint8)
    for outline in silhouettes(CAMERA, places, 0.03, 64):
        cv2.fillConvexPoly(image, np.rint(outline).astype(np.int32), (25, 35, 200))
    detector = Detector(AROUND, DetectorOptions(outline_offset_px=1.0))
    assert len(detector.detect(cv2.GaussianBlur(image, (0, 0), blur), CAMERA)) == len(places), detector.outliers


@pytest.mark.slow
@VIEWS
@pytest.mark.parametrize(("others", "turns"), [
    (True, 4), (False, 3), *(pytest.param(others, 12, marks=pytest.mark.campaign) for others in (True, False))])
def test_touching_balls_are_no_stack(around, others, turns):
    detector = Detector(around)
    touching = [(0.45, -0.30), (0.51, -0.30), (0.48, -0.248), (0.45, -0.19)]
    for turn in np.linspace(0, 2 * math.pi, turns, endpoint=False):
        about = complex(0.48, -0.26)
        turned = [about + (complex(*place) - about) * np.exp(1j * turn) for place in touching]
        balls = [ball(z.real, z.imag) for z in turned] + [ball(x, y) for x, y in OTHERS[1:] if others]
        assert len(detector.detect(picture(balls, around), camera_of(around))) == len(balls)
        assert detector.outliers == []


@pytest.mark.parametrize(("wider", "higher"), [
    ([0.45] * 4, [-0.45] * 4), ([-0.45] * 4, [0.45] * 4), ([0.41, 0, 0, 0], [0.41, 0, 0, 0])])
def test_outline_tolerance_in_pixels_is_independent_of_distance(wider, higher):
    """Light and noise move outlines by some tenths of a pixel."""
    camera, fine = camera_of(SIDE), 8
    places = [(0.10, -0.40), (0.10, 0.10), (0.20, -0.20), (0.60, -0.10)]
    image = np.full((camera.height * fine, camera.width * fine, 3), 40, np.uint8)
    drawn = silhouettes(camera, np.array([(x, y, 0.03) for x, y in places]), 0.03, 64)
    for outline, *more in zip(drawn, wider, higher, strict=True):
        away = outline - outline.mean(axis=0)
        moved = outline + away / np.abs(away).max(axis=0) * more
        cv2.fillConvexPoly(image, np.rint((moved + 0.5) * fine - 0.5).astype(np.int32), (25, 35, 200))
    detector = Detector(SIDE)
    image = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    found = detector.detect(image, camera)
    assert len(found) == len(places), detector.outliers
    assert all(min(math.dist(one.position[:2], place) for one in found) < 0.003 for place in places)


@pytest.mark.parametrize("places", [
    [(0.544, 0.265), (0.514, 0.21), (0.579, 0.216)], [(0.552, 0.273), (0.539, 0.214)]])
def test_ball_leaning_on_the_wall_carries_no_phantom_ball(places):
    assert len(Detector(AROUND).detect(picture([ball(x, y, 0.035) for x, y in places]), CAMERA)) == len(places)


@pytest.mark.parametrize(("diameter", "below", "place"), [(0.07, 0.0, 0), (0.1, 0.0, 1), (0.06, 0.17, 0)])
def test_much_larger_blob_is_counted_as_too_large(diameter, below, place):
    usual = look()
    assert usual.too_large == 0 and _remark(usual, "eye") == ""
    detector = look(red("sphere", (*PLACES[place], below + diameter / 2), (diameter, diameter, diameter)))
    assert detector.too_large == 1 and detector.outliers == []
    assert _remark(detector, "eye") == "1 round red thing looks much larger than a ball on the table"


@pytest.mark.parametrize("depth", [None, 1.5])
@pytest.mark.parametrize("height", [40, 100])
def test_red_object_above_the_horizon_is_ignored(height, depth):
    camera = Pinhole.from_config(CameraConfig(position=(-1.0, 0.0, 0.6), rpy=(-math.pi / 2 - 0.2, 0.0, -math.pi / 2)))
    image = np.full((camera.height, camera.width, 3), 128, np.uint8)
    cv2.rectangle(image, (280, height - 20), (380, height + 20), (0, 0, 255), -1)
    detector = Detector(AROUND)
    if depth is None:
        found = detector.detect(image, camera)
    else:
        found = detector.detect_in_depth(image, np.full(image.shape[:2], depth, np.float32), camera)
    assert found == [] and markers(found, AROUND, 0, odd=detector.outliers).markers == []


def test_outlier_is_rejected_once_with_the_detectors_reason():
    class Reachable:
        def known(self, _place):
            return ""

    detector = look(red("box", (0.5, -0.1, 0.03), (0.06, 0.06, 0.06)))
    validation = Validation(AROUND, Reachable())
    reported = []
    for k in range(10):
        verdict = validation.validate(markers([], AROUND, 1 + k * 100_000_000, odd=detector.outliers), CAMERA)
        assert verdict.targets == [] and [why for _, why in verdict.refused] == [NOT_ROUND]
        reported.append([one.reason for one in verdict.rejections])
    assert [reasons for reasons in reported if reasons] == [[NOT_ROUND]] and reported[0] == [], "after a debounce time"


@pytest.mark.slow
def test_cell_takes_the_ball_and_reports_the_cube():
    objects = ("world.objects=[{id: ball_1, shape: sphere, radius: 0.03, x: 0.5, y: -0.2, color: [1.0, 0.15, 0.1]}, "
               "{id: cube, shape: box, size: [0.05, 0.05, 0.05], x: 0.45, y: 0.05, color: [1.0, 0.15, 0.1]}]")
    summary = SimulatedCell("panda", [objects, "world.count=0", "services.smart_pick_place.grace=1.0"]).summary
    assert (summary["state"], summary["placed"]) == ("DONE", 1), summary
    assert [one["reason"] for one in summary["rejected"]] == [NOT_ROUND]
    assert (summary["truth"]["in_box"], summary["truth"]["on_table"]) == (1, 1)
