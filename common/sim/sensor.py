"""What the sensor of a camera makes of light: exposure, gain, noise and white balance.

Grey levels are proportional to light, as those of machine vision cameras are (a gamma of 1): a surface has the values
of its colour at `REFERENCE` light, `EXPOSURE` and a gain of 1. Noise is that of light itself, a Poisson process, and
that of reading the pixels: variance = signal + read noise^2, in electrons (EMVA Standard 1288, release 3.1, section 2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field

from common.config import Parameters, Tunable
from common.sim.lighting import REFERENCE, tint

Array = npt.NDArray[np.float64]
Values = npt.NDArray[np.float32]
Picture = npt.NDArray[np.uint8]

EXPOSURE = 0.01  # [s] at which a white surface in the reference light is just white
TARGET = 110.0  # mean grey level that automatic exposure aims at
BRIGHTEST = 245.0  # of all but one in a hundred pixels, with automatic exposure
CLOSE = 0.05  # share of the brightness that automatic exposure leaves as it is
STRIDE = 8  # [px] between the pixels that are measured
TEMPERATURES = 1e6 / np.linspace(1e6 / 2000, 1e6 / 12_000, 30)  # [K] in even steps of 1/K, as eyes tell them apart
GREY = 0.08  # of the logarithm: how far the colours of a grey surface may lie apart
FEWEST = 0.02  # of the pixels: fewer grey ones say nothing about the light


class SensorParameters(Parameters):
    """Exposure and noise of a simulated camera. As they are, pictures come as they are drawn."""

    exposure: Tunable[float] = Field(EXPOSURE, gt=0, le=1, description="how long light is gathered [s]")
    gain: Tunable[float] = Field(1.0, ge=1, le=64, description="of the sensor's signal, and of its noise")
    auto_exposure: Tunable[bool] = Field(False, description="let the camera find exposure and gain for itself")
    longest_exposure: Tunable[float] = Field(0.033, gt=0, le=1, description="with auto_exposure, before gain [s]")
    highest_gain: Tunable[float] = Field(16.0, ge=1, le=64, description="with auto_exposure")
    white_balance: Tunable[Literal["off", "auto"]] = Field("off", description="auto: grey stays grey in any light")
    full_well: Tunable[float] = Field(
        0.0, ge=0, le=1e6, description="electrons of a white pixel: 10000 are usual; 0 for a picture without noise"
    )
    read_noise: Tunable[float] = Field(5.0, ge=0, le=1000, description="standard deviation, with full_well [electrons]")
    sub_exposures: Tunable[int] = Field(
        1, ge=1, le=16, description="pictures within an exposure: more than one show how things blur as they move"
    )


@dataclass(frozen=True)
class _Settings:
    """What the parameters are for one picture."""

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
    """One sensor: what it has set itself to, and the noise."""

    def __init__(self, config: SensorParameters, rng: np.random.Generator) -> None:
        """Take the parameters, which may change at any time, and where noise comes from."""
        self._parameters, self._config, self._rng = config, _Settings.of(config), rng
        self._total: float | None = None  # exposure times gain that it has found [s]
        self._balance: Array | None = None  # (3,) factors of blue, green and red

    @property
    def exposure(self) -> float:
        """Of the next picture [s]."""
        if not self._config.auto_exposure or self._total is None:
            return self._config.exposure
        return min(self._total, self._config.longest_exposure)

    @property
    def gain(self) -> float:
        """Of the next picture."""
        if not self._config.auto_exposure or self._total is None:
            return self._config.gain
        return float(np.clip(self._total / self.exposure, 1.0, self._config.highest_gain))

    def expose(self, pictures: Sequence[Picture], level: Array) -> Picture:
        """What comes out, bgr8 (height, width, 3): the very picture where nothing is to be done with a single one.

        Args:
            pictures: bgr8, at even times within the exposure.
            level: (3,) [lx] of blue, green and red light that the value 255 of the pictures stands for.
        """
        self._config = _Settings.of(self._parameters)
        automatic = self._config.auto_exposure or self._config.white_balance == "auto"
        if not automatic:
            self._total, self._balance = None, None
        factor = np.asarray(level) / REFERENCE
        if len(pictures) == 1 and not automatic and not self._config.full_well and (self._factor(factor) == 1).all():
            return pictures[0]
        light = np.asarray(pictures[0], np.float32)
        if len(pictures) > 1:
            light = np.asarray(sum((picture.astype(np.float32) for picture in pictures[1:]), light) / len(pictures))
        if automatic and self._total is None and self._balance is None:
            few = light[::STRIDE, ::STRIDE]
            for _ in range(8):  # it has been looking for a while
                self._adjust(self._measured(few, factor, noisy=False))
        measured = self._measured(light, factor, noisy=self._config.full_well > 0)
        picture = np.rint(self._balanced(measured)).astype(np.uint8)
        if automatic:
            self._adjust(measured[::STRIDE, ::STRIDE])
        return picture

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
        # What has reached its end in one channel is white, not the colour of the others.
        return np.where((values >= 255).any(axis=-1, keepdims=True), values,
                        np.clip(values * self._balance.astype(np.float32), 0, 255))

    def _adjust(self, measured: Values) -> None:
        """Set itself for the next picture by some pixels (n, m, 3) of this one."""
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
                most = self._config.longest_exposure * self._config.highest_gain
                self._total = float(np.clip(total * np.clip(change, 1 / 8, 8), 1e-5, most))


def grey_balance(values: Values) -> Array | None:
    """(3,) factors of blue, green and red, green's 1, in which most pixels (..., 3) are grey; None where few would be.

    The light of lamps and of the sky lies near that of black bodies: of those the one is taken in which most of what
    is seen has no colour. The mean of all pixels, as in the grey world of Buchsbaum (1980), would take the colour of
    what lies on the table for that of the light.
    """
    pixels = values.reshape(-1, 3)
    pixels = pixels[(pixels.min(axis=1) > 8) & (pixels.max(axis=1) < 250)]
    if len(pixels) < FEWEST * values.size / 3:
        return None
    logs = np.log(pixels)
    tints = np.log(np.array([tint(float(t)) for t in TEMPERATURES]))
    apart = logs[None] - tints[:, None]
    apart -= apart[..., 1:2]
    near = np.exp(-((np.abs(apart).max(axis=2) / GREY) ** 2)).sum(axis=1)
    best = int(np.argmax(near))
    if near[best] < FEWEST * values.size / 3:
        return None
    factors = np.exp(-tints[best])
    return np.asarray(factors / factors[1])
