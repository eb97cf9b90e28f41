"""Rounding off the corner between two motions within a radius of the tool's distance from it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from common.planning.tool_timing import ToolWaypoints

Array = NDArray[np.float64]


class NoBlend(Exception):
    """A radius within which one of the motions begins or ends."""


def entry(tool: Array, corner: Array, radius: float) -> int:
    """Index of the first of the tool's positions (N, 3) [m] from which on it stays within a radius [m] of a corner.

    Raises:
        NoBlend: it never is farther away.
    """
    outside = np.flatnonzero(np.linalg.norm(tool - corner, axis=1) > radius)
    if not len(outside):
        raise NoBlend
    return int(outside[-1]) + 1


def blend(before: Array, after: Array) -> Array:
    """(N, dof) positions [rad] that lead from the first of `before` smoothly to the last of `after`.

    Both motions run at the same time, the one to the corner (which is the last of `before` and the first of `after`)
    and the other from it, and weight goes over from one to the other by a quintic: q = a + w (b - a). So the path
    leaves and arrives in the directions of the two motions, and lies between them.
    """
    count = max(len(before), len(after))
    shares = np.linspace(0, 1, count)
    weights = (shares**3 * (10 - 15 * shares + 6 * shares**2))[:, None]
    a, b = resampled(before, shares), resampled(after, shares)
    return np.asarray(a + weights * (b - a))


def resampled(positions: Array, shares: Array) -> Array:
    """(M, dof) positions at shares (M,) from 0 to 1 of the way through evenly counted ones (N, dof)."""
    place = shares * (len(positions) - 1)
    i = np.minimum(place.astype(int), max(len(positions) - 2, 0))
    following = np.minimum(i + 1, len(positions) - 1)
    part = (place - i)[:, None]
    return np.asarray((1 - part) * positions[i] + part * positions[following])


def joined(parts: list[ToolWaypoints]) -> ToolWaypoints:
    """The parts one after the other; each begins where the one before ends."""
    positions, ways = [parts[0].positions], [parts[0].ways]
    for part in parts[1:]:
        positions.append(part.positions[1:])
        ways.append(part.ways[1:] - part.ways[0] + ways[-1][-1])
    return ToolWaypoints(np.concatenate(positions), np.concatenate(ways))
