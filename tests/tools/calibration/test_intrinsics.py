from dataclasses import replace

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


def collect(poses, lens=LENS, board=BOARD, **options):
    collector = ViewSelector(board, CollectingOptions(**options))
    for k, T in enumerate(poses):
        collector.add(render(board, lens, T, seed=k), f"view {k}")
    return collector


@pytest.fixture(scope="module")
def views():
    collector = collect(many_poses(BOARD, 14))
    collector.require_enough()
    return collector.views


def as_file(size, k, d):
    return CameraFile(width=size[0], height=size[1], fx=k[0], fy=k[1], cx=k[2], cy=k[3], d=list(d))


def off(found, lens):
    """(n,) how far apart the rays of the two lenses are over the picture [px]."""
    u, v = np.meshgrid(np.linspace(20, lens.width - 20, 9), np.linspace(20, lens.height - 20, 7))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    a = as_file(found.size, found.k, found.d)
    b = as_file((lens.width, lens.height), (lens.fx, lens.fy, lens.cx, lens.cy), lens.d)
    rays = [(f.undistorted(pixels) - (f.cx, f.cy)) / (f.fx, f.fy) for f in (a, b)]
    return np.linalg.norm(rays[0] - rays[1], axis=1) * lens.fx


def test_intrinsics_are_found_within_a_thousandth_with_valid_uncertainty(views):
    found = calibrate_intrinsics(views)
    truth = np.array([LENS.fx, LENS.fy, LENS.cx, LENS.cy])
    np.testing.assert_allclose(found.k, truth, rtol=1e-3)
    assert found.size == (640, 480) and found.rms < 0.05
    assert (np.abs(np.array(found.k) - truth) < 5 * np.array(found.k_std)).all() and max(found.k_std) < 0.5
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
    np.testing.assert_allclose(found.k, (lens.fx, lens.fy, lens.cx, lens.cy), rtol=5e-3)
    assert len(found.d) == 5 and np.median(off(found, lens)) < 0.5
    rational = calibrate_intrinsics(views, CollectingOptions(k_coefficients=6))
    assert len(rational.d) == 8 and np.median(off(rational, lens)) < 0.5 and rational.rms < 0.05


def test_zero_coefficients_fit_only_the_matrix():
    lens = Lens(d=())
    found = calibrate_intrinsics(collect(many_poses(BOARD, 10), lens).views, CollectingOptions(k_coefficients=0))
    assert found.d == [] and found.rms < 0.05
    np.testing.assert_allclose(found.k, (lens.fx, lens.fy, lens.cx, lens.cy), rtol=2e-3)


def test_outlier_view_is_dropped_by_name(views):
    bent = replace(views[4], pixels=views[4].pixels + np.random.default_rng(3).normal(0, 3, views[4].pixels.shape))
    found = calibrate_intrinsics([*views[:4], bent, *views[5:]])
    assert [view.name for view in found.dropped] == [views[4].name] and found.dropped[0].rms > 1
    np.testing.assert_allclose(found.k, (LENS.fx, LENS.fy, LENS.cx, LENS.cy), rtol=1e-3)


def test_inconsistent_views_are_rejected(views):
    rng = np.random.default_rng(3)
    bad = [replace(v, pixels=v.pixels + rng.normal(0, 4, v.pixels.shape)) if k % 2 else v for k, v in enumerate(views)]
    with pytest.raises(CalibrationFailed, match=r"views fit together, 8 are needed; outliers: view \d+ \d"):
        calibrate_intrinsics(bad[:11])


def test_frontal_views_do_not_determine_the_focal_length():
    poses = [facing(BOARD, x, y, 0.6) for x in (-0.12, 0, 0.12) for y in (-0.07, 0, 0.07)]
    noisy = [replace(v, pixels=v.pixels + np.random.default_rng(k).normal(0, 0.3, v.pixels.shape))
             for k, v in enumerate(collect(poses).views)]
    with pytest.raises(CalibrationFailed, match=r"too similar: the focal length would be .* tilt the board"):
        calibrate_intrinsics(noisy)


def test_similar_view_is_not_added():
    collector = collect([facing(BOARD, 0, 0, 0.5), facing(BOARD, 0.005, 0, 0.5), facing(BOARD, 0.05, 0, 0.5)])
    assert [view.name for view in collector.views] == ["view 0", "view 2"]


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


def test_images_of_different_sizes_are_rejected():
    collector = collect([facing(BOARD, 0, 0, 0.5)])
    other = Lens(width=800, height=600, cx=400, cy=300)
    with pytest.raises(CalibrationFailed, match="big is 800x600, but view 0 is 640x480"):
        collector.add(render(BOARD, other, facing(BOARD, 0.1, 0, 0.5)), "big")


def test_coverage_names_regions_without_corners():
    part, unseen = coverage(collect([facing(BOARD, -0.12, -0.08, 0.6)]).views)
    assert 0 < part < 0.5 and "lower right" in unseen and "upper left" not in unseen
    assert coverage([])[0] == 0 and len(coverage([])[1]) == 9


def test_collection_ends_with_enough_views():
    collector = collect(many_poses(BOARD, 4), most_views=3, least_views=3)
    assert collector.complete
