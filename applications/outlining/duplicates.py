"""Closed outlines without points that add nothing."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

SAME = 1e-9  # points nearer than this are one [m]


def without_duplicates(points: npt.ArrayLike) -> Array:
    """Points (n, d) [m] of a closed outline without those that equal the one before, or at the end the first one."""
    p = np.asarray(points, dtype=float)
    if len(p) < 2:
        return p
    kept = p[np.concatenate([[True], np.linalg.norm(np.diff(p, axis=0), axis=1) > SAME])]
    if len(kept) > 1 and np.linalg.norm(kept[-1] - kept[0]) <= SAME:
        kept = kept[:-1]
    return np.asarray(kept)


def simplified(points: npt.ArrayLike, tolerance: float) -> Array:
    """Those of the points (n, d) [m] of a closed outline without which it would move by more than the tolerance [m].

    Douglas and Peucker, "Algorithms for the reduction of the number of points" (1973), begun at the first point and the
    one that is farthest from it. The first point stays the first.
    """
    p = np.asarray(points, dtype=float)
    if len(p) < 4 or tolerance <= 0:
        return p
    closed = np.vstack([p, p[:1]])
    far = int(np.argmax(np.linalg.norm(p - p[0], axis=1)))
    keep = np.zeros(len(closed), bool)
    keep[[0, far, len(p)]] = True
    parts = [(0, far), (far, len(p))]
    while parts:
        first, last = parts.pop()
        if last - first < 2:
            continue
        distance = _distance(closed[first + 1 : last], closed[first], closed[last])
        worst = int(np.argmax(distance))
        if distance[worst] > tolerance:
            middle = first + 1 + worst
            keep[middle] = True
            parts += [(first, middle), (middle, last)]
    return np.asarray(p[keep[:-1]])


def _distance(points: Array, a: Array, b: Array) -> Array:
    """Distances (n,) of points from the line segment between a and b."""
    side = b - a
    along = np.clip((points - a) @ side / max(float(side @ side), SAME**2), 0.0, 1.0)
    return np.asarray(np.linalg.norm(points - (a + along[:, None] * side), axis=1))
