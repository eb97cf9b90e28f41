"""Describe a segment of a surface: position, size, outline, color and shape, and how certain it is one object."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from applications.sorting.surface import Surface
from applications.sorting.topics import SeenObject
from common.messages import Color, Vector3

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]
Values = npt.NDArray[np.float32]
Labels = npt.NDArray[np.int32]

MOST_CORNERS = 32  # of an outline
RIM = 3  # [cells] around an object in which its support is visible
DROP = 0.005  # [m] an object is at least this much higher than what it may rest on
ON_OTHERS = 0.7  # fraction of its surroundings that is higher than the floor when an object lies on others
HOLE = 20  # [cells] smallest hole of a ring
LONG = 2.5  # length by width of a long object
FLAT = 0.35  # height by width of a flat one
FLAT_HEIGHT = 0.02  # [m] largest height of a flat one
ROUND = 0.875  # fraction of its rectangle that a round object covers at most; a circle covers 0.785
BOX = 0.88  # fraction that a box covers at least
CONVEX = 0.90  # fraction of its hull that a round object and a box cover at least
TOP = 0.98  # quantile of the heights that is the top
STRAY = 0.015  # fraction of cells that may stick out on each side
GREY = 55  # [0..255] saturation below which an object has no hue
HUES = ((9, "red"), (20, "orange"), (34, "yellow"), (85, "green"), (130, "blue"), (165, "purple"), (181, "red"))


@dataclass(frozen=True, eq=False)
class Segment:
    """One segment of a surface.

    Attributes:
        mask: (rows, columns) its cells.
        surface: around it, of the same shape.
        others: (rows, columns) cells of all objects.
        near_wall: (rows, columns) cells at a wall.
        gain: (3,) blue green red, which corrects the light.
        patched: whether patches of other colors were joined to it.
    """

    mask: Bools
    surface: Surface
    others: Bools
    near_wall: Bools
    gain: Values
    patched: bool


def described(segment: Segment, name: str, place: str, floor: float) -> SeenObject:
    """Return the message about a segment in a place with a floor at a height z [m]."""
    surface, mask = segment.surface, segment.mask
    rows, columns = np.nonzero(mask)
    xy = surface.xy(rows, columns)
    z = surface.top[rows, columns].astype(float)
    center, top = xy.mean(axis=0), float(np.sort(z)[int(TOP * (len(z) - 1))])
    bottom = min(_support(segment, floor), top - DROP / 2)
    hull = cv2.convexHull((xy - center).astype(np.float32)).reshape(-1, 2).astype(float)
    length, width, yaw = _principal(xy - center, surface.step)
    bgr = np.median(surface.color[rows, columns], axis=0) * segment.gain
    b, g, r = (float(value) / 255 for value in np.clip(bgr, 0, 255))
    size = Vector3(x=length, y=width, z=max(top - bottom, 0.0))
    confidence, why = _confidence(segment, hull)
    return SeenObject(
        id=name, place=place, center=Vector3(x=float(center[0]), y=float(center[1]), z=float(z.mean())), size=size,
        yaw=yaw, outline=_outline(hull, center, surface.step), top=top, bottom=bottom,
        volume=float(np.maximum(z - bottom, 0).sum()) * surface.step**2, color=Color(r=r, g=g, b=b),
        color_name=color_name((b, g, r)), shape=_shape(mask, hull, size, surface.step), confidence=confidence, why=why)


def _support(segment: Segment, floor: float) -> float:
    """Return the height z [m] of what supports the object: the floor, or lower objects that surround it."""
    mask = segment.mask.astype(np.uint8)
    around = cv2.dilate(mask, np.ones((2 * RIM + 1, 2 * RIM + 1), np.uint8)).astype(bool) & ~segment.mask
    edge = segment.surface.top[segment.mask].min()
    levels = segment.surface.top[around]
    lower = levels[np.isfinite(levels) & (levels < edge - DROP)]
    count = max(1, int(np.count_nonzero(around)))
    high = lower[lower > floor + 2 * DROP]
    if len(high) < ON_OTHERS * count:
        return floor
    return float(np.median(high))


def _principal(offsets: Array, step: float) -> tuple[float, float, float]:
    """Return length, width [m] and yaw [rad] of cells (n, 2) [m] about their mean, along their principal axes."""
    values, axes = np.linalg.eigh(np.cov(offsets.T) + 1e-12 * np.eye(2))
    yaw = math.atan2(axes[1, 1], axes[0, 1])
    if values[1] < 1.3 * values[0]:  # the axes of a square or a circle do not follow from its moments
        yaw = math.radians(float(cv2.minAreaRect(offsets.astype(np.float32))[2]))
    along = np.array([math.cos(yaw), math.sin(yaw)])
    across = np.array([-along[1], along[0]])
    length, width = (_extent(offsets @ axis) + step for axis in (along, across))
    if width > length:
        length, width, yaw = width, length, yaw + math.pi / 2
    return length, width, math.remainder(yaw, math.pi)


def _extent(values: Array) -> float:
    """Return the extent of evenly spread values (n,) without a few that stick out."""
    ordered, out = np.sort(values), int(STRAY * len(values))
    return float(ordered[-1 - out] - ordered[out]) / (1 - 2 * out / len(values))


def _outline(hull: Array, center: Array, step: float) -> list[tuple[float, float]]:
    """Return the hull of cell centers (n, 2), grown by half a cell, with at most `MOST_CORNERS` corners [m]."""
    if len(hull) > MOST_CORNERS:
        hull = hull[np.linspace(0, len(hull), MOST_CORNERS, endpoint=False).astype(int)]
    away = np.maximum(np.linalg.norm(hull, axis=1, keepdims=True), 1e-9)
    grown = hull * (1 + step / 2 / away) + center
    return [(float(x), float(y)) for x, y in grown]


def color_name(bgr: tuple[float, float, float]) -> str:
    """Return the name of a color, blue green red, 0 to 1."""
    pixel = np.array([[[round(255 * min(max(value, 0.0), 1.0)) for value in bgr]]], np.uint8)
    hue, saturation, value = (int(each) for each in cv2.cvtColor(pixel, cv2.COLOR_BGR2HSV)[0, 0])
    if value < 45:
        return "black"
    if saturation < GREY:
        return "white" if value > 190 else "grey" if value > 65 else "black"
    return next(name for limit, name in HUES if hue < limit)


def _shape(mask: Bools, hull: Array, size: Vector3, step: float) -> str:
    """Return a word for the shape of a mask with its hull (n, 2) [m] and size."""
    area = np.count_nonzero(mask) * step**2
    if _hole(mask) >= HOLE:
        return "ring"
    if size.x > LONG * size.y:
        return "long"
    if size.z < min(FLAT * size.y, FLAT_HEIGHT):
        return "flat"
    fill = area / max(size.x * size.y, 1e-9)
    solid = area / max(cv2.contourArea(hull.astype(np.float32)) + step * cv2.arcLength(
        hull.astype(np.float32), True) / 2, 1e-9)
    if solid < CONVEX:
        return "other"
    if fill >= BOX:
        return "box"
    return "round" if 0.70 <= fill <= ROUND and size.x < 1.3 * size.y else "other"


def _hole(mask: Bools) -> int:
    """Return the number of cells of the largest hole of a mask."""
    outside = np.pad(~mask, 1, constant_values=True).astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(outside, connectivity=4)
    border = labels[0, 0]
    return max((int(stats[k, cv2.CC_STAT_AREA]) for k in range(1, count) if k != border), default=0)


def _confidence(segment: Segment, hull: Array) -> tuple[float, str]:
    """Return the confidence that a segment is one object, and what is uncertain."""
    reasons: list[tuple[float, str]] = []
    if segment.patched:
        reasons.append((0.7, "two colors"))
    if (segment.mask & segment.near_wall).any():
        reasons.append((0.9, "touches the wall"))
    near = cv2.dilate(segment.mask.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool) & ~segment.mask
    if near.any() and np.isnan(segment.surface.top[near]).mean() > 0.3:
        reasons.append((0.8, "much unknown around it"))
    cells = np.count_nonzero(segment.mask) * segment.surface.step**2
    whole = cv2.contourArea(hull.astype(np.float32))
    if cells < 0.7 * whole and _hole(segment.mask) < HOLE:
        reasons.append((0.7, "not convex: may be two objects"))
    if (near & segment.others).sum() > 0.5 * near.sum():
        reasons.append((0.8, "touches others"))
    return math.prod(each for each, _ in reasons), ", ".join(text for _, text in reasons)
