"""Closes the gaps of an outline that is put together from edges of the top and feet of walls."""

from __future__ import annotations

import itertools
import math

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

CORNER = 3.0  # narrower gaps are closed by a straight line [px]
UNSURE = 2  # points at each end of a gap that are not used: there the contour is rounded
RUN = 12  # points from which the direction of an end is found
BOW = 0.6  # two ends that turn by less than this [rad] go over into each other
ASTRAY = 1.5  # what closes a gap is at most so far from the edge of the plateau [px]
LONGEST = 1.5  # ends are extended by at most so many widths of the gap


def joined(points: Array, contour: Array, is_foot: Bools, pixel: float, edge: Array) -> Array:
    """The outline with the gaps closed that lie between parts seen as foot and parts seen as top.

    Where an upright edge was left out, a straight line closes the gap. In a notch, though, the top on one side can
    hide the foot of the other, so that both sides end before they meet: the contour is much shorter there than the gap.
    Both are extended then, to a corner where they meet at an angle, in a bow where one goes over into the other. What
    does not go along the edge of the plateau is replaced by that part of the edge.

    Args:
        points: outline (n, 3) [m].
        contour: where each is seen (n, 2) [px].
        is_foot: whether as foot (n,).
        pixel: size of a pixel at the top [m].
        edge: of the plateau (m, 3) [m].
    """
    count = len(points)
    after = np.roll(np.arange(count), -1)
    gap = np.linalg.norm(points[after] - points, axis=1) / pixel
    seen = np.linalg.norm(contour[after] - contour, axis=1)
    unsure = np.zeros(count, bool)
    bridges: dict[int, Array] = {}
    for end in np.flatnonzero((is_foot != is_foot[after]) & (gap > CORNER)):
        start = int(after[end])
        bridge: Array | None = np.empty((0, 3))
        if seen[end] < gap[end] / 2 and count > 4 * RUN:
            bridge = _bridge(points[(end - UNSURE - np.arange(RUN)) % count],
                             points[(start + UNSURE + np.arange(RUN)) % count])
            unsure[[*((end - np.arange(UNSURE)) % count), *((start + np.arange(UNSURE)) % count)]] = True
        first, last = points[end], points[start]
        if bridge is None or _farthest(np.vstack([first, bridge, last]), edge, pixel) > ASTRAY:
            bridge = _along(edge, first, last)
        bridges[int(end)] = bridge
    pieces = [part for i in range(count) for part in (points[i : i + 1][~unsure[i : i + 1]], bridges.get(i)) if
              part is not None]
    return np.concatenate(pieces)


def _farthest(line: Array, edge: Array, pixel: float) -> float:
    """How far a line (n, 3) [m] goes astray from an edge (m, 3) [m] at most [px]; infinite where it is far longer."""
    if np.linalg.norm(np.diff(line, axis=0), axis=1).sum() > 2 * (len(edge) + RUN) * pixel:
        return math.inf
    parts = [a + (b - a) * np.linspace(0, 1, 2 + int(np.linalg.norm(b - a) / pixel))[:, None]
             for a, b in itertools.pairwise(line)]
    distances = np.linalg.norm(np.concatenate(parts)[:, None] - edge, axis=2).min(axis=1)
    return float(distances.max()) / pixel


def _along(edge: Array, first: Array, last: Array) -> Array:
    """The part of a closed edge (m, 3) between two points near it, the shorter way round."""
    i, j = (int(np.argmin(np.linalg.norm(edge - point, axis=1))) for point in (first, last))
    forth = (i + np.arange((j - i) % len(edge) + 1)) % len(edge)
    back = (i - np.arange((i - j) % len(edge) + 1)) % len(edge)
    return np.asarray(edge[forth if len(forth) <= len(back) else back])


def _bridge(before: Array, behind: Array) -> Array | None:
    """Points (k, 3) between two runs (n, 3) that begin at a gap and lead away from it; None when they do not meet."""
    (a, u), (b, v) = _end(before), _end(behind)
    cross = float(u[0] * v[1] - u[1] * v[0])
    if abs(cross) < 0.05:
        return None
    s, t = float((b - a)[0] * v[1] - (b - a)[1] * v[0]) / cross, float((b - a)[0] * u[1] - (b - a)[1] * u[0]) / cross
    if not (0 < s < LONGEST * np.linalg.norm(b - a) and 0 < t < LONGEST * np.linalg.norm(b - a)):
        return None
    corner = a + s * u
    if u @ v > -math.cos(BOW):
        flat = corner[None, :]
    else:  # a parabola that touches both (a Bezier curve of second degree)
        steps = np.linspace(0, 1, 12)[1:-1, None]
        flat = (1 - steps) ** 2 * a + 2 * steps * (1 - steps) * corner + steps**2 * b
    return np.column_stack([flat, np.full(len(flat), before[0, 2])])


def _end(run: Array) -> tuple[Array, Array]:
    """The first point (2,) of a run (n, 3) and the unit direction (2,) in which it would go on beyond it."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(run[:, :2], axis=0), axis=1))])
    fit = np.polynomial.polynomial.polyfit(along, run[:, :2], 2)
    return fit[0], -fit[1] / max(float(np.linalg.norm(fit[1])), 1e-12)
