"""Places objects in the air so that none touches another: each as low as the heights of those below it permit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from common.config import Container

Array = npt.NDArray[np.float64]

STEP = 0.005  # [m] side of a grid cell
MARGIN = 0.02  # [m] from the walls
GAP = 0.004  # [m] between objects, and above the floor of the container
SPREAD = 0.035  # [m] standard deviation of positions about the middle of a container, for a heap of FEW objects
FEW = 10  # objects; a heap of more of them is wider and flatter, else some fall over the walls
TRIES = 60  # random positions of an object that is not heaped, of which the lowest is taken


@dataclass(frozen=True, eq=False)
class Silhouette:
    """Lowest and highest z (rows, columns) [m] of an object on a grid, and of which cell (row, column) its origin is.

    Cells that it does not cover are inf and -inf.
    """

    low: Array
    high: Array
    origin: tuple[int, int]


def silhouette(triangles: Array) -> Silhouette:
    """Return the heights of a surface (n, 3, 3) [m] about its origin, one cell wider than it is."""
    points = _dense_points(triangles)
    cells = np.floor(points[:, :2] / STEP).astype(int)
    first = cells.min(axis=0) - 1
    shape = tuple((cells.max(axis=0) - first + 2)[::-1])
    low, high = np.full(shape, np.inf), np.full(shape, -np.inf)
    x, y = (cells - first).T
    for dx in (-1, 0, 1):
        for dy in (-1, 0, 1):
            np.minimum.at(low, (y + dy, x + dx), points[:, 2])
            np.maximum.at(high, (y + dy, x + dx), points[:, 2])
    return Silhouette(low, high, (int(-first[1]), int(-first[0])))


def _dense_points(triangles: Array) -> Array:
    """Points (n, 3) on triangles (k, 3, 3), at most about a cell apart."""
    longest = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2).max()
    count = int(np.ceil(longest / STEP)) + 1
    u, v = np.meshgrid(np.linspace(0, 1, count), np.linspace(0, 1, count))
    inside = u + v <= 1 + 1e-9
    weights = np.column_stack([1 - u[inside] - v[inside], u[inside], v[inside]])
    return np.asarray((weights @ triangles).reshape(-1, 3))


def stacked(
    objects: Sequence[Silhouette], container: Container, table: float, rng: np.random.Generator, *, heap: bool,
    gap: float = GAP,
) -> list[Array]:
    """Positions (3,) [m] in world of the origins of objects above a container.

    Args:
        objects: all within the walls of the container.
        container: a square box.
        table: height of the table [m].
        rng: source of the positions.
        heap: about the middle; else anywhere, as low as possible.
        gap: between objects, and above the floor of the container [m].
    """
    room = container.half_side - container.wall_thickness - MARGIN
    count = int(2 * room / STEP)
    top = np.full((count, count), container.floor_thickness)
    spread = SPREAD * math.sqrt(max(1.0, len(objects) / FEW)) if heap else None
    tries = 1 + 2 * ((len(objects) - 1) // FEW) if heap else TRIES
    found = []
    for each in objects:
        options = [_lowest(each, top, spread, rng) for _ in range(tries)]
        z, row, column = min(options)
        z += gap
        rows, columns = each.low.shape
        area = top[row: row + rows, column: column + columns]
        covered = (slice(0, area.shape[0]), slice(0, area.shape[1]))
        np.maximum(area, z + each.high[covered], out=area)
        x, y = ((at + origin - count / 2) * STEP for at, origin in
                ((column, each.origin[1]), (row, each.origin[0])))
        found.append(np.array([container.x + x, container.y + y, table + z]))
    return found


def _lowest(
    each: Silhouette, top: Array, spread: float | None, rng: np.random.Generator
) -> tuple[float, int, int]:
    """Height of an object's origin above the table at a random cell (row, column) of its first corner.

    `spread` is the standard deviation about the middle [m]; None: anywhere.
    """
    count, size = len(top), np.array(each.low.shape)
    most = np.maximum(count - size, 0)
    if spread is not None:
        corner = np.round(rng.normal(count / 2, spread / STEP, 2) - each.origin).astype(int)
    else:
        corner = rng.integers(0, most + 1)
    row, column = np.clip(corner, 0, most).tolist()
    area = top[row: row + size[0], column: column + size[1]]
    return float((area - each.low[: area.shape[0], : area.shape[1]]).max()), row, column
