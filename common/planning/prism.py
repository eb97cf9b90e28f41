"""Upright prisms as convex shapes: the hull of a cross-section between two lids of triangles.

The hull is computed here and not by coal, which fails from 256 corners on: it triangulates each lid as a fan, which
gives one corner more neighbours than it can store.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import coal

Array = NDArray[np.float64]

_FLAT = 1e-6  # [m] an outline that spreads less across its longest direction is a line
_DECIMALS = 7  # points are rounded to a tenth of a micrometre: closer ones would be corners without a direction


def is_line(outline: Sequence[tuple[float, float]]) -> bool:
    """Return whether the points [m] of a cross-section enclose no area."""
    points = np.array(outline, dtype=float)
    return bool(np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[-1] < _FLAT)


def prism(outline: Sequence[tuple[float, float]], length: float) -> coal.Convex:
    """Return the convex hull of a cross-section [m] extruded by a length along z [m], centred."""
    import coal  # imported here: most callers need the hull of an outline only

    hull = convex_hull(np.array(outline, dtype=float))
    count = len(hull)
    points, triangles = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
    for z in (-length / 2, length / 2):
        for x, y in hull:
            points.append(np.array([x, y, z]))
    for i, j, k in _lid(count):
        triangles.append(coal.Triangle(k, j, i))
        triangles.append(coal.Triangle(count + i, count + j, count + k))
    for i in range(count):
        j = (i + 1) % count
        triangles.append(coal.Triangle(i, j, count + j))
        triangles.append(coal.Triangle(i, count + j, count + i))
    return coal.Convex(points, triangles)


def convex_hull(points: Array) -> Array:
    """Return corners (N, 2) of the convex hull of points (M, 2), anticlockwise: Andrew's monotone chain."""
    order = np.unique(np.round(points, _DECIMALS) + 0.0, axis=0).tolist()
    chains = []
    for way in (order, order[::-1]):
        chain: list[list[float]] = []
        for x, y in way:
            while len(chain) > 1 and _twice_area(chain[-2], chain[-1], x, y) <= 0:
                chain.pop()
            chain.append([x, y])
        chains += chain[:-1]
    return np.array(chains)


def _twice_area(a: list[float], b: list[float], x: float, y: float) -> float:
    return (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])


def _lid(count: int) -> list[tuple[int, int, int]]:
    """Return triangles that cover a convex polygon in a zigzag, so that no corner has many neighbours."""
    triangles = []
    low, high = 0, count - 1
    while high - low > 1:
        triangles.append((low, low + 1, high))
        low += 1
        if high - low > 1:
            triangles.append((low, high - 1, high))
            high -= 1
    return triangles
