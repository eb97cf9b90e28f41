"""Find contours in an image, to a fraction of a pixel."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import Field

from applications.outlining.topics import Contour
from common.config import Parameters, Tunable
from common.messages import Color

Array = npt.NDArray[np.float64]

RUN = 6  # points to each side with which a point of a noisy contour is smoothed out
SHORTEST = 80  # contours with fewer points are left as they are
NOISE = 0.05, 0.14  # [px] likewise those with less, and with more, which is detail; measured, see `smoothed`
WHITE = 1.1  # times what each point does by itself, so much may be noise: what is more goes on as a wave does
FITS = 1.7  # times the noise, so far from the points may be what is put through them: else there is some detail


def smoothed(points: Array) -> Array:
    """The points of a closed contour (n, 2) [px] without the noise that moves each by itself.

    That is noise of the picture, and edges that were drawn from few samples for each pixel. It is how far the points of
    most runs are off a parabola: 0.00 to 0.04 px in clean pictures, 0.06 to 0.10 px in those of OpenGL, 0.09 to 0.14 px
    with noise of a fifteenth of the step, more than that where sides are shorter than a run, as those of gears. That of
    fine waves and low teeth is as large, but a point tells where the next one is (`_by_itself`).

    Each point is taken to a parabola through its neighbours (Savitzky and Golay, "Smoothing and differentiation of data
    by simplified least squares procedures", 1964); at a corner through those of one side, so that it stays sharp. Where
    neither goes along the points as well as their noise allows, they stay where they are.
    """
    if len(points) < SHORTEST:
        return points
    found = [_parabolas(points, first) for first in (-RUN, -2 * RUN, 0)]  # about each point, before, and behind it
    middle, before, behind = (off for _, off in found)
    noise = float(np.median(np.minimum(middle, np.minimum(before, behind))))
    if not NOISE[0] <= noise <= min(NOISE[1], WHITE * _by_itself(points)):
        return points
    which = np.where(middle <= FITS * noise, 0, np.where(before < behind, 1, 2))
    even = np.choose(which[:, None], [on for on, _ in found])
    good = np.choose(which, [middle, before, behind]) <= FITS * noise
    return np.where(good[:, None], even, points)


def _parabolas(points: Array, first: int) -> tuple[Array, Array]:
    """Where a parabola through a run of points has each of them (n, 2) [px], and how far off the run it is (n,) [px].

    The run of a point begins with the one that comes `first` after it, or before it.
    """
    steps = np.arange(first, first + 2 * RUN + 1)
    powers, solve = _fit(first)
    runs = points[(np.arange(len(points)) + steps[:, None]) % len(points)]
    terms = np.tensordot(solve, runs, axes=1)  # (3, n, 2)
    off = np.tensordot(powers, terms, axes=1) - runs
    along = terms[1] / np.maximum(np.linalg.norm(terms[1], axis=1, keepdims=True), 1e-9)
    across = off[..., 0] * along[:, 1] - off[..., 1] * along[:, 0]  # the step from pixel to pixel is no noise
    return terms[0], np.sqrt((across**2).mean(axis=0))


def _by_itself(points: Array) -> float:
    """How far points are moved each by itself, across the contour [px], as their fourth differences tell.

    Those of what is smooth are next to nothing, those of independent errors of variance 1 have 1 + 16 + 36 + 16 + 1.
    """
    about = {k: np.roll(points, -k, axis=0) for k in range(-3, 4)}
    along = about[3] - about[-3]
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    change = about[-2] - 4 * about[-1] + 6 * points - 4 * about[1] + about[2]
    across = change[:, 0] * along[:, 1] - change[:, 1] * along[:, 0]
    return float(np.median(np.abs(across))) / (0.6745 * math.sqrt(70))  # of what is normal, half is within 0.6745


@lru_cache
def _fit(first: int) -> tuple[Array, Array]:
    """Powers (m, 3) of the steps of a run, and what fits a parabola to its points (3, m)."""
    powers = np.vander(np.arange(first, first + 2 * RUN + 1, dtype=float), 3, increasing=True)
    return powers, np.linalg.pinv(powers)


REACH = 3.0  # the channel is looked at so far to both sides of a contour [px]
STEP = 0.25  # [px]
LEVELS = 2.0  # from here on outwards it is that of the object, or of what is beside it [px]
LEAST_CONTRAST = 20.0  # [0..255]
NEIGHBOURS = 2  # points to each side from which the direction of the edge is found


def normals(points: npt.ArrayLike, *, hole: bool) -> Array:
    """Unit vectors (n, 2) out of the object at each point of a closed contour (n, 2); zero where there is none."""
    p = np.asarray(points, dtype=float)
    tangent = sum(np.roll(p, -k, axis=0) - np.roll(p, k, axis=0) for k in range(1, NEIGHBOURS + 1))
    length = np.linalg.norm(tangent, axis=1, keepdims=True)
    x, y = p.T
    turn = np.sign(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) * (-1 if hole else 1)
    across = np.column_stack([tangent[:, 1], -tangent[:, 0]]) * turn
    return np.asarray(np.divide(across, length, out=np.zeros_like(across), where=length > 1e-9))


def refine(channel: npt.NDArray[np.uint8], chain: npt.NDArray[np.int32], *, hole: bool) -> Array:
    """The points of a closed contour (n, 2) [px], each moved across the edge to where the edge really is.

    A pixel has the mean of what it sees. The step from inside to outside, summed up along a line across it, then
    tells where on that line a straight edge lies, whatever its direction. Where there is no clear step (another object
    is too near) a point stays in the middle between the last pixel inside and the first one outside.
    """
    out = normals(chain, hole=hole)
    along = np.arange(-REACH, REACH + STEP / 2, STEP)
    at = chain[:, None, :] + along[None, :, None] * out[:, None, :]
    profile = _sample(channel, at)
    inner, outer = np.median(profile[:, along <= -LEVELS], axis=1), np.median(profile[:, along >= LEVELS], axis=1)
    contrast = inner - outer
    clear = contrast >= LEAST_CONTRAST
    share = np.clip((profile - outer[:, None]) / np.where(clear, contrast, 1.0)[:, None], 0.0, 1.0)
    weights = np.full(len(along), STEP)
    weights[[0, -1]] = STEP / 2
    offset = np.where(clear, np.clip(share @ weights - REACH, -1.0, 1.5), 0.5)
    return smoothed(np.asarray(chain + offset[:, None] * out))


def _sample(channel: npt.NDArray[np.uint8], at: Array) -> Array:
    """Values (n, m) between the pixels at places (n, m, 2) [px]; beyond the border those of the border."""
    places = at.astype(np.float32)
    rows = 32000  # cv2.remap takes no more
    parts = [
        cv2.remap(channel.astype(np.float32), part[..., 0], part[..., 1], cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE)
        for part in np.array_split(places, max(1, -(-len(places) // rows)))
    ]
    return np.concatenate(parts).astype(float)


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
