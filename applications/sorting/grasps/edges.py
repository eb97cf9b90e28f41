"""Seeds of grasps: opposite edges of an object, and lines through its middle."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from applications.sorting.grasps.height_map import HeightMap, Labels

Array = NDArray[np.float64]

DROP = 0.0035  # [m] next to a cell that makes it an edge: a finger can stand there
REACH = 2  # cells within which the drop must be
CONE = 0.6  # coefficient of friction for which a pair of edges must hold
_EDGES = 90  # of an object that are paired
_PAIRS = 60  # of an object that are used
_YAWS = 12  # of lines across an object's middle
_ASIDE = (0.0, -0.014, 0.014)  # [m] of these lines from the middle
_SAME_PLACE, _SAME_ANGLE = 0.006, math.radians(15)  # of two pairs of which one is enough
_LEAST = 0.004  # [m] between edges


@dataclass(frozen=True, eq=False)
class Seeds:
    """Lines along which fingers may close.

    Attributes:
        middle: (n, 2) between the two edges, world [m].
        yaw: (n,) direction from the first edge to the second, world [rad].
        width: (n,) between the edges [m].
        label: (n,) of the object.
    """

    middle: Array
    yaw: Array
    width: Array
    label: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Outlines:
    """Edges of a height map.

    Attributes:
        edge: (rows, columns) cells of objects next to which it is lower.
        normal: (rows, columns, 2) horizontal unit vectors downhill, world x and y.
    """

    edge: NDArray[np.bool_]
    normal: NDArray[np.float32]

    @classmethod
    def of(cls, heights: HeightMap) -> Outlines:
        """Find the edges."""
        size = 2 * REACH + 1
        drop = heights.height - cv2.erode(heights.height, np.ones((size, size), np.uint8))
        smooth = cv2.GaussianBlur(heights.height, (0, 0), 1.5)
        slope = np.stack([cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)], axis=-1)
        length = np.linalg.norm(slope, axis=-1, keepdims=True)
        return cls((heights.labels > 0) & (drop >= DROP), -slope / np.maximum(length, 1e-9))


def seeds(heights: HeightMap, outlines: Outlines, widest: float, rng: np.random.Generator) -> Seeds:
    """Return pairs of edges of each object that face away from each other, and lines across its middle.

    Args:
        heights, outlines: the map and its edges.
        widest: distance of edges [m].
        rng: chooses among many edges.
    """
    found: list[tuple[Array, Array, Array, int]] = []
    columns = heights.height.shape[1]
    for label, cells in _members(heights.labels).items():
        at = heights.origin + heights.step * (np.stack([cells % columns, cells // columns], axis=1) + 0.5)
        is_edge = outlines.edge.ravel()[cells]
        normals = outlines.normal.reshape(-1, 2)[cells[is_edge]]
        center = at.mean(axis=0)
        found.append((*_pairs(at[is_edge], normals, center, widest, rng), label))
        found.append((*_lines(at, center, heights.step, widest), label))
    if not found:
        return Seeds(np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros(0, int))
    owner = np.concatenate([np.full(len(yaw), number) for _, yaw, _, number in found])
    return Seeds(
        np.concatenate([each[0] for each in found]), np.concatenate([each[1] for each in found]),
        np.concatenate([each[2] for each in found]), owner)


def _members(labels: Labels) -> dict[int, NDArray[np.int64]]:
    """Return the flat indices of the cells of each object."""
    cells = np.flatnonzero(labels)
    owner = labels.ravel()[cells]
    order = np.argsort(owner, kind="stable")
    names, starts = np.unique(owner[order], return_index=True)
    if not len(names):
        return {}
    return dict(zip(names.tolist(), np.split(cells[order], starts[1:]), strict=True))


def _pairs(
    at: Array, normals: NDArray[np.float32], center: Array, widest: float, rng: np.random.Generator
) -> tuple[Array, Array, Array]:
    """Return middles, yaws and widths of pairs of edges within the friction cone of each other."""
    if len(at) > _EDGES:
        chosen = rng.choice(len(at), _EDGES, replace=False)
        at, normals = at[chosen], normals[chosen]
    first, second = np.triu_indices(len(at), 1)
    between = at[second] - at[first]
    width = np.linalg.norm(between, axis=1)
    usable = (width >= _LEAST) & (width <= widest)
    first, second, between, width = first[usable], second[usable], between[usable], width[usable]
    along = between / width[:, None]
    least = math.cos(math.atan(CONE))
    one, other = -(normals[first] * along).sum(axis=1), (normals[second] * along).sum(axis=1)
    held = (one >= least) & (other >= least)
    middle, along, width = (at[first] + at[second])[held] / 2, along[held], width[held]
    away = center - middle
    aside = np.abs(away[:, 0] * along[:, 1] - away[:, 1] * along[:, 0])
    best = np.argsort(aside / 0.03 - one[held] - other[held])
    middle, width, yaw = middle[best], width[best], np.arctan2(along[best, 1], along[best, 0])
    cell = np.floor((middle - center) / _SAME_PLACE).astype(np.int64) + 500
    turn, size = np.floor((yaw % math.pi) / _SAME_ANGLE), np.floor(width / (2 * _SAME_PLACE))
    _, unique = np.unique(cell[:, 0] * 10**8 + cell[:, 1] * 10**4 + turn * 100 + size, return_index=True)
    unique = np.sort(unique)[:_PAIRS]
    return middle[unique], yaw[unique], width[unique]


def _lines(at: Array, center: Array, step: float, widest: float) -> tuple[Array, Array, Array]:
    """Return middles, yaws and widths of an object along lines near its middle: noise cannot hide those."""
    yaws = np.arange(_YAWS) * math.pi / _YAWS
    axes = np.stack([np.cos(yaws), np.sin(yaws)])
    along, across = (at - center) @ axes, (at - center) @ np.stack([-axes[1], axes[0]])
    middles, angles, widths = [], [], []
    for aside in _ASIDE:
        on = np.abs(across - aside) < step
        low = np.where(on, along, 1.0).min(axis=0)  # objects are smaller than a metre
        high = np.where(on, along, -1.0).max(axis=0)
        fits = (high - low > _LEAST) & (high - low < widest)
        middle = center + ((low + high) / 2)[fits, None] * axes.T[fits] + aside * np.stack([-axes[1], axes[0]]).T[fits]
        middles.append(middle)
        angles.append(yaws[fits])
        widths.append((high - low)[fits])
    return np.concatenate(middles), np.concatenate(angles), np.concatenate(widths)
