import numpy as np
import pytest

from common.config import CameraConfig
from common.perception.pinhole import Pinhole
from common.sim.sensors import DepthSensorParameters, simulate_depth

CAMERA = Pinhole.from_config(CameraConfig(width=320, height=240, cx=159.5, cy=119.5))
BASELINE = 0.075
EXACT = {"disparity_noise": 0.0, "edge_noise": 0.0, "disparity_step": 0.0}


def plane(depth=0.8):
    return np.full((240, 320), depth, np.float32)


def step(near=0.5):
    depth = plane()
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


def test_zero_baseline_returns_the_true_depth():
    depth = step()
    assert measured(depth, baseline=0.0) is depth


@pytest.mark.parametrize("z", [0.5, 1.0, 2.0])
def test_depth_quantization_and_noise_grow_with_squared_depth(z):
    seen = np.unique(measured(tilted(5.0, z), disparity_noise=0.0, edge_noise=0.0))
    unit = z**2 / (CAMERA.fx * BASELINE)  # [m] of one pixel of disparity
    assert np.diff(seen[np.isfinite(seen)]).mean() == pytest.approx(0.125 * unit, rel=0.15)
    error = measured(plane(z), disparity_step=0.0, disparity_noise=0.1, edge_noise=0.0) - z
    assert np.nanstd(error) == pytest.approx(0.1 * unit, rel=0.05)
    assert abs(np.nanmean(error)) < 0.2 * np.nanstd(error)


@pytest.mark.parametrize("side", [1, -1])
def test_foreground_casts_a_depth_shadow_away_from_the_projector(side):
    lost = np.isnan(measured(step(), baseline=side * BASELINE, **EXACT))
    columns = np.flatnonzero(lost[120])
    assert len(columns) == pytest.approx(CAMERA.fx * BASELINE * (1 / 0.5 - 1 / 0.8), abs=2)
    assert (columns.max() == 149) if side > 0 else (columns.min() == 200)
    assert not lost[:80].any() and not lost[160:].any()


def test_shadow_of_a_thin_object_is_as_wide_as_the_object():
    depth = plane()
    depth[:, 150:154] = 0.5
    lost = np.isnan(measured(depth, **EXACT))[120]
    assert 3 <= lost.sum() <= 6 and np.diff(np.flatnonzero(lost)).max() == 1


def test_edge_noise_affects_edges_only():
    depth = step(near=0.78)
    apart = np.abs(measured(depth, disparity_noise=0.0, disparity_step=0.0) - depth) > 1e-4
    at_edge = np.zeros_like(apart)
    at_edge[74:166, 144:206] = True
    at_edge[86:154, 156:194] = False
    assert apart[90:150, 149:151].mean() > 0.1 and not apart[~at_edge].any()


def test_steep_surfaces_are_noisy_and_steeper_ones_unmeasured():
    noise = {angle: np.nanstd((measured(tilted(angle), disparity_step=0.0, edge_noise=0.0, steepest=90.0)
                               - tilted(angle))[:, 155:165]) for angle in (0, 50, 75)}
    assert noise[50] == pytest.approx(noise[0], rel=0.1) and noise[75] > 2 * noise[0]
    assert np.isnan(measured(tilted(75), steepest=70.0)[:, 155:165]).all()
    assert not np.isnan(measured(tilted(60), steepest=70.0, edge_noise=0.0)[:, 155:165]).any()


def test_background_has_no_depth():
    depth = plane()
    depth[:50], depth[50:60] = np.inf, np.nan
    seen = measured(depth, edge_noise=0.0)
    assert np.isnan(seen[:60]).all() and np.isfinite(seen[60:]).all() and seen.dtype == np.float32


def test_noise_is_that_of_the_seed():
    one, same, other = (measured(step(), seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert np.nanmax(np.abs(one - other)) > 0
