"""Where a sphere can lie: on the table, clear of everything that stands there, or in a slot of a container."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from common.config import Container, Fixture, Surroundings, World
from common.scene.slots import slot_positions
from common.sim.footprints import distances, heights

Array = NDArray[np.float64]
Slot = tuple[int, int]  # layer, index within the layer

GAP = 1e-3  # room that is left to what a sphere rolls up to [m]
RING = 2e-3  # step of the search for a free place [m]


class Table:
    """The surface on which spheres of one size rest, and what stands on it."""

    def __init__(self, world: World, radius: float) -> None:
        """Find the tables among the fixtures: boxes whose top is at `table_height`. None: it has no end."""
        self.height = world.table_height
        self.radius = radius
        self._containers = list(world.containers.values())
        self._tables = tables(world)
        self._obstacles = [f for f in world.fixtures if f not in self._tables and _rises_through(f, world, radius)]

    def carries(self, x: float, y: float) -> bool:
        """Whether a centre at (x, y) [m] is above a table."""
        return bool(self._carries(np.array([[x, y]]))[0])

    def extent(self) -> str:
        """The tables, for people."""
        return " or ".join(
            f"x {f.position[0] - f.dimensions[0] / 2:g} to {f.position[0] + f.dimensions[0] / 2:g}, "
            f"y {f.position[1] - f.dimensions[1] / 2:g} to {f.position[1] + f.dimensions[1] / 2:g}"
            for f in self._tables
        )

    def blocked(self, x: float, y: float) -> str:
        """The thing into which a sphere resting at (x, y) [m] would reach, or an empty string."""
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
        """Which of the points (N, 2) are on the table and clear of all that stands there.

        Args:
            points: centres [m].
            others: (M, 2) centres of other spheres [m].
            gap: that is left to everything [m].
            apart: how far centres are at least from each of the others [m]; without, they are of the same size.
            outlines: (K, 2) each, of what else lies there [m].
        """
        good = self._carries(points)
        for c in self._containers:
            good &= _distance_to_box(points, c.x, c.y, c.half_side) >= self.radius + gap
        for fixture in self._obstacles:
            good &= _distance(points, fixture) >= self.radius + gap
        for other, least in zip(others, apart or [2 * self.radius] * len(others), strict=True):
            good &= np.hypot(*(points - other).T) >= least + gap
        for outline in outlines:
            good &= distances(points, outline) >= self.radius + gap
        return good

    def nearest_free(
        self, x: float, y: float, others: Array, *, apart: Sequence[float] = (), outlines: Sequence[Array] = ()
    ) -> tuple[float, float] | None:
        """The free place nearest to (x, y) [m], to within the search step; None when the table is full."""
        if self.free(np.array([[x, y]]), others, apart=apart, outlines=outlines)[0]:
            return x, y
        for ring in range(1, int(2.5 / RING)):
            angles = np.linspace(0.0, 2 * math.pi, max(8, 2 * ring), endpoint=False)
            points = np.column_stack([x + ring * RING * np.cos(angles), y + ring * RING * np.sin(angles)])
            good = self.free(points, others, GAP, apart=apart, outlines=outlines)
            if good.any():
                found = points[int(np.argmax(good))]
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
    """The places of equal spheres in a container: 2 x 2 in each layer, one of a layer lies on the one below."""

    def __init__(self, container: Container, radius: float, table_height: float) -> None:
        """Lay out the slots for spheres of that radius [m]."""
        self._container = container
        self._positions = slot_positions(container, radius, table_height)
        self.centres = [(float(x), float(y)) for x, y, _ in self._positions[0]]
        self.layers = container.layers
        self.count = 4 * self.layers

    def position(self, slot: Slot) -> Array:
        """Centre of a sphere in the slot (3,) [m]."""
        position: Array = self._positions[slot].copy()
        return position

    def choose(self, x: float, y: float, taken: Iterable[Slot]) -> Slot | None:
        """The free slot nearest to (x, y) in the lowest layer that is not full; None when the container is."""
        occupied = set(taken)
        for layer in range(self.layers):
            free = [i for i in range(4) if (layer, i) not in occupied]
            if free:
                return layer, min(free, key=lambda i: math.dist((x, y), self.centres[i]))
        return None


def tables(world: Surroundings) -> list[Fixture]:
    """Fixtures whose flat top is at the table's height."""
    flat = [f for f in world.fixtures if f.shape == "box" and f.rpy[0] == 0.0 and f.rpy[1] == 0.0]
    return [f for f in flat if abs(f.position[2] + f.dimensions[2] / 2 - world.table_height) < 1e-3]


def is_over(container: Container, x: float, y: float) -> bool:
    """Whether (x, y) [m] is above a container, its walls included."""
    return max(abs(x - container.x), abs(y - container.y)) <= container.half_side


def is_inside(container: Container, x: float, y: float) -> bool:
    """Whether (x, y) [m] is between the container's walls."""
    inner = container.half_side - container.wall_thickness
    return max(abs(x - container.x), abs(y - container.y)) < inner


def _rises_through(fixture: Fixture, world: World, radius: float) -> bool:
    """Whether a fixture is anywhere as high as a sphere on the table."""
    bottom, top = heights(fixture)
    return bottom < world.table_height + 2 * radius - 1e-6 and top > world.table_height + 1e-6


def _distance(points: Array, fixture: Fixture) -> Array:
    """Horizontal distance [m] of points (N, 2) to a fixture seen from above; 0 inside. A tilted one counts as round."""
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
