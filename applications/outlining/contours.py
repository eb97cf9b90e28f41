"""Contours of what stands out in a picture: every pixel along each edge, and which contour lies within which."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import Field

from applications.outlining.contours_refinement import refine
from applications.outlining.messages import Contour
from common.config import Parameters, Tunable
from common.messages import Color

Picture = npt.NDArray[np.uint8]
Channel = Literal["saturation", "maximum", "grey"]
MOST, MAX_POINTS, MOST_ALONG_ONE = 1000, 100_000, 65_536  # contours and points that a message has room for


class ContourOptions(Parameters):
    """How contours are found."""

    channel: Tunable[Channel] = Field(
        "saturation",
        description="what is compared with the threshold: saturation (largest less smallest of red, green and blue: "
        "sees colours on anything grey, so neither ground nor arm), maximum (of the three) or grey (as the seed)",
    )
    threshold: Tunable[int] = Field(127, ge=0, le=254, description="a pixel above this belongs to an object [0..255]")
    subpixel: Tunable[bool] = Field(
        True, description="place each point of a contour where the channel passes half its step, and even out noise"
    )
    min_area: Tunable[float] = Field(0.0, ge=0, le=1e6, description="smaller contours are left out [px^2]")


def channel_of(picture: Picture, channel: Channel) -> Picture:
    """One value for each pixel of a bgr8 picture, (height, width).

    Saturation is the difference of the largest and the smallest colour. (The S of HSV is its ratio to the largest: a
    pixel at the edge of black that is a tenth yellow would count as wholly yellow.) Like the others it grows evenly
    with the part of a pixel that something covers.
    """
    if channel == "grey":
        return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), np.uint8)
    blue, green, red = cv2.split(picture)
    largest = cv2.max(cv2.max(blue, green), red)
    if channel == "maximum":
        return np.asarray(largest, np.uint8)
    return np.asarray(cv2.subtract(largest, cv2.min(cv2.min(blue, green), red)), np.uint8)


def find_contours(picture: Picture, options: ContourOptions) -> list[Contour]:
    """All contours of a bgr8 picture, outer edges and edges of holes, with their hierarchy.

    Of more than a message has room for, as of a picture full of noise, the largest.
    Without sub-pixel refinement the pixels are those of the object that lie along the edge, as the seed has them.
    """
    channel = channel_of(picture, options.channel)
    above = (channel > options.threshold).astype(np.uint8)
    chains, hierarchy = cv2.findContours(above, cv2.RETR_TREE, cv2.CHAIN_APPROX_NONE)
    if not chains:
        return []
    parents = [int(parent) for parent in hierarchy[0, :, 3]]
    areas = [float(cv2.contourArea(chain)) for chain in chains]
    kept = _with_room([i for i, area in enumerate(areas) if area >= options.min_area],
                      [len(chain) for chain in chains], areas, parents)
    index_of = {-1: -1} | {old: new for new, old in enumerate(kept)}
    height, width = above.shape
    found = []
    for index, old in enumerate(kept):
        chain = np.asarray(chains[old].reshape(-1, 2), np.int32)
        hole = _is_hole(parents, old)
        points = refine(channel, chain, hole=hole) if options.subpixel else chain.astype(float)
        u, v = chain.T
        found.append(Contour(
            index=index, label=f"Object_{index}", pixels=[(float(x), float(y)) for x, y in points], area=areas[old],
            parent=index_of.get(parents[old], -1), color=_inside(picture, above, chain, hole=hole),
            touches_border=bool((u == 0).any() or (v == 0).any() or (u == width - 1).any() or (v == height - 1).any()),
        ))
    return found


def _with_room(
    wanted: Sequence[int], lengths: Sequence[int], areas: Sequence[float], parents: Sequence[int]
) -> list[int]:
    """Those of the contours that a message has room for, the largest first: none without the one around it."""
    kept, points = set[int](), 0
    for index in sorted(wanted, key=lambda i: -areas[i]):  # a thin ring is before its hole, which is as large
        size = lengths[index]
        inside = parents[index] in kept or parents[index] < 0
        if inside and size <= MOST_ALONG_ONE and points + size <= MAX_POINTS and len(kept) < MOST:
            kept.add(index)
            points += size
    return sorted(kept)


def is_hole(contours: Sequence[Contour], index: int) -> bool:
    """Whether a contour is the edge of a hole in an object: it lies within an odd number of others."""
    return _is_hole([c.parent for c in contours], index)


def _is_hole(parents: Sequence[int], index: int) -> bool:
    depth, at = 0, parents[index]
    while at >= 0:
        depth, at = depth + 1, parents[at]
    return depth % 2 == 1


def _inside(picture: Picture, above: Picture, chain: npt.NDArray[np.int32], *, hole: bool) -> Color:
    """The mean colour of what a contour holds: the object without its holes, or what is seen through a hole."""
    left, top, width, height = cv2.boundingRect(chain)
    mask = np.zeros((height, width), np.uint8)
    cv2.fillPoly(mask, [(chain - (left, top)).astype(np.int32)], 1)
    cut = (slice(top, top + height), slice(left, left + width))
    mask &= (above[cut] == 0) if hole else above[cut]
    b, g, r, _ = cv2.mean(picture[cut], mask)
    return Color(r=min(r / 255, 1.0), g=min(g / 255, 1.0), b=min(b / 255, 1.0))
