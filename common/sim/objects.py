"""The true shape of objects that stand on something: outlines of their top faces in world."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from common.config import ObjectConfig
from common.messages import Color, WorldObject

Array = NDArray[np.float64]

CIRCLE_POINTS = 360  # a circle of 0.06 m is then at most 2.3 um off


def world_object(thing: ObjectConfig) -> WorldObject:
    """The solid in world: outline of its top face, anticlockwise, and the hole of a ring."""
    c, s = math.cos(thing.yaw), math.sin(thing.yaw)
    place = np.array([[c, s], [-s, c]])

    def points(shape: Array) -> list[tuple[float, float]]:
        return [(float(x), float(y)) for x, y in shape @ place + (thing.x, thing.y)]

    return WorldObject(
        id=thing.id, shape=thing.shape, outline=points(cross_section(thing)),
        hole=points(circle(thing.inner_radius)) if thing.inner_radius else [],
        base=thing.z, height=thing.height, color=Color(r=thing.color[0], g=thing.color[1], b=thing.color[2]),
    )


def centre_of(thing: WorldObject) -> tuple[float, float, float]:
    """Middle [m] of the box about an object."""
    outline = np.array(thing.outline)
    x, y = (outline.min(axis=0) + outline.max(axis=0)) / 2
    return float(x), float(y), thing.base + thing.height / 2


def cross_section(thing: ObjectConfig) -> Array:
    """Outer edge (N, 2) [m] about the object's own origin, anticlockwise."""
    if thing.size is not None and thing.shape == "box":
        x, y = thing.size[0] / 2, thing.size[1] / 2
        return np.array([(-x, -y), (x, -y), (x, y), (-x, y)])
    if thing.radius is not None and thing.shape in ("cylinder", "ring"):
        return circle(thing.radius)
    corners = np.array(thing.polygon)
    x, y = corners.T
    twice_area = float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))
    return corners if twice_area > 0 else corners[::-1]


def circle(radius: float) -> Array:
    """Points (N, 2) [m] on a circle about the origin, anticlockwise."""
    angles = np.linspace(0, 2 * math.pi, CIRCLE_POINTS, endpoint=False)
    return radius * np.column_stack([np.cos(angles), np.sin(angles)])
