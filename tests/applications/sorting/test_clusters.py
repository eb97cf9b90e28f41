"""Objects on the surface: one or several, where, of what size, shape and color, and with stable ids."""

import math

import numpy as np
import pytest

from applications.sorting.clusters import Identities, find_objects
from applications.sorting.seeing import surface_of
from tests.applications.sorting.scenes import (
    BLUE,
    FLOOR,
    GREEN,
    GREY,
    PURPLE,
    RED,
    YELLOW,
    angle_piece,
    area,
    box,
    found_in,
    ring,
    sphere,
    surface_with,
    tray_world,
    view_of,
)

CUBE = (0.04, 0.04, 0.04)
SCENES = {
    "two touching cubes of two colors": ([box(0.53, 0, CUBE, RED), box(0.57, 0, CUBE, BLUE)], 2),
    "two touching spheres of one color": ([sphere(0.53, 0, 0.025, GREY), sphere(0.58, 0, 0.025, GREY)], 2),
    "a low and a high box of one color": (
        [box(0.53, 0, (0.05, 0.05, 0.03), GREEN), box(0.58, 0, (0.05, 0.05, 0.06), GREEN)], 2),
    "two cubes apart": ([box(0.50, 0, CUBE, RED), box(0.60, 0.05, CUBE, RED)], 2),
    "an L": ([angle_piece(0.5, -0.05, 0.08, PURPLE)], 1),
    "a ring": ([ring(0.55, 0.0, 0.04, 0.02, 0.02, YELLOW)], 1),
    "a long box": ([box(0.55, 0.0, (0.12, 0.02, 0.02), RED, 0.7)], 1),
    "a flat box": ([box(0.55, 0.0, (0.06, 0.05, 0.008), BLUE, 0.3)], 1),
    "a box at the wall": ([box(0.50, 0.177, (0.08, 0.03, 0.03), RED)], 1),
    "a box in the corner": ([box(0.717, -0.177, (0.04, 0.03, 0.03), BLUE)], 1),
    "a cube upon a larger box": (
        [box(0.55, 0.0, (0.09, 0.09, 0.03), GREEN), box(0.55, 0.0, CUBE, RED, z=FLOOR + 0.03)], 2),
    "a small label on a box": (
        [box(0.55, 0.0, (0.08, 0.08, 0.05), GREEN), box(0.55, 0.0, (0.02, 0.02, 0.0005), RED, z=FLOOR + 0.05)], 1),
    "an empty tray": ([], 0),
}


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("name", SCENES)
def test_number_of_objects(name, seed):
    meshes, count = SCENES[name]
    labels, found = found_in(meshes, seed)
    assert len(found) == count, [(seen.center, seen.size, seen.why) for seen in found]
    assert set(np.unique(labels)) == set(range(count + 1))


@pytest.mark.parametrize(("x", "y"), [(0.66, 0.12), (0.66, -0.12), (0.44, 0.12), (0.44, -0.12)])
def test_position_size_and_yaw_of_a_box(x, y):
    _, (seen,) = found_in([box(x, y, (0.08, 0.04, 0.03), RED, 0.5)])
    assert (seen.center.x, seen.center.y) == pytest.approx((x, y), abs=0.003)
    assert (seen.size.x, seen.size.y) == pytest.approx((0.08, 0.04), abs=0.008)
    assert math.remainder(seen.yaw - 0.5, math.pi) == pytest.approx(0, abs=0.06)
    assert (seen.top, seen.bottom) == pytest.approx((FLOOR + 0.03, FLOOR), abs=0.003)
    assert seen.volume == pytest.approx(0.08 * 0.04 * 0.03, rel=0.25)


@pytest.mark.parametrize(("mesh", "shape", "color"), [
    (sphere(0.55, 0.0, 0.03, RED), "round", "red"),
    (box(0.60, 0.1, (0.06, 0.04, 0.04), GREEN, 0.4), "box", "green"),
    (box(0.50, 0.0, (0.12, 0.03, 0.03), BLUE, 1.0), "long", "blue"),
    (ring(0.55, -0.1, 0.04, 0.02, 0.02, YELLOW), "ring", "yellow"),
    (box(0.55, 0.0, (0.07, 0.06, 0.01), PURPLE, 0.2), "flat", "purple"),
    (angle_piece(0.5, 0.0, 0.08, GREY), "other", "grey"),
])
@pytest.mark.parametrize("light", [(1.0, 1.0, 1.0), (0.7, 0.7, 0.7), (0.75, 0.9, 1.0)])
def test_shape_and_color_name_in_different_light(mesh, shape, color, light):
    depth, image, camera = view_of([mesh])
    lit = np.clip(image * np.array(light), 0, 255).astype(np.uint8)
    _, (seen,) = find_objects(surface_of([(depth, lit, camera)], area(), floor=FLOOR), tray_world())
    assert (seen.shape, seen.color_name) == (shape, color)


def test_ring_keeps_its_hole():
    labels, _ = found_in([ring(0.55, 0.0, 0.04, 0.02, 0.02, YELLOW)])
    surface = surface_with([])
    row, column = surface.cells((0.55, 0.0))
    assert labels[row, column] == 0
    assert labels[tuple(surface.cells((0.58, 0.0)))] == 1


@pytest.mark.parametrize(("mesh", "place"), [
    (box(0.45, 0.38, CUBE, GREEN), "left"), (box(0.47, -0.42, CUBE, GREEN), "right"),
    (box(0.68, 0.28, CUBE, GREEN, z=0.0), "table"), (box(0.55, 0.1, CUBE, GREEN), "tray"),
])
def test_place_of_an_object(mesh, place):
    _, (seen,) = found_in([mesh])
    assert seen.place == place


def test_object_that_touches_the_wall_says_so():
    _, (seen,) = found_in([box(0.50, 0.177, (0.08, 0.03, 0.03), RED)])
    assert "touches the wall" in seen.why and seen.confidence < 1


def test_ids_stay_with_objects_that_did_not_move():
    first = [box(0.50, 0, CUBE, RED), box(0.62, 0.05, CUBE, BLUE), sphere(0.45, -0.1, 0.03, GREEN)]
    moved = [first[0], box(0.62, -0.12, CUBE, BLUE), first[2]]
    ids = Identities()
    before = {seen.color_name: seen.id for seen in ids.named(found_in(first, 1)[1])}
    after = {seen.color_name: seen.id for seen in ids.named(found_in(moved, 2)[1])}
    assert after["red"] == before["red"] and after["green"] == before["green"]
    assert after["blue"] not in before.values()


@pytest.mark.parametrize("images", [30, pytest.param(200, marks=pytest.mark.campaign)])
def test_empty_tray_shows_no_object_in_noisy_images(images):
    wrong = [seed for seed in range(images) if found_in([], seed)[1]]
    assert wrong == []
