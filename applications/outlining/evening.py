"""Takes the noise out of the points of a contour, and leaves its details."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

RUN = 6  # points to each side with which a point of a noisy contour is evened out
SHORTEST = 80  # contours with fewer points are left as they are
NOISE = 0.05, 0.14  # [px] likewise those with less, and with more, which is detail; measured, see `evened`
WHITE = 1.1  # times what each point does by itself, so much may be noise: what is more goes on as a wave does
FITS = 1.7  # times the noise, so far from the points may be what is put through them: else there is some detail


def evened(points: Array) -> Array:
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
