"""The objects of the simulated world that are no balls: where each stands, and where else it could."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from common.config import Fixture, World
from common.errors import Refused
from common.messages import WorldObject
from common.sim.footprints import footprint, heights, overlap, within
from common.sim.objects import centre_of, world_object

Array = NDArray[np.float64]
Place = tuple[float, float]

LEVEL = 1e-3  # [m] a fixture whose top is so near to the foot of an object carries it


class StandingObjects:
    """The objects by their ids, as they stand now. A place is the middle of the box about an object (x, y) [m]."""

    def __init__(self, world: World) -> None:
        """Put every object where the world's file has it."""
        self._first = {thing.id: world_object(thing) for thing in world.objects}
        self._now = dict(self._first)
        self._fixtures = [(fixture, footprint(fixture), heights(fixture)) for fixture in world.fixtures]

    @property
    def layout(self) -> dict[str, Place]:
        """Where each stood at first."""
        return {name: centre_of(thing)[:2] for name, thing in self._first.items()}

    @property
    def places(self) -> dict[str, Place]:
        """Where each stands now."""
        return {name: centre_of(thing)[:2] for name, thing in self._now.items()}

    @property
    def solids(self) -> list[WorldObject]:
        """All of them as they stand."""
        return list(self._now.values())

    def __contains__(self, name: str) -> bool:
        return name in self._now

    def reset(self) -> None:
        """Put every object where it stood at first."""
        self._now = dict(self._first)

    def restore(self, places: Mapping[str, Place]) -> None:
        """Put objects where they were; those that there are not are passed over."""
        for name in places.keys() & self._first.keys():
            self._now[name] = _shifted(self._first[name], places[name])

    def move(self, name: str, x: float, y: float) -> None:
        """Put an object somewhere else, at the height at which it stands.

        Raises:
            Refused: it would not stand there, or reach into something.
        """
        new = _shifted(self._now[name], (x, y))
        outline = np.array(new.outline)
        if not self._carried(new, outline):
            raise Refused("off_table", f"({x:g}, {y:g}) is not on the table for {name}, which takes "
                                       f"{_size(outline)}: {self._extent(new)}")
        if blocker := self._blocker(new, outline):
            raise Refused("occupied", f"{name} at ({x:g}, {y:g}) would reach into {blocker}")
        self._now[name] = new

    def _carriers(self, thing: WorldObject) -> list[tuple[Fixture, Array]]:
        return [(fixture, shape) for fixture, shape, (_, top) in self._fixtures
                if fixture.shape != "sphere" and not any(fixture.rpy[:2]) and abs(top - thing.base) < LEVEL]

    def _carried(self, thing: WorldObject, outline: Array) -> bool:
        """Whether it would stand on one fixture; what stands on none, but on the ground, can stand anywhere there."""
        carriers = self._carriers(thing)
        return not carriers or any(within(outline, shape) for _, shape in carriers)

    def _extent(self, thing: WorldObject) -> str:
        found = []
        for fixture, shape in self._carriers(thing):
            (left, low), (right, high) = shape.min(axis=0), shape.max(axis=0)
            found.append(f"{fixture.id} is x {left:g} to {right:g}, y {low:g} to {high:g}")
        return " or ".join(found)

    def _blocker(self, thing: WorldObject, outline: Array) -> str:
        """What stands in the way; an empty string when nothing does."""
        low, high = thing.base + LEVEL, thing.base + thing.height - LEVEL
        for fixture, shape, (bottom, top) in self._fixtures:
            if bottom < high and top > low and overlap(outline, shape):
                return fixture.id
        for other in self._now.values():
            rises = other.base < high and other.base + other.height > low
            if other.id != thing.id and rises and overlap(outline, np.array(other.outline)):
                return other.id
        return ""


def _shifted(thing: WorldObject, to: Place) -> WorldObject:
    x, y, _ = centre_of(thing)
    dx, dy = to[0] - x, to[1] - y

    def shifted(edge: list[Place]) -> list[Place]:
        return [(a + dx, b + dy) for a, b in edge]

    return thing.model_copy(update={"outline": shifted(thing.outline), "hole": shifted(thing.hole)})


def _size(outline: Array) -> str:
    x, y = np.ptp(outline, axis=0)
    return f"{x:.3g} x {y:.3g} m"
