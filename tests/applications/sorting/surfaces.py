"""Surfaces of known solids in a tray, as a camera without noise would see them from straight above."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from applications.sorting.grasps.height_map import Walls
from applications.sorting.surface import Surface

Array = NDArray[np.float64]
Solid = Callable[[Array, Array], Array]  # height above the floor at x, y [m]; negative outside

CENTER = (0.55, 0.0)
FLOOR = 0.005
HALF = 0.2
WALLS = Walls(*CENTER, inner=0.192, outer=0.2, top=0.05)


def box(x: float, y: float, length: float, width: float, height: float, yaw: float = 0.0) -> Solid:
    """Return a box with its length turned by yaw from world x."""
    def heights(at_x: Array, at_y: Array) -> Array:
        c, s = np.cos(yaw), np.sin(yaw)
        along, across = c * (at_x - x) + s * (at_y - y), c * (at_y - y) - s * (at_x - x)
        return np.where((np.abs(along) < length / 2) & (np.abs(across) < width / 2), height, -1.0)
    return heights


def cylinder(x: float, y: float, radius: float, height: float, hole: float = 0.0) -> Solid:
    """Return an upright cylinder, or a ring with a hole of a radius."""
    def heights(at_x: Array, at_y: Array) -> Array:
        away = np.hypot(at_x - x, at_y - y)
        return np.where((away < radius) & (away >= hole), height, -1.0)
    return heights


def sphere(x: float, y: float, radius: float) -> Solid:
    """Return a sphere on the floor."""
    def heights(at_x: Array, at_y: Array) -> Array:
        rest = radius**2 - (at_x - x) ** 2 - (at_y - y) ** 2
        return np.where(rest > 0, radius + np.sqrt(np.maximum(rest, 0.0)), -1.0)
    return heights


def union(*solids: Solid) -> Solid:
    """Return solids that are one object."""
    return lambda x, y: np.max([solid(x, y) for solid in solids], axis=0)


def seen(
    solids: Sequence[Solid], noise: float = 0.0, seed: int = 0, step: float = 0.002
) -> tuple[Surface, NDArray[np.int32]]:
    """Return the surface of solids, and the number of the solid in each cell."""
    count = round(2 * HALF / step)
    origin = (CENTER[0] - HALF, CENTER[1] - HALF)
    x, y = np.meshgrid(*(start + step * (np.arange(count) + 0.5) for start in origin))
    top, labels = np.full((count, count), FLOOR), np.zeros((count, count), np.int32)
    for number, solid in enumerate(solids, 1):
        height = solid(x, y) + FLOOR
        above = height > top + 1e-4
        top[above], labels[above] = height[above], number
    top += noise * np.random.default_rng(seed).standard_normal(top.shape)
    return Surface(origin, step, top.astype(np.float32), np.zeros((count, count, 3), np.uint8), FLOOR), labels
