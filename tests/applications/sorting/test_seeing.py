"""The surface from above: heights, holes, position and orientation of the axes."""

import numpy as np
import pytest

from applications.sorting.places import hidden_fraction, tray_of
from applications.sorting.seeing import crop, denoised, surface_of
from tests.applications.sorting.scenes import (
    BLUE,
    EXACT,
    FLOOR,
    GREEN,
    NOISE,
    RED,
    area,
    box,
    camera,
    surface_with,
    tray_world,
    view_of,
)

TOLERANCE = 0.002  # [m]


@pytest.mark.parametrize("noise", [EXACT, NOISE], ids=["exact", "noisy"])
@pytest.mark.parametrize(("x", "y"), [(0.55, 0.0), (0.68, 0.13), (0.42, -0.13)])
@pytest.mark.parametrize("height", [0.02, 0.05, 0.09])
def test_median_height_of_a_box_is_within_two_millimeters(noise, x, y, height):
    surface = surface_with([box(x, y, (0.05, 0.05, height), RED)], noise=noise)
    top, _ = crop(surface, (x - 0.018, y - 0.018, x + 0.018, y + 0.018))
    assert abs(np.median(top.top) - FLOOR - height) < TOLERANCE
    assert np.mean(np.abs(top.top - FLOOR - height) < TOLERANCE) > 0.8


@pytest.mark.parametrize(("x", "y"), [(0.67, 0.12), (0.67, -0.12), (0.43, 0.12), (0.43, -0.12)])
def test_object_is_at_its_own_position_and_not_mirrored(x, y):
    surface = surface_with([box(x, y, (0.04, 0.04, 0.04), BLUE)])
    inside, _ = crop(surface, tray_of(tray_world(), "tray", "tray").area(-0.02))
    rows, columns = np.nonzero(inside.top > FLOOR + 0.03)
    assert inside.xy(rows, columns).mean(axis=0) == pytest.approx((x, y), abs=0.003)
    blue, green, red = np.median(inside.color[rows, columns], axis=0)
    assert blue > 2 * red and blue > 2 * green


def test_floor_is_flat_and_fully_measured():
    surface = surface_with([])
    floor, _ = crop(surface, tray_of(tray_world(), "tray", "tray").area(-0.02))
    assert np.isfinite(floor.top).all()
    assert np.percentile(np.abs(floor.top - FLOOR), 99) < 0.004


def test_occluded_floor_is_unknown_and_reported():
    tray = tray_of(tray_world(), "tray", "tray")
    low, high = surface_with([]), surface_with([box(0.68, 0.12, (0.06, 0.06, 0.12), RED)])
    assert hidden_fraction(low, tray) < 0.005
    assert hidden_fraction(high, tray) > hidden_fraction(low, tray) + 0.005


def test_narrow_gaps_take_the_lower_height_and_wide_ones_stay_unknown():
    depth, image, lens = view_of([box(0.55, 0.0, (0.06, 0.06, 0.05), GREEN)], noise=EXACT)
    u, v = np.rint(lens.project([0.55, 0.0, FLOOR + 0.05])).astype(int)
    depth[v - 12:v + 12, u + 13:u + 16] = np.nan  # across the edge of the box, 6 mm wide
    depth[v + 60:v + 90, u + 60:u + 90] = np.nan  # on the floor, 60 mm wide
    surface = surface_of([(depth, image, lens)], area())
    box_edge, _ = crop(surface, (0.53, -0.05, 0.57, 0.05))
    assert np.isfinite(box_edge.top).all()
    assert np.isnan(surface.top).sum() - np.isnan(surface_of([view_of([], noise=EXACT)], area()).top).sum() > 500


def test_point_between_two_surfaces_is_dropped():
    depth = np.full((camera().height, camera().width), 0.9, np.float32)
    depth[:, 300:] = 0.8
    depth[:, 300] = 0.85
    clean = denoised(depth)
    assert not np.any((clean > 0.81) & (clean < 0.89))


def test_views_of_two_cameras_are_fused():
    first, second = (view_of([box(0.55, 0.0, (0.05, 0.05, 0.05), RED)], seed) for seed in (1, 2))
    first[0][:, :320], second[0][:, 320:] = np.nan, np.nan
    whole = surface_of([first, second], area())
    assert np.isnan(whole.top).mean() < np.isnan(surface_of([first], area()).top).mean() - 0.3


@pytest.mark.parametrize("bad", [(0.5, 0.5, 0.5, 0.5), (0.6, 0.0, 0.5, 0.1), (0, 0, 100, 100)])
def test_empty_or_huge_area_is_refused(bad):
    with pytest.raises(ValueError, match="cells"):
        surface_of([view_of([])], bad)
