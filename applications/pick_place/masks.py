"""What is red in a picture; of one that is like the one before only what has changed is looked at."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from applications.pick_place.blobs import Mask
from common.perception.illumination import BoolMask, amplify_green, green_gain

Picture = npt.NDArray[np.uint8]
Window = tuple[tuple[int, int, int], tuple[int, int, int]]  # lower and upper end: hue, saturation, value
Part = tuple[slice, slice]  # rows and columns

_SQUARE = np.ones((2, 2), np.uint8)
_MOST = 0.5  # of a picture: where more has changed, all of it is looked at


@dataclass(frozen=True)
class Colours:
    """What counts as red: windows in OpenCV's HSV, and the width of the ellipse for opening and closing [px]."""

    windows: tuple[Window, ...]
    kernel_px: int


class RedMasks(NamedTuple):
    """What is red, 255 where it is: opened; then closed; and what is too narrow to outlive opening."""

    opened: Mask
    closed: Mask
    narrow: Mask


@dataclass(frozen=True)
class _Known:
    picture: Picture
    colours: Colours
    gain: float  # of green, for the colour of the light
    table: BoolMask | None
    masks: RedMasks


class Masks:
    """Masks of one picture after the other: for each the same as if it were the first."""

    def __init__(self) -> None:
        """Nothing was seen yet."""
        self._known: _Known | None = None

    def of(self, picture: Picture, colours: Colours, table: BoolMask | None = None) -> RedMasks:
        """What is red in a bgr8 picture. The masks are not to be written to.

        Args:
            picture: the picture.
            colours: what counts as red.
            table: where it is shown, see `green_gain`: the very same array as long as it is there.
        """
        known, part = self._known, None
        if known is not None and known.colours == colours and known.picture.shape == picture.shape:
            part = changed(known.picture, picture)
            if part is None and known.table is table:
                return known.masks
        gain = green_gain(picture, table)
        if known is None or part is None or gain != known.gain or _share(part, picture) > _MOST:
            masks = _masks(amplify_green(picture, gain), colours)
            self._known = _Known(picture.copy(), colours, gain, table, masks)
            return masks
        reach = 4 * (colours.kernel_px // 2) + 2  # of erosion and dilation, twice: so far a pixel acts on the masks
        inner, outer = _grown(part, reach, picture), _grown(part, 2 * reach, picture)
        masks = RedMasks(*(mask.copy() for mask in known.masks))
        known.picture[part] = picture[part]
        offset = inner[0].start - outer[0].start, inner[1].start - outer[1].start
        size = inner[0].stop - inner[0].start, inner[1].stop - inner[1].start
        within = slice(offset[0], offset[0] + size[0]), slice(offset[1], offset[1] + size[1])
        for whole, fresh in zip(masks, _masks(amplify_green(picture[outer], gain), colours), strict=True):
            whole[inner] = fresh[within]
        self._known = _Known(known.picture, colours, gain, table, masks)
        return masks


def changed(before: Picture, after: Picture) -> Part | None:
    """The rectangle in which two pictures of one shape differ; None where they do not."""
    other = _words(before) != _words(after)
    rows = np.flatnonzero(other.any(axis=1))
    if not len(rows):
        return None
    top, bottom = int(rows[0]), int(rows[-1]) + 1
    columns = np.flatnonzero(other[top:bottom].any(axis=0))
    width, words = before.shape[1], other.shape[1]
    left, right = int(columns[0]) * width // words, -(-(int(columns[-1]) + 1) * width // words)
    return slice(top, bottom), slice(left, right)


def _words(picture: Picture) -> npt.NDArray[np.unsignedinteger]:
    """The rows of a picture as long words, which are compared sooner than bytes; their last axis is its width."""
    flat = np.ascontiguousarray(picture).reshape(len(picture), -1)
    return flat.view(np.uint64) if flat.shape[1] % 8 == 0 else flat


def _share(part: Part, picture: Picture) -> float:
    return float(picture[part].size / picture.size)


def _grown(part: Part, by: int, picture: Picture) -> Part:
    rows, columns = (
        slice(max(0, side.start - by), min(size, side.stop + by))
        for side, size in zip(part, picture.shape[:2], strict=True)
    )
    return rows, columns


def _masks(picture: Picture, colours: Colours) -> RedMasks:
    hsv = cv2.cvtColor(picture, cv2.COLOR_BGR2HSV)
    red = np.zeros(picture.shape[:2], np.uint8)
    for low, high in colours.windows:
        red = np.asarray(cv2.bitwise_or(red, cv2.inRange(hsv, np.array(low), np.array(high))), np.uint8)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (colours.kernel_px, colours.kernel_px))
    opened = cv2.morphologyEx(red, cv2.MORPH_OPEN, kernel)
    closed = cv2.morphologyEx(opened, cv2.MORPH_CLOSE, kernel)
    # Not the rim of what outlived, nor specks: noise has no squares of four pixels in a row.
    narrow = cv2.morphologyEx(cv2.subtract(red, cv2.dilate(opened, kernel)), cv2.MORPH_OPEN, _SQUARE)
    return RedMasks(*(np.asarray(mask, np.uint8) for mask in (opened, closed, narrow)))
