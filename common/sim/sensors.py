"""Models of sensors: photometry of a camera, and the errors of a depth camera.

Light is described by color temperature and illuminance. Grey levels are proportional to light (gamma 1), as in machine
vision cameras: at `REFERENCE` light, `EXPOSURE` and gain 1 a surface shows its configured color. Noise is shot noise
(Poisson) plus read noise: variance = signal + read noise^2, in electrons (EMVA Standard 1288, release 3.1, section 2).

Depth: structured light and stereo cameras measure the shift of a pattern between two viewpoints a baseline b apart, the
disparity d = f b / z [px]:

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

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field

from common.config import Light, Parameters, Scenery, Tunable
from common.perception.pinhole import Pinhole

Array = npt.NDArray[np.float64]
Values = npt.NDArray[np.float32]
Pixels = npt.NDArray[np.uint8]

REFERENCE = 500.0  # [lx] of a well lit table: renders surfaces in their configured color
DAYLIGHT = 6500.0  # [K] white point
CUTOFF = 45.0  # [deg] half angle of a lamp's cone
OVERHEAD = Light()  # default of a world without lights
XYZ_TO_BGR = np.array(  # of linear sRGB, IEC 61966-2-1
    [[0.0557, -0.2040, 1.0570], [-0.9689, 1.8758, 0.0415], [3.2406, -1.5372, -0.4986]]
)
EXPOSURE = 0.01  # [s] at which a white surface in reference light just saturates
TARGET = 110.0  # mean grey level of automatic exposure
BRIGHTEST = 245.0  # 99th percentile limit of automatic exposure
CLOSE = 0.05  # relative brightness deadband of automatic exposure
STRIDE = 8  # [px] between metered pixels
TEMPERATURES = 1e6 / np.linspace(1e6 / 2000, 1e6 / 12_000, 30)  # [K] in even steps of 1/K, as perceived
GREY = 0.08  # log tolerance between channels of a grey surface
FEWEST = 0.02  # fraction of grey pixels needed to estimate the light


def tint(temperature: float) -> Array:
    """(3,) blue, green and red of light at a color temperature [K], at the luminance of daylight, which is all ones.

    Chromaticity of a black body by Kim et al., US patent 7024034 (2006), valid from 1667 to 25000 K.
    """
    return _black_body(temperature) / _black_body(DAYLIGHT)


def _black_body(temperature: float) -> Array:
    t = 1000.0 / temperature
    if temperature < 4000:
        x = ((-0.2661239 * t - 0.2343589) * t + 0.8776956) * t + 0.179910
    else:
        x = ((-3.0258469 * t + 2.1070379) * t + 0.2226347) * t + 0.240390
    if temperature < 2222:
        y = ((-1.1063814 * x - 1.34811020) * x + 2.18555832) * x - 0.20219683
    elif temperature < 4000:
        y = ((-0.9549476 * x - 1.37418593) * x + 2.09137015) * x - 0.16748867
    else:
        y = ((3.0817580 * x - 5.87338670) * x + 3.75112997) * x - 0.37001483
    return np.asarray(np.maximum(XYZ_TO_BGR @ np.array([x / y, 1.0, (1 - x - y) / y]), 0.0))


def lamps(scenery: Scenery) -> list[Light]:
    """Return the lights of a scenery; by default one above the table."""
    return list(scenery.lights.values()) or [OVERHEAD]


def ambient(scenery: Scenery) -> Array:
    """(3,) [lx] of blue, green and red ambient light, of the mean color of the lights."""
    lights = lamps(scenery)
    total = sum(light.illuminance for light in lights)
    if total <= 0:
        return np.full(3, scenery.ambient)
    mean = sum((light.illuminance / total * tint(light.temperature) for light in lights), np.zeros(3))
    return np.asarray(scenery.ambient * mean)


def white_level(scenery: Scenery) -> Array:
    """(3,) [lx] of blue, green and red light of all lamps together, each at normal incidence."""
    each = (light.illuminance * tint(light.temperature) for light in lamps(scenery))
    return np.asarray(sum(each, ambient(scenery)))


class SensorParameters(Parameters):
    """Exposure and noise of a simulated camera; the defaults change nothing."""

    exposure: Tunable[float] = Field(EXPOSURE, gt=0, le=1, description="exposure time [s]")
    gain: Tunable[float] = Field(1.0, ge=1, le=64, description="gain of signal and noise")
    auto_exposure: Tunable[bool] = Field(False, description="control exposure and gain automatically")
    longest_exposure: Tunable[float] = Field(0.033, gt=0, le=1, description="with auto_exposure, before gain [s]")
    highest_gain: Tunable[float] = Field(16.0, ge=1, le=64, description="with auto_exposure")
    white_balance: Tunable[Literal["off", "auto"]] = Field("off", description="auto: grey stays grey in any light")
    full_well: Tunable[float] = Field(
        0.0, ge=0, le=1e6, description="electrons of a white pixel, usually 10000; 0: no noise"
    )
    read_noise: Tunable[float] = Field(5.0, ge=0, le=1000, description="standard deviation, with full_well [electrons]")
    sub_exposures: Tunable[int] = Field(
        1, ge=1, le=16, description="renderings per exposure; more than one: motion blur"
    )


@dataclass(frozen=True)
class _Settings:
    """Snapshot of the parameters for one image."""

    exposure: float
    gain: float
    auto_exposure: bool
    longest_exposure: float
    highest_gain: float
    white_balance: str
    full_well: float
    read_noise: float

    @classmethod
    def of(cls, p: SensorParameters) -> _Settings:
        return cls(p.exposure, p.gain, p.auto_exposure, p.longest_exposure, p.highest_gain, p.white_balance,
                   p.full_well, p.read_noise)


class Sensor:
    """One sensor: automatic exposure and white balance, and noise."""

    def __init__(self, config: SensorParameters, rng: np.random.Generator) -> None:
        """Take the parameters, which may change at any time, and the noise source."""
        self._parameters, self._config, self._rng = config, _Settings.of(config), rng
        self._total: float | None = None  # exposure times gain of automatic exposure [s]
        self._balance: Array | None = None  # (3,) factors of blue, green and red

    @property
    def exposure(self) -> float:
        """Exposure time of the next image [s]."""
        if not self._config.auto_exposure or self._total is None:
            return self._config.exposure
        return min(self._total, self._config.longest_exposure)

    @property
    def gain(self) -> float:
        """Gain of the next image."""
        if not self._config.auto_exposure or self._total is None:
            return self._config.gain
        return float(np.clip(self._total / self.exposure, 1.0, self._config.highest_gain))

    def expose(self, images: Sequence[Pixels], level: Array) -> Pixels:
        """Return the sensor image, bgr8 (height, width, 3); the same object if a single image needs no change.

        Args:
            pictures: bgr8, at even times within the exposure.
            level: (3,) [lx] of blue, green and red light that the value 255 of the images represents.
        """
        self._config = _Settings.of(self._parameters)
        automatic = self._config.auto_exposure or self._config.white_balance == "auto"
        if not automatic:
            self._total, self._balance = None, None
        factor = np.asarray(level) / REFERENCE
        if len(images) == 1 and not automatic and not self._config.full_well and (self._factor(factor) == 1).all():
            return images[0]
        light = np.asarray(images[0], np.float32)
        if len(images) > 1:
            light = np.asarray(sum((image.astype(np.float32) for image in images[1:]), light) / len(images))
        if automatic and self._total is None and self._balance is None:
            metered = light[::STRIDE, ::STRIDE]
            for _ in range(8):  # converge as a running camera would have
                self._adjust(self._measured(metered, factor, noisy=False))
        measured = self._measured(light, factor, noisy=self._config.full_well > 0)
        image = np.rint(self._balanced(measured)).astype(np.uint8)
        if automatic:
            self._adjust(measured[::STRIDE, ::STRIDE])
        return image

    def _factor(self, factor: Array) -> Array:
        return np.asarray(factor * (self.exposure / EXPOSURE * self.gain))

    def _measured(self, light: Values, factor: Array, *, noisy: bool) -> Values:
        """Grey levels before white balance, not rounded."""
        values = light * self._factor(factor).astype(np.float32)
        if noisy:
            per_electron = np.float32(255 * self.gain / self._config.full_well)
            electrons = values / per_electron
            deviation = np.sqrt(electrons + np.float32(self._config.read_noise) ** 2)
            values = values + per_electron * deviation * self._rng.standard_normal(values.shape, dtype=np.float32)
        return np.clip(values, 0, 255)

    def _balanced(self, values: Values) -> Values:
        if self._balance is None or self._config.white_balance == "off":
            return values
        # A pixel that saturates in one channel is white, not the color of the others.
        return np.where((values >= 255).any(axis=-1, keepdims=True), values,
                        np.clip(values * self._balance.astype(np.float32), 0, 255))

    def _adjust(self, measured: Values) -> None:
        """Update automatic settings for the next image from metered pixels (n, m, 3)."""
        if self._config.white_balance == "auto":
            found = grey_balance(measured)
            if found is not None:
                self._balance = found if self._balance is None else self._balance + 0.3 * (found - self._balance)
        if self._config.auto_exposure:
            total = self.exposure * self.gain
            grey = self._balanced(measured) @ np.array([0.114, 0.587, 0.299], np.float32)
            mean, high = float(grey.mean()), float(np.percentile(measured.max(axis=-1), 99))
            change = min(TARGET / max(mean, 1.0), BRIGHTEST / max(high, 1.0) if high < 255 else 0.7)
            if abs(change - 1) > CLOSE or self._total is None:
                limit = self._config.longest_exposure * self._config.highest_gain
                self._total = float(np.clip(total * np.clip(change, 1 / 8, 8), 1e-5, limit))


def grey_balance(values: Values) -> Array | None:
    """(3,) gains of blue, green and red, green 1, under which most pixels (..., 3) are grey; None if too few would be.

    Lamps and sky are close to black bodies; of those the one is chosen that renders most pixels grey. The mean of all
    pixels, as in the grey world of Buchsbaum (1980), would mistake the color of objects for that of the light.
    """
    pixels = values.reshape(-1, 3)
    pixels = pixels[(pixels.min(axis=1) > 8) & (pixels.max(axis=1) < 250)]
    if len(pixels) < FEWEST * values.size / 3:
        return None
    logs = np.log(pixels)
    tints = np.log(np.array([tint(float(t)) for t in TEMPERATURES]))
    difference = logs[None] - tints[:, None]
    difference -= difference[..., 1:2]
    grey_count = np.exp(-((np.abs(difference).max(axis=2) / GREY) ** 2)).sum(axis=1)
    best = int(np.argmax(grey_count))
    if grey_count[best] < FEWEST * values.size / 3:
        return None
    factors = np.exp(-tints[best])
    return np.asarray(factors / factors[1])


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
