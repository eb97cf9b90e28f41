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

RUN = 6  # points to each side that smooth a point of a noisy contour
SHORTEST = 80  # contours with fewer points are not smoothed
NOISE = 0.05, 0.14  # [px] nor those with less noise, or more, which is detail; measured, see `smoothed`
WHITE = 1.1  # largest ratio of noise to uncorrelated noise: correlated deviations are waves of the object
FITS = 1.7  # largest distance of a fit from the points relative to the noise: beyond it there is detail


def smoothed(points: Array) -> Array:
    """Return the points of a closed contour (n, 2) [px] without uncorrelated noise.

    Noise comes from the image, and from edges rendered from few samples per pixel. It is measured as the distance of
    most runs of points from a parabola: 0.00 to 0.04 px in clean images, 0.06 to 0.10 px in those of OpenGL, 0.09 to
    0.14 px with noise of a fifteenth of the step, more where sides are shorter than a run, as on gears. Fine waves and
    low teeth deviate as much, but their neighboring points are correlated (`_uncorrelated`).

    Each point moves to a parabola through its neighbors (Savitzky and Golay, "Smoothing and differentiation of data by
    simplified least squares procedures", 1964); at a corner through those of one side, so that it stays sharp. Points
    stay where neither fits within their noise.
    """
    if len(points) < SHORTEST:
        return points
    found = [_parabolas(points, first) for first in (-RUN, -2 * RUN, 0)]  # around each point, before it, and after it
    middle, before, behind = (off for _, off in found)
    noise = float(np.median(np.minimum(middle, np.minimum(before, behind))))
    if not NOISE[0] <= noise <= min(NOISE[1], WHITE * _uncorrelated(points)):
        return points
    which = np.where(middle <= FITS * noise, 0, np.where(before < behind, 1, 2))
    even = np.choose(which[:, None], [on for on, _ in found])
    good = np.choose(which, [middle, before, behind]) <= FITS * noise
    return np.where(good[:, None], even, points)


def _parabolas(points: Array, first: int) -> tuple[Array, Array]:
    """Return the points (n, 2) on parabolas fitted to runs [px], and the RMS deviation of each run (n,) [px].

    `first` is the offset of a run's first point from its point.
    """
    steps = np.arange(first, first + 2 * RUN + 1)
    powers, solve = _fit(first)
    runs = points[(np.arange(len(points)) + steps[:, None]) % len(points)]
    terms = np.tensordot(solve, runs, axes=1)  # (3, n, 2)
    off = np.tensordot(powers, terms, axes=1) - runs
    along = terms[1] / np.maximum(np.linalg.norm(terms[1], axis=1, keepdims=True), 1e-9)
    across = off[..., 0] * along[:, 1] - off[..., 1] * along[:, 0]  # deviation along the contour is no noise
    return terms[0], np.sqrt((across**2).mean(axis=0))


def _uncorrelated(points: Array) -> float:
    """Return the uncorrelated noise across the contour [px], from fourth differences.

    They vanish for a smooth contour; independent errors of variance 1 give a variance of 1 + 16 + 36 + 16 + 1.
    """
    about = {k: np.roll(points, -k, axis=0) for k in range(-3, 4)}
    along = about[3] - about[-3]
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    change = about[-2] - 4 * about[-1] + 6 * points - 4 * about[1] + about[2]
    across = change[:, 0] * along[:, 1] - change[:, 1] * along[:, 0]
    return float(np.median(np.abs(across))) / (0.6745 * math.sqrt(70))  # median of a normal distribution: 0.6745


@lru_cache
def _fit(first: int) -> tuple[Array, Array]:
    """Return powers (m, 3) of a run's steps, and the matrix (3, m) that fits a parabola to its points."""
    powers = np.vander(np.arange(first, first + 2 * RUN + 1, dtype=float), 3, increasing=True)
    return powers, np.linalg.pinv(powers)


REACH = 3.0  # range of the channel's profile to both sides of a contour [px]
STEP = 0.25  # [px]
LEVELS = 2.0  # distance from the contour at which the profile has the level of the object, or of its surroundings [px]
LEAST_CONTRAST = 20.0  # [0..255]
NEIGHBOURS = 2  # points to each side for the direction of the edge


def normals(points: npt.ArrayLike, *, hole: bool) -> Array:
    """Return outward unit vectors (n, 2) at each point of a closed contour (n, 2); zero where undefined."""
    p = np.asarray(points, dtype=float)
    tangent = sum(np.roll(p, -k, axis=0) - np.roll(p, k, axis=0) for k in range(1, NEIGHBOURS + 1))
    length = np.linalg.norm(tangent, axis=1, keepdims=True)
    x, y = p.T
    turn = np.sign(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) * (-1 if hole else 1)
    across = np.column_stack([tangent[:, 1], -tangent[:, 0]]) * turn
    return np.asarray(np.divide(across, length, out=np.zeros_like(across), where=length > 1e-9))


def refine(channel: npt.NDArray[np.uint8], chain: npt.NDArray[np.int32], *, hole: bool) -> Array:
    """Return the points of a closed contour (n, 2) [px], moved across the edge to sub-pixel accuracy.

    A pixel is the mean of what it sees. The integral of the profile across the edge gives the position of a straight
    edge, whatever its direction. Without a clear step (another object is too close) a point stays halfway between the
    last pixel inside and the first one outside.
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
    """Return interpolated values (n, m) at positions (n, m, 2) [px]; the border is replicated."""
    places = at.astype(np.float32)
    rows = 32000  # limit of cv2.remap
    parts = [
        cv2.remap(channel.astype(np.float32), part[..., 0], part[..., 1], cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE)
        for part in np.array_split(places, max(1, -(-len(places) // rows)))
    ]
    return np.concatenate(parts).astype(float)


Picture = npt.NDArray[np.uint8]
Channel = Literal["saturation", "maximum", "grey"]
MOST, MAX_POINTS, MOST_ALONG_ONE = 1000, 100_000, 65_536  # limits of a message: contours, points of all, points of one


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
    """Return one value for each pixel of a bgr8 image, (height, width).

    Saturation is the difference of the largest and the smallest color. (The S of HSV is its ratio to the largest: a
    pixel at the edge of black that is a tenth yellow would count as fully yellow.) Like the others it is proportional
    to the covered fraction of a pixel.
    """
    if channel == "grey":
        return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), np.uint8)
    blue, green, red = cv2.split(picture)
    largest = cv2.max(cv2.max(blue, green), red)
    if channel == "maximum":
        return np.asarray(largest, np.uint8)
    return np.asarray(cv2.subtract(largest, cv2.min(cv2.min(blue, green), red)), np.uint8)


def find_contours(picture: Picture, options: ContourOptions) -> list[Contour]:
    """Return all contours of a bgr8 image, outer edges and edges of holes, with their hierarchy.

    A message holds a limited number; of a noisy image it gets the largest contours. Without sub-pixel refinement the
    points are the object's pixels along the edge, as in the original system.
    """
    channel = channel_of(picture, options.channel)
    above = (channel > options.threshold).astype(np.uint8)
    chains, hierarchy = cv2.findContours(above, cv2.RETR_TREE, cv2.CHAIN_APPROX_NONE)
    if not chains:
        return []
    parents = [int(parent) for parent in hierarchy[0, :, 3]]
    areas = [float(cv2.contourArea(chain)) for chain in chains]
    selected = _with_room([i for i, area in enumerate(areas) if area >= options.min_area],
                      [len(chain) for chain in chains], areas, parents)
    index_of = {-1: -1} | {old: new for new, old in enumerate(selected)}
    height, width = above.shape
    found = []
    for index, old in enumerate(selected):
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
    """Return the largest contours that fit into a message; a contour needs the one around it."""
    selected, points = set[int](), 0
    for index in sorted(wanted, key=lambda i: -areas[i]):  # a thin ring comes before its hole of the same area
        size = lengths[index]
        inside = parents[index] in selected or parents[index] < 0
        if inside and size <= MOST_ALONG_ONE and points + size <= MAX_POINTS and len(selected) < MOST:
            selected.add(index)
            points += size
    return sorted(selected)


def is_hole(contours: Sequence[Contour], index: int) -> bool:
    """Return whether a contour is the edge of a hole: it lies within an odd number of others."""
    return _is_hole([c.parent for c in contours], index)


def _is_hole(parents: Sequence[int], index: int) -> bool:
    depth, at = 0, parents[index]
    while at >= 0:
        depth, at = depth + 1, parents[at]
    return depth % 2 == 1


def _inside(picture: Picture, above: Picture, chain: npt.NDArray[np.int32], *, hole: bool) -> Color:
    """Return the mean color inside a contour: of the object without its holes, or of what a hole shows."""
    left, top, width, height = cv2.boundingRect(chain)
    mask = np.zeros((height, width), np.uint8)
    cv2.fillPoly(mask, [(chain - (left, top)).astype(np.int32)], 1)
    cut = (slice(top, top + height), slice(left, left + width))
    mask &= (above[cut] == 0) if hole else above[cut]
    b, g, r, _ = cv2.mean(picture[cut], mask)
    return Color(r=min(r / 255, 1.0), g=min(g / 255, 1.0), b=min(b / 255, 1.0))
