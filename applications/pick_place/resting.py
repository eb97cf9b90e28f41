"""Where balls can lie: on the table, or in layers in the container."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from common.config import Container, Fixture, Surroundings
from common.perception.pinhole import Pinhole

Array = npt.NDArray[np.float64]


def is_table(fixture: Fixture, height: float) -> bool:
    """Whether the upper side of a fixture is a table at a height [m]."""
    top = fixture.position[2] + fixture.dimensions[2] / 2 if fixture.shape == "box" else None
    return top is not None and abs(top - height) < 1e-3


def shows_table(around: Surroundings, camera: Pinhole, pixels: Array) -> npt.NDArray[np.bool_]:
    """Through which pixels (..., 2) a table would be seen if nothing were before it: (...)."""
    places = camera.on_plane(pixels, around.table_height)
    shown = np.zeros(places.shape[:-1], bool)
    for fixture in around.fixtures:
        if is_table(fixture, around.table_height):
            beside = np.abs(places - fixture.position[:2])  # nan above the horizon, and no table there
            shown |= (beside <= np.array(fixture.dimensions[:2]) / 2).all(axis=-1)
    return shown


@dataclass(frozen=True)
class Resting:
    """Known size of the balls and the heights at which their centres can be, in world [m]."""

    radius: float
    table_height: float
    container: Container

    @classmethod
    def of(cls, surroundings: Surroundings) -> Resting:
        """What the surroundings say."""
        return cls(surroundings.ball_radius, surroundings.table_height, surroundings.container)

    @property
    def plane(self) -> float:
        """z of the centres of balls on the table [m]."""
        return self.table_height + self.radius

    @property
    def layers(self) -> list[float]:
        """z of the centres in each layer of the container, from below [m]."""
        lowest = self.table_height + self.container.floor_thickness + self.radius
        return [lowest + 2 * self.radius * layer for layer in range(self.container.layers)]

    @property
    def stack_height(self) -> float:
        """z of the top of a full container's uppermost ball, or of its walls where these are higher [m]."""
        stack = self.container.floor_thickness + 2 * self.radius * self.container.layers
        return self.table_height + max(stack, self.container.wall_height)

    def meets_container(self, origin: npt.ArrayLike, direction: npt.ArrayLike) -> bool:
        """Whether a ray meets the volume of the container up to the stack height.

        Args:
            origin: (3,) in world [m].
            direction: (3,) in world, of any length.

        The slab method: the ray is inside between the last entry into and the first exit from the three pairs of
        planes.
        """
        o, d = np.asarray(origin, dtype=float).tolist(), np.asarray(direction, dtype=float).tolist()
        entry, leave = 0.0, math.inf
        for at, along, (low, high) in zip(o, d, self._slabs, strict=True):  # three numbers: far quicker than arrays
            if abs(along) < 1e-12:
                if not low <= at <= high:
                    return False
                continue
            first, second = (low - at) / along, (high - at) / along
            entry, leave = max(entry, min(first, second)), min(leave, max(first, second))
        return entry <= leave

    def shows_container(self, camera: Pinhole, pixel: Sequence[float] | Array) -> bool:
        """Whether the ray through a pixel (u, v) meets the volume of the container up to the stack height."""
        return self.meets_container(*camera.ray(pixel))

    @cached_property
    def _slabs(self) -> tuple[tuple[float, float], ...]:
        """From where to where the volume of the container reaches along each axis [m]."""
        c, h = self.container, self.container.half_side
        return (c.x - h, c.x + h), (c.y - h, c.y + h), (self.table_height, self.stack_height)

    def heights(self, camera: Pinhole, pixel: Sequence[float] | Array) -> list[float]:
        """z [m] at which the centre of a ball seen at a pixel can be."""
        if not self.shows_container(camera, pixel):
            return [self.plane]
        # Heights that differ by a few millimetres cannot be told apart by how large a ball looks.
        apart = all(abs(z - self.plane) > self.radius / 3 for z in self.layers)
        return [self.plane, *self.layers] if apart else self.layers

    def can_lie(self, center: npt.ArrayLike) -> bool:
        """Whether a ball can lie with its centre at (x, y, z) [m] in world: above the table only between the walls."""
        x, y, z = np.asarray(center, dtype=float)
        if z < self.plane + self.radius:
            return True
        room = self.container.half_side - self.container.wall_thickness - 0.7 * self.radius
        return bool(abs(x - self.container.x) <= room and abs(y - self.container.y) <= room)
