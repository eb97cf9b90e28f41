"""Images of known layouts in, positions out: every ball counted once, every complete one within 3 mm."""

import math
from unittest.mock import patch

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from applications.pick_place.detector import Detector, DetectorOptions, annotate, warm_up
from common.config import Container, Surroundings
from common.perception.pinhole import Pinhole, ray_distances, silhouette, sphere_in_view
from common.robot.transforms import rpy_to_matrix, transform
from tests.common.sim.spheres import draw_spheres

around = Surroundings(container=Container())
camera = Pinhole.from_config(around.camera)
DETECT = Detector.detect
detector = Detector(around)
TOUCHING, UP = 0.06, 0.06 * math.sqrt(3) / 2  # distance of touching balls, and height of their triangle [m]
LOW, HIGH = (0.08, -0.43), (0.72, 0.43)  # with a pixel to spare to the border of the image
RED = (26, 38, 255)
IMAGES = pytest.mark.parametrize(("noise", "brightness", "rim"), [
    (8, 20, 2), (0, 0, 0), *(pytest.param(*one, marks=pytest.mark.campaign) for one in
                             ((0, 0, 2), (8, -20, 2), (8, 0, 0)))])


def on_table(points):
    points = np.array(points, dtype=float).reshape(-1, 2)
    return np.column_stack([points, np.full(len(points), 0.03)])


def moved_into_view(shape, rng):
    """Return the shape, turned and moved at random, completely in view."""
    angle = rng.uniform(0, 2 * math.pi)
    shape = np.array(shape) @ np.array([(math.cos(angle), math.sin(angle)), (-math.sin(angle), math.cos(angle))])
    while True:
        balls = on_table(shape - shape.mean(axis=0) + rng.uniform(LOW, HIGH))
        if all(sphere_in_view(camera, ball, 0.03) for ball in balls):
            return balls


def random_layout(rng, low=LOW, high=HIGH):
    points = []
    count = rng.integers(1, 9)
    while len(points) < count:
        point = rng.uniform(low, high)
        if all(math.dist(point, other) >= TOUCHING for other in points):
            points.append(point)
    return on_table(points)


def chain(rng):
    points = [np.zeros(2)]
    while len(points) < 5:
        angle = rng.uniform(-1, 1)
        point = points[-1] + TOUCHING * np.array((math.cos(angle), math.sin(angle)))
        if all(math.dist(point, other) >= TOUCHING - 1e-9 for other in points):
            points.append(point)
    return points


HEXAGON = [(TOUCHING * math.cos(a), TOUCHING * math.sin(a)) for a in np.arange(6) * math.pi / 3]
CLUSTERS = {
    "pair": lambda _: [(0, 0), (TOUCHING, 0)],
    "chain": chain,
    "row of four": lambda _: [(TOUCHING * i, 0) for i in range(4)],
    "triangle": lambda _: [(0, 0), (TOUCHING, 0), (TOUCHING / 2, UP)],
    "square": lambda _: [(0, 0), (TOUCHING, 0), (0, TOUCHING), (TOUCHING, TOUCHING)],
    "rhombus": lambda _: [(0, 0), (TOUCHING, 0), (TOUCHING / 2, UP), (1.5 * TOUCHING, UP)],
    "block of five": lambda rng: rng.uniform(0.065, 0.07) * np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)]),
    "seven close together": lambda _: [(0, 0), *HEXAGON],
}


def check(balls, picture, *, within=0.003, view=camera):
    """Check that each ball is found once within a distance [m] and is not marked partial."""
    found = detector.detect(picture, view)
    places = np.array([d.position[:2] for d in found]).reshape(-1, 2)
    taken = set()
    for ball in balls:
        distances = np.linalg.norm(places - ball[:2], axis=1)
        best = int(distances.argmin())
        assert distances[best] < within, f"ball at {ball} is {distances[best] * 1e3:.1f} mm off"
        assert not found[best].partial
        taken.add(best)
    assert len(taken) == len(balls) == len(found)
    return found


@IMAGES
def test_every_ball_of_random_layouts_is_found_within_a_millimeter(noise, brightness, rim):
    rng = np.random.default_rng(1)
    for _ in range(8):
        balls = random_layout(rng)
        check(balls, draw_spheres(
            balls, camera, around, noise_std=noise, brightness=brightness, rng=rng, rim_width=rim), within=0.001)


@IMAGES
@pytest.mark.parametrize("name", CLUSTERS)
@pytest.mark.slow
def test_touching_balls_are_separated(name, noise, brightness, rim):
    # Without rims nothing in the image shows the ball in the middle of seven.
    rng, rim = np.random.default_rng(2), 2 if name == "seven close together" else rim
    for _ in range(5):
        balls = moved_into_view(CLUSTERS[name](rng), rng)
        image = draw_spheres(balls, camera, around, noise_std=noise, brightness=brightness, rng=rng, rim_width=rim)
        check(balls, image)


@pytest.mark.parametrize("name", ["block of five", "triangle"])
def test_touching_balls_are_separated_in_a_blurred_image(name):
    rng = np.random.default_rng(5)
    balls = moved_into_view(CLUSTERS[name](rng), rng)
    check(balls, cv2.GaussianBlur(draw_spheres(balls, camera, around, noise_std=4, rng=rng, rim_width=0), (0, 0), 1.0))


@given(st.integers(0, 2**32 - 1))
def test_any_layout_without_overlap_is_found(seed):
    rng = np.random.default_rng(seed)
    balls = random_layout(rng)
    check(balls, draw_spheres(balls, camera, around, noise_std=rng.choice([0, 8]), rng=rng))


def test_balls_cut_by_the_border_are_marked_partial():
    rng, partial = np.random.default_rng(3), 0
    for _ in range(20):
        balls = random_layout(rng, (-0.02, -0.55), (0.82, 0.55))
        found = detector.detect(draw_spheres(balls, camera, around, rng=rng), camera)
        places = np.array([d.position[:2] for d in found]).reshape(-1, 2)
        for d, place in zip(found, places, strict=True):
            assert np.linalg.norm(balls[:, :2] - place, axis=1).min() < 0.012, "there is a ball wherever one is seen"
            partial += d.partial
        for ball in balls:
            distances = np.linalg.norm(places - ball[:2], axis=1)
            if sphere_in_view(camera, ball, 0.03, margin=1.5):
                assert distances.min() < 0.003 and not found[int(distances.argmin())].partial
            elif not sphere_in_view(camera, ball, 0.03, margin=-0.5) and len(places):
                assert distances.min() > 0.02 or found[int(distances.argmin())].partial
    assert partial > 8


def contained(count, order):
    c, offsets = around.container, (-around.container.slot_offset, around.container.slot_offset)
    slots = [np.array((c.x + dx, c.y + dy, c.floor_thickness + 0.03 + 0.06 * layer))
             for layer in range(2) for dx in offsets for dy in offsets]
    return np.array([slots[i] for i in order[:count]] + [slots[4 + i] for i in order[: max(0, count - 4)]])


def is_uncovered(ball, balls):
    """Whether no ball nearer to the camera covers any of a ball's silhouette."""
    rays = camera.directions(np.concatenate([silhouette(camera, ball, r, 60) for r in (0.0299, 0.02, 0.01)]))
    distance = np.linalg.norm(ball - camera.position)
    nearer = [b for b in balls if np.linalg.norm(b - camera.position) < distance - 1e-9]
    return not nearer or bool((ray_distances(rays, np.array(nearer) - camera.position)[0] > 0.03).all())


@pytest.mark.parametrize("count", range(1, 9))
def test_uncovered_balls_in_the_container_are_found_at_their_positions(count):
    rng = np.random.default_rng(count)
    for noise in (0, 8):
        balls = contained(count, rng.permutation(4))
        found = detector.detect(draw_spheres(balls, camera, around, noise_std=noise, rng=rng), camera)
        pixels, truth = np.array([d.pixel for d in found]), camera.project(balls)
        uncovered = [i for i, ball in enumerate(balls) if is_uncovered(ball, balls)]
        assert uncovered and len(uncovered) <= len(found) <= count
        assert all(np.linalg.norm(pixels - truth[i], axis=1).min() < 3 for i in uncovered)
        assert all(np.linalg.norm(truth - pixel, axis=1).min() < 8 for pixel in pixels), "no false detection"
        for d in found:
            assert d.position == pytest.approx((*camera.on_plane(d.pixel, 0.03), 0.03), abs=1e-9)


def test_ball_in_the_air_is_not_detected_on_the_table():
    for z in np.arange(0.16, 0.40, 0.03):
        assert detector.detect(draw_spheres([(0.5, -0.2, z)], camera, around), camera) == []


@pytest.mark.parametrize("count", [0, 7])
def test_ball_falling_into_the_container_is_not_detected_outside(count):
    c = around.container
    below = contained(count, range(4)) if count else np.empty((0, 3))
    for z in np.arange(0.10, 0.32, 0.04):
        for d in detector.detect(draw_spheres(np.vstack([below, (c.x, c.y, z)]), camera, around), camera):
            assert detector.resting.meets_container(*camera.ray(d.pixel))


def test_tilted_camera_gives_the_same_positions():
    T = transform(rpy_to_matrix(math.pi - 0.25, 0.1, -math.pi / 2 + 0.3), (0.35, -0.15, 0.85))
    tilted = Pinhole(540, 530, 330, 225, 640, 480, T)
    rng = np.random.default_rng(4)
    x, y = tilted.on_plane((300, 200), 0.03)
    balls = on_table([(x, y), (x + 0.06, y), (x - 0.06, y + 0.1), (x + 0.03, y - UP), (x - 0.1, y - 0.1)])
    assert all(sphere_in_view(tilted, ball, 0.03) for ball in balls)
    check(balls, draw_spheres(balls, tilted, around, noise_std=4, rng=rng), view=tilted)


@pytest.mark.parametrize(("make", "view"), [
    (lambda: draw_spheres([], camera, around), camera),
    (lambda: np.random.default_rng(0).integers(0, 256, (480, 640, 3), dtype=np.uint8), camera),
    (lambda: np.full((480, 640, 3), RED, np.uint8), camera),
    (lambda: cv2.rectangle(draw_spheres([], camera, around), (350, 100), (479, 219), RED, -1), camera),
    (lambda: np.full((1, 1, 3), RED, np.uint8), Pinhole(520, 520, 0, 0, 1, 1, camera.T_world_optical)),
], ids=["empty table", "noise", "all red", "red square", "smallest image"])
def test_image_without_a_ball_gives_no_detection(make, view):
    assert detector.detect(make(), view) == []


def test_color_windows_and_minimum_area_define_a_ball():
    picture = draw_spheres(on_table([(0.4, 0.0)]), camera, around)
    (only,) = detector.detect(picture, camera)
    assert 900 < only.area < 1300
    assert Detector(around, DetectorOptions(min_contour_area_px=only.area + 1)).detect(picture, camera) == []
    blue = around.model_copy(update={"ball_color": (0.1, 0.2, 1.0)})
    picture = draw_spheres(on_table([(0.4, 0.0)]), camera, blue)
    assert detector.detect(picture, camera) == []
    options = DetectorOptions(hsv_red_lo1=(110, 120, 80), hsv_red_hi1=(130, 255, 255))
    assert len(Detector(blue, options).detect(picture, camera)) == 1


def test_annotation_draws_detections_on_a_copy():
    picture = draw_spheres(on_table([(0.5, -0.2), (0.4, 0.465)]), camera, around)
    before = picture.copy()
    found = sorted(detector.detect(picture, camera), key=lambda d: d.pixel[0])
    assert [d.partial for d in found] == [True, False]
    shown = annotate(picture, found)
    np.testing.assert_array_equal(picture, before)
    for d, color in zip(found, ((0, 200, 255), (0, 255, 0)), strict=True):
        u, v = (round(value) for value in d.pixel)
        assert tuple(shown[v, u].tolist()) == color


def test_same_image_of_another_camera_gives_other_positions():
    reused = Detector(around)
    moved = camera.T_world_optical.copy()
    moved[0, 3] += 0.1
    elsewhere = Pinhole(camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height, moved)
    picture = draw_spheres(on_table([(0.4, 0.1)]), camera, around)
    (here,), (there,) = (reused.detect(picture, seen_by) for seen_by in (camera, elsewhere))
    np.testing.assert_allclose(np.subtract(there.position, here.position), [0.1, 0.0, 0.0], atol=1e-6)


def test_modifying_the_input_or_result_has_no_effect():
    reused = Detector(around)
    picture = draw_spheres(on_table([(0.4, 0.1)]), camera, around)
    modified = picture.copy()
    reused.detect(modified, camera).clear()
    modified[:] = 0
    assert reused.detect(modified, camera) == []
    assert len(reused.detect(picture, camera)) == 1


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.campaign) for seed in (1, 2))])
def test_detections_are_independent_of_earlier_images(seed):
    rng = np.random.default_rng(seed)
    reused, total = Detector(around), 0
    balls = random_layout(rng)
    for _ in range(12):
        remaining = balls[rng.random(len(balls)) < 0.8]  # some are taken, others come, some of those touch
        balls = np.concatenate([remaining, random_layout(rng)[: rng.integers(0, 3)]])
        picture = draw_spheres(balls, camera, around)
        fresh = [(one.position, one.area) for one in Detector(around).detect(picture, camera)]
        for image in (picture, picture.copy()):
            assert [(one.position, one.area) for one in reused.detect(image, camera)] == fresh
        total += len(fresh)
    assert total > 12


@pytest.mark.parametrize("height", [-1.0, 0.0, 5.0])
def test_warm_up_works_for_any_table_height(height):
    found = []
    with patch.object(Detector, "detect", lambda self, picture, camera: found.append(DETECT(self, picture, camera))):
        warm_up(around.model_copy(update={"table_height": height}), DetectorOptions())
    assert [len(balls) for balls in found] == [3]
