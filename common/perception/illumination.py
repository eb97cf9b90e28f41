"""The colour of the light, judged by what most of a table shows: in warm light a brown one is as red as red things.

A lamp of 2700 K gives surfaces less than half the green, compared with red, that daylight gives them. Where most of
it has so little green that no usual surface would have it in daylight, it is the light, and green is raised again.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
import numpy.typing as npt

Picture = npt.NDArray[np.uint8]
BoolMask = npt.NDArray[np.bool_]

STRIDE = 8  # [px] between the pixels that are looked at
DIM = 20  # [0..255] what is darker tells no colour
SHARE = 60  # percentile: so much may be redder than what tells the light
LEAST_GREEN = -0.7  # log(green / red) of what is still taken for a surface in white light
USUAL_GREEN = -0.5  # to which that of anything redder is raised
ENOUGH = 0.6  # of the logarithm: raised further, and the highlights of what is red are orange
NOT_RED = -0.75  # to which it is raised all the same
MOST = 1.0  # of the logarithm: no lamp is redder
STEP = 0.1  # of the logarithm: a little more or less changes nothing


def looked_at(height: int, width: int) -> npt.NDArray[np.float64]:
    """The pixels (rows, columns, 2) as (u, v) that the light is judged by in a picture of that size."""
    u, v = np.meshgrid(np.arange(0, width, STRIDE), np.arange(0, height, STRIDE))
    return np.stack([u, v], axis=-1).astype(float)


def green_gain(picture: Picture, table: BoolMask | None = None) -> float:
    """By how much green is too weak in a bgr8 picture (height, width, 3); 1 in any usual light.

    Args:
        picture: the picture.
        table: (rows, columns) which of the pixels `looked_at` show it; without, all of them count.
    """
    few = picture[::STRIDE, ::STRIDE]
    pixels = (few if table is None else few[table]).reshape(-1, 3).astype(np.float32)
    pixels = pixels[pixels.max(axis=1) > DIM]
    if not len(pixels):
        return 1.0
    green = float(np.percentile(np.log((pixels[:, 1] + 1) / (pixels[:, 2] + 1)), SHARE))
    if green >= LEAST_GREEN:
        return 1.0
    missing = min(USUAL_GREEN - green, max(ENOUGH, NOT_RED - green), MOST)
    return math.exp(STEP * round(missing / STEP))


def blue_share(picture: Picture, table: BoolMask) -> float:
    """The blue of what a bgr8 picture (height, width, 3) shows of a table, compared with its green; 0 where it is dark.

    `table` is as that of `green_gain`.
    """
    few = picture[::STRIDE, ::STRIDE]
    pixels = few[table].astype(np.float32)
    pixels = pixels[pixels[:, 1] > DIM]
    return float(np.median(pixels[:, 0] / pixels[:, 1])) if len(pixels) else 0.0


def amplify_green(picture: Picture, gain: float) -> Picture:
    """The picture with its green so much stronger; itself for a gain of 1."""
    if gain == 1.0:
        return picture
    raised = picture.copy()
    table = np.clip(np.rint(gain * np.arange(256)), 0, 255).astype(np.uint8)
    raised[..., 1] = table[picture[..., 1]]
    return raised


# Whether a picture tells anything at all: a covered lens, a lamp that is off or a blinded sensor show nothing."""

DARK = 16  # [0..255] nothing in the picture is brighter
BRIGHT = 250  # [0..255] nothing in it is darker
EVEN = 4.0  # [0..255] what is left of noise when blocks are averaged: nothing has an edge
BLOCK = 16  # [px] side of a block


def blank_image_reason(picture: Picture) -> str:
    """Why a bgr8 picture (height, width, 3) tells nothing; empty when it shows something.

    Blocks are averaged, so that noise is no detail. The brightest and the darkest per mille are left out: a hot pixel
    or a gleam beside a cover is no view.
    """
    height, width = picture.shape[:2]
    size = max(1, width // BLOCK), max(1, height // BLOCK)
    blocks = cv2.resize(picture, size, interpolation=cv2.INTER_AREA).reshape(-1, 3)
    low, high = np.percentile(blocks, (0.1, 99.9), axis=0)
    if high.max() <= DARK:
        return "the picture is dark: is the camera covered, or the light off?"
    if low.min() >= BRIGHT:
        return "the picture is white: it is exposed too long"
    if (high - low).max() <= EVEN:
        return "the picture shows nothing but one colour: is the camera covered?"
    return ""
