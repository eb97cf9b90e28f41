"""From depth images of one or several cameras to one surface seen from above.

Each depth image is smoothed by a median, which removes most of the noise of structured light and keeps edges; then its
flying pixels are dropped: those that hang between foreground and background. The remaining points are sorted into the
cells of a grid, of which each stores its highest one. Narrow gaps between points are closed from their lower
neighbors, so that no gap becomes part of an object; wider ones remain unknown.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from applications.sorting.surface import Surface
from common.perception.depth import Depth, is_valid
from common.perception.pinhole import Pinhole

Array = npt.NDArray[np.float64]
Values = npt.NDArray[np.float32]
Pixels = npt.NDArray[np.uint8]
Bools = npt.NDArray[np.bool_]
View = tuple[Depth, Pixels, Pinhole]  # depth (height, width) [m], bgr8 (height, width, 3), camera
Area = tuple[float, float, float, float]  # least x, least y, largest x, largest y in world [m]

STEP = 0.002  # [m] side of a cell
MEDIAN = 5  # [px] side of the median filter
FLYING = 0.008  # [m] a pixel this far behind its nearest and in front of its farthest neighbor hangs between surfaces
GAP = 5  # [cells] narrower gaps are closed
MOST_CELLS = 4_000_000  # of a grid


def surface_of(
    views: Sequence[View], area: Area, step: float = STEP, *, floor: float = 0.0, smooth: bool = False
) -> Surface:
    """Return the surface that cameras see of an area.

    Args:
        views: depth images with their color images and cameras; at least one.
        area: in world [m].
        step: side of a cell [m].
        floor: z of the floor under the grid [m].
        smooth: the depth images are `denoised` already.

    Raises:
        ValueError: the area is empty or has too many cells, or an image does not have the size of its camera.
    """
    columns, rows = round((area[2] - area[0]) / step), round((area[3] - area[1]) / step)
    if not (columns > 0 and rows > 0 and columns * rows <= MOST_CELLS):
        raise ValueError(f"area {area} has {columns} x {rows} cells of {step:g} m; the limit is {MOST_CELLS} cells")
    top = np.full(rows * columns, -np.inf, np.float32)
    color = np.zeros((rows * columns, 3), np.uint8)
    for depth, image, camera in views:
        if depth.shape != (camera.height, camera.width) or image.shape != (*depth.shape, 3):
            raise ValueError(f"depth of shape {depth.shape} and image of shape {image.shape} do not fit a camera of "
                             f"{camera.width}x{camera.height}")
        cells, z, pixels = _in_cells(depth if smooth else denoised(depth), camera, area, step, (rows, columns))
        before = top.copy() if len(views) > 1 else None
        np.maximum.at(top, cells, z)
        highest = z == top[cells]
        if before is not None:
            highest &= z > before[cells]
        color[cells[highest]] = image.reshape(-1, 3)[pixels[highest]]
    seen = np.where(np.isfinite(top), top, np.float32(np.nan)).reshape(rows, columns)
    filled, colors = _without_gaps(seen, color.reshape(rows, columns, 3))
    return Surface((area[0], area[1]), step, filled, colors, floor)


def denoised(depth: Depth) -> Values:
    """Return a depth image (height, width) [m] without noise and flying pixels; NaN where nothing is measured."""
    valid = is_valid(depth)
    near = np.zeros(depth.shape, np.float32)  # of pixels without depth: farther than all others
    np.divide(np.float32(1.0), depth, out=near, where=valid)
    smooth = cv2.medianBlur(near, MEDIAN)
    z = np.full(depth.shape, np.nan, np.float32)
    np.divide(np.float32(1.0), smooth, out=z, where=valid & (smooth > 0))
    square = np.ones((3, 3), np.uint8)
    farthest = cv2.dilate(np.nan_to_num(z, nan=-1.0), square)
    nearest = cv2.erode(np.nan_to_num(z, nan=1e6), square)
    z[(farthest - z > FLYING) & (z - nearest > FLYING)] = np.nan
    return z


def crop(surface: Surface, area: Area) -> tuple[Surface, tuple[slice, slice]]:
    """Return the part of a surface within an area [m], and its rows and columns in the surface."""
    first = np.clip(surface.cells((area[0], area[1])), 0, surface.top.shape)
    last = np.clip(surface.cells((area[2] - 1e-9, area[3] - 1e-9)) + 1, first, surface.top.shape)
    part = slice(int(first[0]), int(last[0])), slice(int(first[1]), int(last[1]))
    origin = (surface.origin[0] + surface.step * int(first[1]), surface.origin[1] + surface.step * int(first[0]))
    return Surface(origin, surface.step, surface.top[part], surface.color[part], surface.floor), part


@lru_cache(maxsize=8)  # cameras are the same object while they do not move
def _directions(camera: Pinhole) -> tuple[Values, Values, Values]:
    """x, y and z (height * width,) of world rays scaled to 1 m of depth."""
    u = (np.arange(camera.width) - camera.cx) / camera.fx
    v = (np.arange(camera.height) - camera.cy) / camera.fy
    R = camera.T_world_optical[:3, :3]
    x, y, z = (np.asarray(R[k, 0] * u[None, :] + R[k, 1] * v[:, None] + R[k, 2], np.float32).ravel() for k in range(3))
    return x, y, z


def heights_of(depth: Depth, camera: Pinhole) -> Values:
    """z (height * width,) [m] in world of all pixels; NaN where nothing is measured."""
    return np.asarray(np.float32(camera.position[2]) + depth.ravel() * _directions(camera)[2], np.float32)


def points_at(pixels: npt.NDArray[np.int64], depth: Depth, camera: Pinhole) -> Array:
    """Points (n, 3) [m] in world of some pixels (n,), given by their flat indices."""
    along = np.column_stack([axis[pixels] for axis in _directions(camera)])
    return np.asarray(camera.position + depth.ravel()[pixels, None].astype(float) * along)


def world_points(depth: Depth, camera: Pinhole) -> tuple[Values, Values, Values]:
    """x, y and z (height * width,) [m] in world of all pixels; NaN where nothing is measured."""
    x, y, z = _directions(camera)
    d = depth.ravel()
    at = camera.position.astype(np.float32)
    return at[0] + d * x, at[1] + d * y, at[2] + d * z


def _in_cells(
    depth: Values, camera: Pinhole, area: Area, step: float, shape: tuple[int, int]
) -> tuple[npt.NDArray[np.int64], Values, npt.NDArray[np.int64]]:
    """Return the cell, height [m] and pixel of all points in the area."""
    x, y, z = world_points(depth, camera)
    with np.errstate(invalid="ignore"):
        column, row = (x - np.float32(area[0])) / np.float32(step), (y - np.float32(area[1])) / np.float32(step)
        inside = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])  # NaN is not
    pixels = np.flatnonzero(inside)
    cells = row[pixels].astype(np.int64) * shape[1] + column[pixels].astype(np.int64)
    return cells, z[pixels], pixels


def _without_gaps(top: Values, color: Pixels) -> tuple[Values, Pixels]:
    """Close gaps that are narrower than `GAP` cells with the lowest neighbor, ring by ring."""
    holes = np.isnan(top)
    kernel = np.ones((GAP, GAP), np.uint8)
    wide = cv2.morphologyEx(
        holes.astype(np.uint8), cv2.MORPH_OPEN, kernel, borderType=cv2.BORDER_CONSTANT, borderValue=1)
    narrow = holes & (wide == 0)
    square = np.ones((3, 3), np.uint8)
    filled = np.where(np.isnan(top), np.float32(np.inf), top)
    for _ in range((GAP + 1) // 2):
        if not narrow.any():
            break
        lowest = cv2.erode(filled, square, borderType=cv2.BORDER_CONSTANT, borderValue=float("inf"))
        reached = narrow & np.isfinite(lowest)
        filled[reached] = lowest[reached]
        color = _color_of_lowest(filled, color, reached)
        narrow &= ~reached
    filled[~np.isfinite(filled)] = np.nan
    return filled, color


def _color_of_lowest(top: Values, color: Pixels, reached: Bools) -> Pixels:
    """Give cells that took the height of a neighbor its color too."""
    rows, columns = np.nonzero(reached)
    result = color.copy()
    missing = np.ones(len(rows), bool)
    for i in (-1, 0, 1):
        for k in (-1, 0, 1):
            r, c = np.clip(rows + i, 0, top.shape[0] - 1), np.clip(columns + k, 0, top.shape[1] - 1)
            same = missing & ~reached[r, c] & (top[r, c] == top[rows, columns])
            result[rows[same], columns[same]] = color[r[same], c[same]]
            missing &= ~same
    return result
