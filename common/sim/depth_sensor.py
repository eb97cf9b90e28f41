"""Error model of structured light and stereo depth cameras.

Both measure the shift of a pattern between two viewpoints a baseline b apart, the disparity d = f b / z [px]:

- Disparity is quantized, so depth is quantized in steps of z^2 / (f b). With the Kinect's f = 580 px, b = 75 mm and
  steps of 1/8 px that is 2.9 mm at 1 m and grows with z^2, as measured by Khoshelham and Elberink, "Accuracy and
  Resolution of Kinect Depth Data for Indoor Mapping Applications", Sensors 12(2), 2012. They also derive the random
  error from that of the disparity: sigma_z = z^2 / (f b) sigma_d.
- Edges jitter: a pixel reports the depth of another about 0.8 px away. Noise grows with the angle of the surface from
  60 degrees on, until nothing is measured. Nguyen, Izadi and Lovell, "Modeling Kinect Sensor Noise for Improved 3D
  Reconstruction and Tracking", 3DIMPVT 2012.
- Points that the projector (or second camera) does not see have no depth: foreground objects cast a shadow on the side
  away from the projector.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from pydantic import Field

from common.config import Parameters, Tunable
from common.perception.pinhole import Pinhole

Array = npt.NDArray[np.float64]
Depth = npt.NDArray[np.float32]

SHADOW_STEP = 1.0  # [px] of disparity between a surface and the foreground that shadows it
STEEP = 60.0  # [deg] above which noise grows with the angle, after Nguyen et al.


class DepthSensorParameters(Parameters):
    """Depth error model; a baseline of 0 disables it."""

    baseline: Tunable[float] = Field(
        0.0, ge=-1, le=1, description="offset of the projector or second lens along the image x axis, such as 0.075; "
                                      "negative: to the left; 0: exact depth [m]"
    )
    disparity_step: Tunable[float] = Field(0.125, ge=0, le=1, description="with a baseline: resolution [px]")
    disparity_noise: Tunable[float] = Field(0.1, ge=0, le=2, description="with a baseline: standard deviation [px]")
    edge_noise: Tunable[float] = Field(
        0.8, ge=0, le=5, description="with a baseline: standard deviation of edge positions [px]"
    )
    steepest: Tunable[float] = Field(
        82.0, ge=10, le=90, description="with a baseline: largest angle of incidence that is measured [deg]"
    )


def simulate_depth(
    depth: Depth, camera: Pinhole, config: DepthSensorParameters, rng: np.random.Generator
) -> Depth:
    """Return the measured depth image (height, width) [m] of a true one; NaN where nothing is measured.

    Args:
        depth: true depth along the optical axis [m]; NaN or inf for background.
        camera: intrinsics.
        config: error model.
        rng: noise source.
    """
    baseline, step, noise, edge_noise, steepest = (
        config.baseline, config.disparity_step, config.disparity_noise, config.edge_noise, config.steepest)
    if baseline == 0:
        return depth
    reach = camera.fx * abs(baseline)  # [px m]: disparity is that by depth
    with np.errstate(divide="ignore", invalid="ignore"):
        disparity = np.where(np.isfinite(depth) & (depth > 0), reach / depth, np.nan).astype(np.float32)
    unmeasured = _in_shadow(disparity, right=baseline > 0)
    angle = _angles(depth, camera)
    unmeasured |= angle > steepest
    deviation = noise * _growth(angle)
    noisy = _edge_jitter(np.where(unmeasured, np.float32(np.nan), disparity), edge_noise, rng)
    normal = rng.standard_normal(depth.shape, dtype=np.float32)
    noisy = noisy + np.where(np.isfinite(deviation), deviation, 0).astype(np.float32) * normal
    if step > 0:
        noisy = np.round(noisy / step) * np.float32(step)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(noisy > 0, np.float32(reach) / noisy, np.float32(np.nan)).astype(np.float32)


def _in_shadow(disparity: Depth, *, right: bool) -> npt.NDArray[np.bool_]:
    """Mask (height, width) of pixels that the projector does not illuminate.

    A pixel at column u with disparity d appears at column u - d in the view of a projector on the right. There, the
    point with the largest disparity is illuminated.
    """
    known = np.isfinite(disparity)
    d = np.where(known, disparity, 0)
    height, width = d.shape
    column = np.rint(np.arange(width) + (-d if right else d)).astype(np.int64)
    low, high = int(column.min()), int(column.max())
    at = (np.arange(height)[:, None] * (high - low + 1) + column - low).ravel()
    nearest = np.zeros(height * (high - low + 1), np.float32)
    np.maximum.at(nearest, at, np.where(known, d, 0).ravel().astype(np.float32))
    return np.asarray(known & (nearest[at].reshape(d.shape) > d + SHADOW_STEP))


def _angles(depth: Depth, camera: Pinhole) -> Depth:
    """Angle of incidence at each pixel (height, width) [deg]; NaN without neighbors.

    Of the two neighbors along an axis, the one nearer in depth is on the same surface.
    """
    z = np.where(np.isfinite(depth), depth, np.nan).astype(np.float32)
    slopes = []
    for axis in (1, 0):
        step = np.diff(z, axis=axis)
        pad = [(0, 0), (0, 0)]
        pad[axis] = (1, 0)
        back = np.pad(step, pad, constant_values=np.nan)
        pad[axis] = (0, 1)
        ahead = np.pad(step, pad, constant_values=np.nan)
        smaller = np.where(np.abs(ahead) < np.abs(back), ahead, back)
        slopes.append(np.where(np.isnan(back), ahead, np.where(np.isnan(ahead), back, smaller)))
    x = (np.arange(z.shape[1], dtype=np.float32) - camera.cx)[None, :] / camera.fx
    y = (np.arange(z.shape[0], dtype=np.float32) - camera.cy)[:, None] / camera.fy
    # The surface z(u, v): its normal is proportional to (-fx dz/du, -fy dz/dv, z + (u - cx) dz/du + (v - cy) dz/dv).
    across, down = slopes[0] * camera.fx, slopes[1] * camera.fy
    forward = z + x * across + y * down
    length = np.sqrt(across**2 + down**2 + forward**2) * np.sqrt(1 + x**2 + y**2)
    with np.errstate(invalid="ignore", divide="ignore"):
        cosine = np.clip(np.abs(z) / length, 0, 1)  # normal times line of sight (x, y, 1) is z
    return np.asarray(np.degrees(np.arccos(cosine)), np.float32)


def _growth(angle: Depth) -> Depth:
    """Noise factor at an angle [deg]: 1 up to `STEEP`, then the square of Nguyen's term."""
    radians = np.radians(np.minimum(angle, 89.0))
    term = (radians / (np.pi / 2 - radians)) ** 2
    start = (np.radians(STEEP) / (np.pi / 2 - np.radians(STEEP))) ** 2
    return np.asarray(np.maximum(1.0, term / start), np.float32)


def _edge_jitter(disparity: Depth, deviation: float, rng: np.random.Generator) -> Depth:
    """Replace each pixel by one displaced by a random offset, as at edges."""
    if deviation <= 0:
        return disparity
    height, width = disparity.shape
    offset = np.rint(rng.standard_normal((2, height, width), dtype=np.float32) * np.float32(deviation)).astype(np.int32)
    v = np.clip(np.arange(height)[:, None] + offset[0], 0, height - 1)
    u = np.clip(np.arange(width)[None, :] + offset[1], 0, width - 1)
    return np.asarray(disparity[v, u])
