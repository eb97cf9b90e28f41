"""Objects that several images show at the same place, and what a held object of the planning scene is like."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from applications.sorting.topics import SeenObject
from common import messages as m
from common.robot.transforms import pose_to_matrix

STEADY = 0.6  # share of images that show an object at the same place
SAME = 0.025  # [m]


def steady(images: Sequence[Sequence[SeenObject]]) -> list[SeenObject]:
    """Return the objects that most images show at the same place: the others are noise."""
    found: list[SeenObject] = []
    for things in reversed(images):
        for thing in things:
            if not any(_near(thing, known) for known in found):
                found.append(thing)
    return [thing for thing in found
            if sum(any(_near(thing, other) for other in things) for things in images) > STEADY * len(images)]


def _near(one: SeenObject, other: SeenObject) -> bool:
    return math.dist((one.center.x, one.center.y), (other.center.x, other.center.y)) < SAME


def seen_as(held: m.CollisionObject) -> SeenObject:
    """Return a held object of the planning scene as an object that was seen."""
    corners = held.outline or [(held.dimensions[0] / 2, held.dimensions[-1] / 2)]
    x, y = (max(abs(corner[axis]) for corner in corners) for axis in (0, 1))
    size = m.Vector3(x=2 * x, y=2 * y, z=held.dimensions[0])
    return SeenObject(id=held.id, center=m.Vector3(), size=size, color=held.color)


def depth_below(held: m.CollisionObject) -> float:
    """Return how far a held object reaches below a tool that points down [m]; tilted grasps hold it tilted."""
    if held.shape == "prism":
        flat, height = np.array(held.outline, float), held.dimensions[0]
    else:
        x, y, height = (list(held.dimensions) * 3)[:3] if held.shape == "box" else [2 * max(held.dimensions)] * 3
        flat = np.array([(a * x / 2, b * y / 2) for a in (-1, 1) for b in (-1, 1)])
    corners = np.concatenate([np.c_[flat, np.full(len(flat), z)] for z in (-height / 2, height / 2)])
    T = pose_to_matrix(held.pose)
    return max(0.01, float((corners @ T[2, :3] + T[2, 3]).max()))
