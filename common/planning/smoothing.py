"""Lines through points that were measured, made smooth within a tolerance."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_ITERATIONS = 150
_SHORTEST = 0.25  # of the longest edge: shorter ones count as this long, or they alone would set the pace


def smoothed(points: Array, tolerances: Array) -> Array:
    """Points (N, d) moved by no more than their tolerances (N,) [m] so that the line through them bends least.

    What bends is the square of the curvature along the line; the first and the last point stay. A convex problem,
    solved to a few percent by projected gradients with Nesterov's momentum: Beck and Teboulle, "A fast iterative
    shrinkage-thresholding algorithm" (2009).
    """
    if len(points) < 3 or not tolerances.any():
        return points
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    lengths = np.maximum(lengths, _SHORTEST * lengths.max())
    lengths = (lengths / lengths.max())[:, None]
    before, after = 1 / lengths[:-1], 1 / lengths[1:]
    weights = 2 / (lengths[:-1] + lengths[1:])
    radii = tolerances.copy()
    radii[[0, -1]] = 0.0
    radii = radii[:, None]
    # The gradient changes by no more than this share of a move: by Gershgorin's circles.
    steepest = 2 * float((weights * (before + after) ** 2 * 2).max())
    moved = points.copy()
    ahead, momentum = moved, 1.0
    for _ in range(_ITERATIONS):
        bend = weights * ((ahead[2:] - ahead[1:-1]) * after - (ahead[1:-1] - ahead[:-2]) * before)
        gradient = np.zeros_like(points)
        gradient[:-2] += bend * before
        gradient[1:-1] -= bend * (before + after)
        gradient[2:] += bend * after
        offset = ahead - gradient / steepest - points
        distance = np.linalg.norm(offset, axis=1, keepdims=True)
        following = points + offset * np.minimum(1.0, radii / np.maximum(distance, 1e-12))
        grown = (1 + np.sqrt(1 + 4 * momentum**2)) / 2
        ahead = following + (momentum - 1) / grown * (following - moved)
        moved, momentum = following, grown
    return moved
