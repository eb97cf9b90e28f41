"""Rest positions of spheres: free positions on the table, and the slots of containers."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from common.config import Container, Fixture, Surroundings, World
from common.scene.fixtures import slot_positions
from common.sim.footprints import distances, heights

Array = NDArray[np.float64]
Slot = tuple[int, int]  # layer, index within the layer

GAP = 1e-3  # clearance around a sphere after rolling [m]
RING = 2e-3  # step of the search for a free position [m]


class Table:
    """Surface that carries spheres of one radius, with its obstacles."""

    def __init__(self, world: World, radius: float) -> None:
        """Find the tables: box fixtures with their top at `table_height`. Without any, the surface is unbounded."""
        self.height = world.table_height
        self.radius = radius
        self._containers = list(world.containers.values())
        self._tables = tables(world)
        self._obstacles = [f for f in world.fixtures if f not in self._tables and _rises_through(f, world, radius)]

    def carries(self, x: float, y: float) -> bool:
        """Whether a center at (x, y) [m] is above a table."""
        return bool(self._carries(np.array([[x, y]]))[0])

    def extent(self) -> str:
        """Describe the tables, for messages."""
        return " or ".join(
            f"x {f.position[0] - f.dimensions[0] / 2:g} to {f.position[0] + f.dimensions[0] / 2:g}, "
            f"y {f.position[1] - f.dimensions[1] / 2:g} to {f.position[1] + f.dimensions[1] / 2:g}"
            for f in self._tables
        )

    def blocked(self, x: float, y: float) -> str:
        """Id of the container or fixture that a sphere at (x, y) [m] would overlap, or an empty string."""
        point = np.array([[x, y]])
        reach = self.radius - 1e-9
        for c in self._containers:
            if _distance_to_box(point, c.x, c.y, c.half_side)[0] < reach:
                return c.id
        return next((f.id for f in self._obstacles if _distance(point, f)[0] < reach), "")

    def free(
        self, points: Array, others: Array, gap: float = 0.0, *, apart: Sequence[float] = (),
        outlines: Sequence[Array] = (),
    ) -> NDArray[np.bool_]:
        """Mask of points (N, 2) on the table that are clear of all obstacles.

        Args:
            points: centers [m].
            others: (M, 2) centers of other spheres [m].
            gap: clearance to everything [m].
            apart: smallest distance from the center of each other sphere [m]; default: for equal radii.
            outlines: (K, 2) of other objects on the table [m].
        """
        free = self._carries(points)
        for c in self._containers:
            free &= _distance_to_box(points, c.x, c.y, c.half_side) >= self.radius + gap
        for fixture in self._obstacles:
            free &= _distance(points, fixture) >= self.radius + gap
        for other, least in zip(others, apart or [2 * self.radius] * len(others), strict=True):
            free &= np.hypot(*(points - other).T) >= least + gap
        for outline in outlines:
            free &= distances(points, outline) >= self.radius + gap
        return free

    def nearest_free(
        self, x: float, y: float, others: Array, *, apart: Sequence[float] = (), outlines: Sequence[Array] = ()
    ) -> tuple[float, float] | None:
        """Free position nearest to (x, y) [m], within the search step; None if the table is full."""
        if self.free(np.array([[x, y]]), others, apart=apart, outlines=outlines)[0]:
            return x, y
        for ring in range(1, int(2.5 / RING)):
            angles = np.linspace(0.0, 2 * math.pi, max(8, 2 * ring), endpoint=False)
            points = np.column_stack([x + ring * RING * np.cos(angles), y + ring * RING * np.sin(angles)])
            free = self.free(points, others, GAP, apart=apart, outlines=outlines)
            if free.any():
                found = points[int(np.argmax(free))]
                return float(found[0]), float(found[1])
        return None

    def _carries(self, points: Array) -> NDArray[np.bool_]:
        if not self._tables:
            return np.ones(len(points), dtype=bool)
        carried = np.zeros(len(points), dtype=bool)
        for table in self._tables:
            carried |= _distance(points, table) <= 0.0
        return carried


class Slots:
    """Slots of equal spheres in a container: layers of 2 x 2, each on top of the one below."""

    def __init__(self, container: Container, radius: float, table_height: float) -> None:
        """Lay out the slots for spheres of a radius [m]."""
        self._container = container
        self._positions = slot_positions(container, radius, table_height)
        self.centres = [(float(x), float(y)) for x, y, _ in self._positions[0]]
        self.layers = container.layers
        self.count = 4 * self.layers

    def position(self, slot: Slot) -> Array:
        """Center of a sphere in the slot (3,) [m]."""
        position: Array = self._positions[slot].copy()
        return position

    def choose(self, x: float, y: float, taken: Iterable[Slot]) -> Slot | None:
        """Free slot nearest to (x, y) in the lowest layer with room; None if the container is full."""
        occupied = set(taken)
        for layer in range(self.layers):
            free = [i for i in range(4) if (layer, i) not in occupied]
            if free:
                return layer, min(free, key=lambda i: math.dist((x, y), self.centres[i]))
        return None


def tables(world: Surroundings) -> list[Fixture]:
    """Fixtures whose flat top is at the height of the table."""
    flat = [f for f in world.fixtures if f.shape == "box" and f.rpy[0] == 0.0 and f.rpy[1] == 0.0]
    return [f for f in flat if abs(f.position[2] + f.dimensions[2] / 2 - world.table_height) < 1e-3]


def is_over(container: Container, x: float, y: float) -> bool:
    """Whether (x, y) [m] is above a container, including its walls."""
    return max(abs(x - container.x), abs(y - container.y)) <= container.half_side


def is_inside(container: Container, x: float, y: float) -> bool:
    """Whether (x, y) [m] is between the container's walls."""
    inner = container.half_side - container.wall_thickness
    return max(abs(x - container.x), abs(y - container.y)) < inner


def _rises_through(fixture: Fixture, world: World, radius: float) -> bool:
    """Whether a fixture reaches into the height range of a sphere on the table."""
    bottom, top = heights(fixture)
    return bottom < world.table_height + 2 * radius - 1e-6 and top > world.table_height + 1e-6


def _distance(points: Array, fixture: Fixture) -> Array:
    """Horizontal distance [m] of points (N, 2) to a fixture; 0 inside. A tilted one counts as its bounding circle."""
    x, y, _ = fixture.position
    if fixture.shape == "box" and not any(fixture.rpy[:2]):
        cos, sin = math.cos(fixture.rpy[2]), math.sin(fixture.rpy[2])
        dx, dy = points[:, 0] - x, points[:, 1] - y
        along, across = cos * dx + sin * dy, cos * dy - sin * dx
        return np.hypot(np.maximum(np.abs(along) - fixture.dimensions[0] / 2, 0.0),
                        np.maximum(np.abs(across) - fixture.dimensions[1] / 2, 0.0))
    upright = fixture.shape != "box" and not any(fixture.rpy[:2])
    radius = fixture.dimensions[0] if upright else math.hypot(*fixture.dimensions)
    return np.maximum(np.hypot(points[:, 0] - x, points[:, 1] - y) - radius, 0.0)


def _distance_to_box(points: Array, x: float, y: float, half_side: float) -> Array:
    return np.hypot(np.maximum(np.abs(points[:, 0] - x) - half_side, 0.0),
                    np.maximum(np.abs(points[:, 1] - y) - half_side, 0.0))
