"""Whether a picture tells anything at all: a covered lens, a lamp that is off or a blinded sensor show nothing."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

Picture = npt.NDArray[np.uint8]

DARK = 16  # [0..255] nothing in the picture is brighter
BRIGHT = 250  # [0..255] nothing in it is darker
EVEN = 4.0  # [0..255] what is left of noise when blocks are averaged: nothing has an edge
BLOCK = 16  # [px] side of a block


def blindness(picture: Picture) -> str:
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
