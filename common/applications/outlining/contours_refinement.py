"""Contours to fractions of a pixel: from how much of each pixel at the edge an object covers."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

REACH = 3.0  # the channel is looked at so far to both sides of a contour [px]
STEP = 0.25  # [px]
LEVELS = 2.0  # from here on outwards it is that of the object, or of what is beside it [px]
LEAST_CONTRAST = 20.0  # [0..255]
NEIGHBOURS = 2  # points to each side from which the direction of the edge is found
RUN = 6  # points to each side with which a point of a noisy contour is evened out
SHORTEST = 80  # contours with fewer points are left as they are
NOISE = 0.05, 0.14  # [px] likewise those with less, and with more, which is detail; measured, see `evened`
FITS = 1.7  # times the noise, so far from the points may be what is put through them: else there is some detail


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
    return evened(np.asarray(chain + offset[:, None] * out))


def evened(points: Array) -> Array:
    """The points of a closed contour (n, 2) [px] without the noise that moves each by itself.

    That is noise of the picture, and edges that were drawn from few samples for each pixel. It is how far the points of
    most runs are off a parabola: 0.00 to 0.04 px in clean pictures, 0.06 to 0.10 px in those of OpenGL, 0.09 to 0.14 px
    with noise of a fifteenth of the step, more than that where sides are shorter than a run, as those of gears.

    Each point is taken to a parabola through its neighbours (Savitzky and Golay, "Smoothing and differentiation of data
    by simplified least squares procedures", 1964); at a corner through those of one side, so that it stays sharp. Where
    neither goes along the points as well as their noise allows, they stay where they are.
    """
    if len(points) < SHORTEST:
        return points
    found = [_parabolas(points, first) for first in (-RUN, -2 * RUN, 0)]  # about each point, before, and behind it
    middle, before, behind = (off for _, off in found)
    noise = float(np.median(np.minimum(middle, np.minimum(before, behind))))
    if not NOISE[0] <= noise <= NOISE[1]:
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


@lru_cache
def _fit(first: int) -> tuple[Array, Array]:
    """Powers (m, 3) of the steps of a run, and what fits a parabola to its points (3, m)."""
    powers = np.vander(np.arange(first, first + 2 * RUN + 1, dtype=float), 3, increasing=True)
    return powers, np.linalg.pinv(powers)


def _sample(channel: npt.NDArray[np.uint8], at: Array) -> Array:
    """Values (n, m) between the pixels at places (n, m, 2) [px]; beyond the border those of the border."""
    places = at.astype(np.float32)
    rows = 32000  # cv2.remap takes no more
    parts = [
        cv2.remap(channel.astype(np.float32), part[..., 0], part[..., 1], cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE)
        for part in np.array_split(places, max(1, -(-len(places) // rows)))
    ]
    return np.concatenate(parts).astype(float)
