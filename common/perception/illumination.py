"""Illumination of an image: detect blank images, and estimate and correct warm light.

A 2700 K lamp gives surfaces less than half the green, relative to red, that daylight gives. In warm light a brown table
is as red as red objects. If most of the table has less green than any usual surface in daylight, the light is the
cause and green is amplified.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
import numpy.typing as npt

Pixels = npt.NDArray[np.uint8]
BoolMask = npt.NDArray[np.bool_]

STRIDE = 8  # [px] between sampled pixels
DIM = 20  # [0..255] darker pixels carry no color
PERCENTILE = 60  # of green / red that represents the light
MIN_GREEN = -0.7  # log(green / red) of a surface in white light, at least
TARGET_GREEN = -0.5  # log(green / red) to which redder surfaces are raised
USUAL_GAIN = 0.6  # log; a larger gain turns highlights of red objects orange
NOT_RED = -0.75  # log(green / red) that is reached even so
MAX_GAIN = 1.0  # log; no lamp is redder
STEP = 0.1  # log; the gain is quantized


def sampled_pixels(height: int, width: int) -> npt.NDArray[np.float64]:
    """Pixels (rows, columns, 2) as (u, v) that are sampled in an image of that size."""
    u, v = np.meshgrid(np.arange(0, width, STRIDE), np.arange(0, height, STRIDE))
    return np.stack([u, v], axis=-1).astype(float)


def green_gain(image: Pixels, table: BoolMask | None = None) -> float:
    """Gain that compensates missing green in a bgr8 image (height, width, 3); 1 in usual light.

    Args:
        image: bgr8.
        table: (rows, columns) mask of `sampled_pixels` that show the table; None: all.
    """
    sampled = image[::STRIDE, ::STRIDE]
    pixels = (sampled if table is None else sampled[table]).reshape(-1, 3).astype(np.float32)
    pixels = pixels[pixels.max(axis=1) > DIM]
    if not len(pixels):
        return 1.0
    green = float(np.percentile(np.log((pixels[:, 1] + 1) / (pixels[:, 2] + 1)), PERCENTILE))
    if green >= MIN_GREEN:
        return 1.0
    missing = min(TARGET_GREEN - green, max(USUAL_GAIN, NOT_RED - green), MAX_GAIN)
    return math.exp(STEP * round(missing / STEP))


def blue_share(image: Pixels, table: BoolMask) -> float:
    """Median blue / green of the table in a bgr8 image (height, width, 3); 0 where it is dark.

    `table` is as in `green_gain`.
    """
    sampled = image[::STRIDE, ::STRIDE]
    pixels = sampled[table].astype(np.float32)
    pixels = pixels[pixels[:, 1] > DIM]
    return float(np.median(pixels[:, 0] / pixels[:, 1])) if len(pixels) else 0.0


def amplify_green(image: Pixels, gain: float) -> Pixels:
    """Image with green scaled by a gain; the same object for a gain of 1."""
    if gain == 1.0:
        return image
    raised = image.copy()
    table = np.clip(np.rint(gain * np.arange(256)), 0, 255).astype(np.uint8)
    raised[..., 1] = table[image[..., 1]]
    return raised


# Blank images: covered lens, lamp off, saturated sensor

DARK = 16  # [0..255] maximum of a dark image
BRIGHT = 250  # [0..255] minimum of an overexposed image
EVEN = 4.0  # [0..255] spread of block means in a uniform image: residual noise
BLOCK = 16  # [px] side of a block


def blank_image_reason(image: Pixels) -> str:
    """Why a bgr8 image (height, width, 3) shows nothing; empty if it shows something.

    Block means suppress noise. The brightest and darkest per mille are ignored, so that a hot pixel or a gleam at the
    edge of a cover does not count as content.
    """
    height, width = image.shape[:2]
    size = max(1, width // BLOCK), max(1, height // BLOCK)
    blocks = cv2.resize(image, size, interpolation=cv2.INTER_AREA).reshape(-1, 3)
    low, high = np.percentile(blocks, (0.1, 99.9), axis=0)
    if high.max() <= DARK:
        return "the image is dark: is the camera covered, or the light off?"
    if low.min() >= BRIGHT:
        return "the image is white: it is overexposed"
    if (high - low).max() <= EVEN:
        return "the image shows a single color: is the camera covered?"
    return ""
