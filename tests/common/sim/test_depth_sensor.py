import numpy as np
import pytest

from common.config import CameraConfig
from common.perception.pinhole import Pinhole
from common.sim.depth_sensor import DepthSensorParameters, simulate_depth

CAMERA = Pinhole.from_config(CameraConfig(width=320, height=240, cx=159.5, cy=119.5))
BASELINE = 0.075
EXACT = {"disparity_noise": 0.0, "edge_noise": 0.0, "disparity_step": 0.0}


def plane(depth=0.8):
    return np.full((240, 320), depth, np.float32)


def step(near=0.5, far=0.8):
    depth = plane(far)
    depth[80:160, 150:200] = near
    return depth


def measured(depth, seed=0, baseline=BASELINE, **parameters):
    config = DepthSensorParameters(baseline=baseline, **parameters)
    return simulate_depth(depth, CAMERA, config, np.random.default_rng(seed))


def tilted(degrees, middle=1.0):
    """A plane turned about the vertical through the middle of the picture."""
    x = (np.arange(320) - CAMERA.cx) / CAMERA.fx
    with np.errstate(divide="ignore"):
        z = middle / (1 + x * np.tan(np.radians(degrees)))
    return np.tile(z.astype(np.float32), (240, 1))


def test_without_a_baseline_depth_is_as_it_is():
    depth = step()
    assert measured(depth, baseline=0.0) is depth


def test_steps_of_depth_grow_with_its_square():
    sizes = []
    for z in (0.5, 1.0, 2.0):
        seen = np.unique(measured(tilted(5.0, z), disparity_noise=0.0, edge_noise=0.0))
        size = np.diff(seen[np.isfinite(seen)]).mean()
        assert size == pytest.approx(0.125 * z**2 / (CAMERA.fx * BASELINE), rel=0.15)
        sizes.append(size)
    assert sizes == sorted(sizes)


def test_random_error_grows_with_the_square_of_depth():
    for z in (0.5, 1.0, 2.0):
        error = measured(plane(z), disparity_step=0.0, disparity_noise=0.1, edge_noise=0.0) - z
        assert np.nanstd(error) == pytest.approx(0.1 * z**2 / (CAMERA.fx * BASELINE), rel=0.05)
        assert abs(np.nanmean(error)) < 0.2 * np.nanstd(error)


@pytest.mark.parametrize("side", [1, -1])
def test_what_stands_before_something_has_a_shadow_on_the_side_away_from_the_projector(side):
    lost = np.isnan(measured(step(), baseline=side * BASELINE, **EXACT))
    wide = CAMERA.fx * BASELINE * (1 / 0.5 - 1 / 0.8)
    columns = np.flatnonzero(lost[120])
    assert len(columns) == pytest.approx(wide, abs=2)
    assert (columns.max() == 149) if side > 0 else (columns.min() == 200)
    assert not lost[:80].any() and not lost[160:].any()


def test_what_is_thinner_than_its_shadow_is_wide_lets_light_pass_on_both_sides():
    depth = plane()
    depth[:, 150:154] = 0.5
    lost = np.isnan(measured(depth, **EXACT))[120]
    assert 3 <= lost.sum() <= 6 and np.diff(np.flatnonzero(lost)).max() == 1


def test_edges_are_where_noise_is_and_surfaces_are_smooth():
    depth = step(near=0.78)
    apart = np.abs(measured(depth, disparity_noise=0.0, disparity_step=0.0) - depth) > 1e-4
    at_edge = np.zeros_like(apart)
    at_edge[74:166, 144:206] = True
    at_edge[86:154, 156:194] = False
    assert apart[90:150, 149:151].mean() > 0.1 and not apart[~at_edge].any()


def test_steep_surfaces_are_noisy_and_then_lost():
    noise = {angle: np.nanstd((measured(tilted(angle), disparity_step=0.0, edge_noise=0.0, steepest=90.0)
                               - tilted(angle))[:, 155:165]) for angle in (0, 50, 75)}
    assert noise[50] == pytest.approx(noise[0], rel=0.1) and noise[75] > 2 * noise[0]
    assert np.isnan(measured(tilted(75), steepest=70.0)[:, 155:165]).all()
    assert not np.isnan(measured(tilted(60), steepest=70.0, edge_noise=0.0)[:, 155:165]).any()


def test_where_there_is_nothing_nothing_is_measured():
    depth = plane()
    depth[:50] = np.inf
    depth[50:60] = np.nan
    seen = measured(depth, edge_noise=0.0)
    assert np.isnan(seen[:60]).all() and np.isfinite(seen[60:]).all() and seen.dtype == np.float32


def test_noise_is_that_of_the_seed():
    one, same, other = (measured(step(), seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert (one[np.isfinite(one) & np.isfinite(other)] != other[np.isfinite(one) & np.isfinite(other)]).any()
