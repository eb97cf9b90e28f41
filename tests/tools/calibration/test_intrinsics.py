from dataclasses import replace

import cv2
import numpy as np
import pytest

from common.perception.camera_file import CameraFile
from tests.tools.calibration.rendered_boards import BOARD, Lens, facing, many_poses, render
from tools.calibration.intrinsics import (
    CalibrationFailed,
    CollectingOptions,
    ViewSelector,
    calibrate_intrinsics,
    coverage,
)

LENS = Lens()


def truth(lens):
    return np.array([lens.fx, lens.fy, lens.cx, lens.cy])


def collect(poses, lens=LENS, board=BOARD, **options):
    collector = ViewSelector(board, CollectingOptions(**options))
    for k, T in enumerate(poses):
        collector.add(render(board, lens, T, seed=k), f"view {k}")
    return collector


def noisy(view, seed, sigma):
    return replace(view, pixels=view.pixels + np.random.default_rng(seed).normal(0, sigma, view.pixels.shape))


def computed(view, poses, lens, sigma):
    """Return views with all corners at their projected pixels, and noise."""
    views = [replace(view, name=f"view {k}", points=BOARD.corners, pixels=lens.project(T, BOARD.corners))
             for k, T in enumerate(poses)]
    return [noisy(view, k, sigma) for k, view in enumerate(views)]


@pytest.fixture(scope="module")
def views():
    collector = collect(many_poses(BOARD, 14))
    collector.require_enough()
    return collector.views


def off(found, lens):
    """Return the distances between the rays of two lenses over the image [px]."""
    u, v = np.meshgrid(np.linspace(20, lens.width - 20, 9), np.linspace(20, lens.height - 20, 7))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    fx, fy, cx, cy = found.k
    width, height = found.size
    camera = CameraFile(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, d=list(found.d))
    rays = [(each.undistorted(pixels) - (each.cx, each.cy)) / (each.fx, each.fy) for each in (camera, lens.camera())]
    return np.linalg.norm(rays[0] - rays[1], axis=1) * lens.fx


def test_intrinsics_are_found_within_a_thousandth_with_valid_uncertainty(views):
    found = calibrate_intrinsics(views)
    np.testing.assert_allclose(found.k, truth(LENS), rtol=1e-3)
    assert found.size == (640, 480) and found.rms < 0.05
    assert (np.abs(np.array(found.k) - truth(LENS)) < 5 * np.array(found.k_std)).all() and max(found.k_std) < 0.5
    np.testing.assert_allclose(found.d, LENS.d, atol=0.01)
    assert off(found, LENS).max() < 0.5
    assert [view.name for view in found.views] == [view.name for view in views] and not found.dropped
    assert all(0 < view.rms < 0.1 and view.corners >= 6 for view in found.views)
    assert found.corners == sum(len(view.points) for view in views)


@pytest.mark.slow
def test_wide_and_rational_lenses_need_more_coefficients():
    lens = Lens(fx=380, fy=381, cx=321, cy=238, d=(-0.32, 0.12, 0.0005, -0.0004, -0.02))
    views = collect(many_poses(BOARD, 10, z=(0.3, 0.5)), lens).views
    found = calibrate_intrinsics(views, CollectingOptions(k_coefficients=3))
    np.testing.assert_allclose(found.k, truth(lens), rtol=5e-3)
    assert len(found.d) == 5 and np.median(off(found, lens)) < 0.5
    rational = calibrate_intrinsics(views, CollectingOptions(k_coefficients=6))
    assert len(rational.d) == 8 and np.median(off(rational, lens)) < 0.5 and rational.rms < 0.05


def test_zero_coefficients_fit_only_the_matrix(views):
    lens = Lens(d=())
    ideal = computed(views[0], many_poses(BOARD, 10), lens, 0.02)
    found = calibrate_intrinsics(ideal, CollectingOptions(k_coefficients=0))
    assert found.d == [] and found.rms < 0.05
    np.testing.assert_allclose(found.k, truth(lens), rtol=2e-3)


def test_outlier_is_dropped_by_name_and_inconsistent_views_are_rejected(views):
    found = calibrate_intrinsics([*views[:4], noisy(views[4], 3, 3), *views[5:]])
    assert [view.name for view in found.dropped] == [views[4].name] and found.dropped[0].rms > 1
    np.testing.assert_allclose(found.k, truth(LENS), rtol=1e-3)
    bad = [noisy(view, k, 4) if k % 2 else view for k, view in enumerate(views[:11])]
    with pytest.raises(CalibrationFailed, match=r"views fit together, 8 are needed; outliers: view \d+ \d"):
        calibrate_intrinsics(bad)


def test_frontal_views_do_not_determine_the_focal_length(views):
    poses = [facing(BOARD, x, y, 0.6) for x in (-0.12, 0, 0.12) for y in (-0.07, 0, 0.07)]
    with pytest.raises(CalibrationFailed, match=r"too similar: the focal length would be .* tilt the board"):
        calibrate_intrinsics(computed(views[0], poses, LENS, 0.3))


def test_similar_views_are_not_added_and_collection_ends_with_enough():
    poses = [facing(BOARD, x, 0, 0.5) for x in (-0.05, -0.045, 0, 0.05)]
    collector = collect(poses, most_views=3, least_views=3)
    assert [view.name for view in collector.views] == ["view 0", "view 2", "view 3"]
    assert collector.complete


def test_too_few_views_report_why_images_were_rejected():
    collector = collect([facing(BOARD, 0, 0, 0.5)] * 2)
    collector.add(render(BOARD, LENS, facing(BOARD, 0.1, 0, 0.5), blur=3), "smeared")
    collector.add(np.full((480, 640, 3), 90, np.uint8), "empty")
    with pytest.raises(CalibrationFailed) as caught:
        collector.require_enough()
    line = str(caught.value)
    for part in ("1 of 4 images are usable", "7 x 5 squares of 36 mm", "8 are needed, 7 more", "1 are blurred",
                 "1 show no marker", "1 repeat an earlier pose"):
        assert part in line
    assert "\n" not in line


def test_images_of_the_most_frequent_size_are_used():
    collector = ViewSelector(BOARD)
    assert collector.add(cv2.resize(render(BOARD, LENS, facing(BOARD, 0.1, 0, 0.5)), (800, 600)), "big") == ""
    for x in (0.0, 0.1):
        assert collector.add(render(BOARD, LENS, facing(BOARD, x, 0, 0.5)), f"at {x}") == ""
    assert collector.rejections == "1 have another size"
    assert [view.size for view in collector.views] == [(640, 480)] * 2


def test_coverage_names_regions_without_corners():
    part, empty = coverage(collect([facing(BOARD, -0.12, -0.08, 0.6)]).views)
    assert 0 < part < 0.5 and "lower right" in empty and "upper left" not in empty
    assert coverage([])[0] == 0 and len(coverage([])[1]) == 9
