"""What a structured light or stereo camera measures of depth, with what it cannot see and how wrong it is.

Both find how far a pattern is shifted between two places a baseline b apart, the disparity d = f b / z [px]:

- what they measure comes in steps of disparity, and so in steps of z^2 / (f b) in depth. With the Kinect's f = 580 px,
  b = 75 mm and steps of an eighth of a pixel that is 2.9 mm at 1 m and grows with z^2, as measured by Khoshelham and
  Elberink, "Accuracy and Resolution of Kinect Depth Data for Indoor Mapping Applications", Sensors 12(2), 2012, who
  also derive the random error from that of the disparity: sigma_z = z^2 / (f b) sigma_d;
- edges are not where they are seen: by Nguyen, Izadi and Lovell, "Modeling Kinect Sensor Noise for Improved 3D
  Reconstruction and Tracking", 3DIMPVT 2012, a pixel's depth is that of one some 0.8 px aside, and surfaces seen at a
  small angle are more noisy, 60 degrees off and beyond ever more, until nothing is measured;
- what the projector (or the second camera) does not see has no depth: a shadow beside whatever stands before something
  else, on the side away from the projector.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from pydantic import Field

from common.config import Parameters, Tunable
from common.perception.pinhole import Pinhole

Array = npt.NDArray[np.float64]
Depth = npt.NDArray[np.float32]

HIDDEN = 1.0  # [px] of disparity by which something must be nearer to keep the light from what lies behind it
STEEP = 60.0  # [deg] from which on noise grows with the angle, after Nguyen et al.


class DepthSensorParameters(Parameters):
    """How depth is measured. With a baseline of 0 it is measured as it is."""

    baseline: Tunable[float] = Field(
        0.0, ge=-1, le=1, description="from the camera to its projector or second lens, along the picture's x: to the "
                                      "right, or to the left where negative, such as 0.075; 0: depth as it is [m]"
    )
    disparity_step: Tunable[float] = Field(0.125, ge=0, le=1, description="with a baseline: what it resolves [px]")
    disparity_noise: Tunable[float] = Field(0.1, ge=0, le=2, description="with a baseline: standard deviation [px]")
    edge_noise: Tunable[float] = Field(
        0.8, ge=0, le=5, description="with a baseline: standard deviation sideways [px]"
    )
    steepest: Tunable[float] = Field(
        82.0, ge=10, le=90, description="with a baseline: angle of surfaces that have a depth [deg]"
    )


def simulate_depth(
    depth: Depth, camera: Pinhole, config: DepthSensorParameters, rng: np.random.Generator
) -> Depth:
    """The depth image (height, width) [m] that such a camera gives of a true one; NaN where it measures nothing.

    Args:
        depth: along the optical axis [m]; NaN or inf where there is nothing.
        camera: its intrinsics.
        config: what kind of camera it is.
        rng: where noise comes from.
    """
    baseline, step, noise, edge_noise, steepest = (
        config.baseline, config.disparity_step, config.disparity_noise, config.edge_noise, config.steepest)
    if baseline == 0:
        return depth
    reach = camera.fx * abs(baseline)  # [px m]: disparity is that by depth
    with np.errstate(divide="ignore", invalid="ignore"):
        disparity = np.where(np.isfinite(depth) & (depth > 0), reach / depth, np.nan).astype(np.float32)
    lost = _in_shadow(disparity, right=baseline > 0)
    angle = _angles(depth, camera)
    lost |= angle > steepest
    deviation = noise * _growth(angle)
    seen = _shaken(np.where(lost, np.float32(np.nan), disparity), edge_noise, rng)
    normal = rng.standard_normal(depth.shape, dtype=np.float32)
    seen = seen + np.where(np.isfinite(deviation), deviation, 0).astype(np.float32) * normal
    if step > 0:
        seen = np.round(seen / step) * np.float32(step)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(seen > 0, np.float32(reach) / seen, np.float32(np.nan)).astype(np.float32)


def _in_shadow(disparity: Depth, *, right: bool) -> npt.NDArray[np.bool_]:
    """Pixels (height, width) that the projector does not see.

    What is at column u with disparity d stands at column u - d of the picture of a projector on the right: of all that
    stands there it sees what has the largest disparity.
    """
    known = np.isfinite(disparity)
    d = np.where(known, disparity, 0)
    height, width = d.shape
    column = np.rint(np.arange(width) + (-d if right else d)).astype(np.int64)
    low, high = int(column.min()), int(column.max())
    at = (np.arange(height)[:, None] * (high - low + 1) + column - low).ravel()
    nearest = np.zeros(height * (high - low + 1), np.float32)
    np.maximum.at(nearest, at, np.where(known, d, 0).ravel().astype(np.float32))
    return np.asarray(known & (nearest[at].reshape(d.shape) > d + HIDDEN))


def _angles(depth: Depth, camera: Pinhole) -> Depth:
    """Between line of sight and normal of the surface at each pixel (height, width) [deg]; NaN without neighbours.

    Of the two neighbours on either side the nearer one in depth is on the same surface.
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
    """How many times as noisy surfaces at an angle [deg] are: 1 up to `STEEP`, then as the square of Nguyen's term."""
    radians = np.radians(np.minimum(angle, 89.0))
    term = (radians / (np.pi / 2 - radians)) ** 2
    start = (np.radians(STEEP) / (np.pi / 2 - np.radians(STEEP))) ** 2
    return np.asarray(np.maximum(1.0, term / start), np.float32)


def _shaken(disparity: Depth, deviation: float, rng: np.random.Generator) -> Depth:
    """Each pixel with the value of one that lies some pixels aside, as at edges."""
    if deviation <= 0:
        return disparity
    height, width = disparity.shape
    aside = np.rint(rng.standard_normal((2, height, width), dtype=np.float32) * np.float32(deviation)).astype(np.int32)
    v = np.clip(np.arange(height)[:, None] + aside[0], 0, height - 1)
    u = np.clip(np.arange(width)[None, :] + aside[1], 0, width - 1)
    return np.asarray(disparity[v, u])
