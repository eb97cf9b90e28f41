"""Heights of the cells of a surface, with unknown cells and walls filled in, for checks of clearance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from applications.sorting.surface import Surface
from common.config import Container

Array = NDArray[np.float64]
Heights = NDArray[np.float32]
Coordinates = NDArray[np.float32]
Labels = NDArray[np.int32]

MARGIN = 0.12  # [m] around the surface, so that the palm stays on the map
FLOOR_NOISE = 0.006  # [m] above the floor that an unlabeled cell may be measured and still counts as floor
_GAP = 3  # cells: narrower gaps between measured cells are no hiding places
_DEEP = np.float32(-10.0)  # [m] means unknown
_SQUARE = np.ones((3, 3), np.uint8)


@dataclass(frozen=True)
class Walls:
    """Walls of an upright square tray in world: center, half sides inside and outside, z of their top and floor [m]."""

    x: float
    y: float
    inner: float
    outer: float
    top: float

    @classmethod
    def of(cls, tray: Container, table_height: float) -> Walls:
        """Return the walls of a container on a table at `table_height` [m]."""
        inner, top = tray.half_side - tray.wall_thickness, table_height + tray.wall_height
        return cls(tray.x, tray.y, inner, tray.half_side, top)


class HeightMap:
    """Filtered heights and labels on the cells of a surface with a margin about it.

    Attributes:
        origin, step, floor: as of the surface, with the margin.
        height: (rows, columns) z of the top of each cell [m]; unknown cells are as high as their neighbors.
        labels: (rows, columns) number of the object in each cell, 0 for none.
        measured: (rows, columns) cells of the surface, without margin and walls.
    """

    def __init__(self, surface: Surface, labels: Labels, walls: Sequence[Walls] = ()) -> None:
        """Filter noise, fill unknown cells and add walls."""
        self.step, self.floor = surface.step, surface.floor
        pad = round(MARGIN / surface.step)
        self.origin = np.array(surface.origin) - pad * surface.step
        known = _without_noise(surface, labels)
        self.height: Heights = np.pad(known, pad, constant_values=np.float32(surface.floor))
        self.labels: Labels = np.pad(labels.astype(np.int32), pad)
        self.measured: NDArray[np.bool_] = np.pad(np.ones(known.shape, bool), pad)
        for wall in walls:
            self._raise(wall)
        self._dilated: dict[int, Heights] = {0: self.height}

    def _raise(self, wall: Walls) -> None:
        rows, columns = self.height.shape
        away = np.maximum(
            np.abs(self.origin[1] + self.step * (np.arange(rows) + 0.5) - wall.y)[:, None],
            np.abs(self.origin[0] + self.step * (np.arange(columns) + 0.5) - wall.x))
        inside = (away > wall.inner) & (away < wall.outer)
        self.height[inside] = np.maximum(self.height[inside], np.float32(wall.top))
        self.labels[away > wall.inner] = 0
        self.measured &= away <= wall.inner

    @cached_property
    def lowest(self) -> Heights:
        """(rows, columns) the lowest point of each cell and those next to it [m]."""
        return np.asarray(cv2.erode(self.height, _SQUARE), np.float32)

    def dilated(self, cells: int) -> Heights:
        """Return (rows, columns) the highest point within a number of cells [m]."""
        if cells not in self._dilated:
            shape = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * cells + 1, 2 * cells + 1))
            self._dilated[cells] = np.asarray(cv2.dilate(self.height, shape), np.float32)
        return self._dilated[cells]

    def index(self, x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.intp]:
        """Return (...) flat indices of the cells at world positions [m]; the nearest cell if outside."""
        rows, columns = self.height.shape
        column = ((x - self.origin[0].astype(x.dtype)) * x.dtype.type(1 / self.step)).astype(np.intp)
        row = ((y - self.origin[1].astype(x.dtype)) * x.dtype.type(1 / self.step)).astype(np.intp)
        np.clip(column, 0, columns - 1, out=column)
        np.clip(row, 0, rows - 1, out=row)
        row *= columns
        row += column
        return np.asarray(row)

    def penetration(self, points: Coordinates, *cells: int) -> list[Array]:
        """Return (n,) how far the deepest of points (3, n, m) [m] is below the surface there; negative: above.

        Args:
            points: x, y, z in world.
            cells: by which everything is wider than it was measured; a result for each.
        """
        if not points.shape[2]:
            return [np.full(points.shape[1], -np.inf) for _ in cells]
        index = self.index(points[0], points[1])
        return [(self.dilated(wider).ravel()[index] - points[2]).max(axis=1).astype(float) for wider in cells]


def _without_noise(surface: Surface, labels: Labels) -> Heights:
    """Return (rows, columns) heights [m] without outliers and unknown cells."""
    top = surface.top.astype(np.float32)
    unknown = np.isnan(top)
    if unknown.all():
        return np.full(top.shape, surface.floor, np.float32)
    narrow = unknown & ~cv2.morphologyEx(unknown.astype(np.uint8), cv2.MORPH_OPEN, _SQUARE).astype(bool)
    if narrow.any():
        high = np.where(unknown, -_DEEP, top)
        top[narrow] = cv2.erode(high, np.ones((_GAP, _GAP), np.uint8))[narrow]
        top[top >= -_DEEP] = np.nan
        unknown = np.isnan(top)
    top[unknown] = _DEEP
    while unknown.any():  # each unknown cell becomes as high as the highest of those nearest to it
        wider = cv2.dilate(top, _SQUARE)
        top[unknown] = wider[unknown]
        unknown = top == _DEEP
    top = np.asarray(cv2.medianBlur(top, 5), np.float32)
    top[(labels == 0) & (top < surface.floor + FLOOR_NOISE)] = surface.floor
    return np.maximum(top, np.float32(surface.floor))
