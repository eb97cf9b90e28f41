"""Where an object is put: a free spot of its container, or of the tray, and the height of the tool there."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from applications.sorting.topics import SeenObject
from common.config import Container

SPACING = 0.05  # [m] between spots
OFF_WALLS = 0.015  # [m] between an object and the walls
SPREAD = 0.04  # [m] of the region around a spot in which the tool may release
ABOVE = 0.02  # [m] of the lowest point of the held object above walls and contents
MOST_FILLED = 0.10  # [m] above its walls that a container may be filled


@dataclass(frozen=True)
class Dropped:
    """An object that was released: not every picture shows it."""

    container: str
    place: tuple[float, float]
    size: float  # [m] its radius from above
    height: float  # [m]


@dataclass(frozen=True)
class Spot:
    """A position (x, y) [m] in a container, and the height of the highest thing there, in world [m]."""

    x: float
    y: float
    top: float


class Full(Exception):
    """Why a container takes no more objects."""


def spots(box: Container, radius: float) -> Iterator[tuple[float, float]]:
    """Yield positions (x, y) of a grid in a container at which an object of this radius [m] is clear of its walls."""
    room = max(0.0, box.half_side - box.wall_thickness - OFF_WALLS - radius - SPREAD / 2)
    steps = int(room / SPACING)
    for i in range(-steps, steps + 1):
        for j in range(-steps, steps + 1):
            yield box.x + i * SPACING, box.y + j * SPACING


def free_spot(
    box: Container, radius: float, seen: Sequence[SeenObject], dropped: Sequence[Dropped], floor: float,
    skipped: int = 0,
) -> Spot:
    """Return the spot where what lies there is lowest, and of equal ones the one farthest from the contents.

    Args:
        box: the container.
        radius: of the object from above [m].
        seen: objects in the container.
        dropped: released objects that may not be seen yet.
        floor: height of the table in world [m].
        skipped: number of better spots that were tried without success.

    Raises:
        Full: the contents are too high everywhere.
    """
    contents = [((thing.center.x, thing.center.y), max(thing.size.x, thing.size.y) / 2, thing.top) for thing in seen]
    contents += [(each.place, each.size, floor + box.floor_thickness + each.height) for each in dropped
                 if all(math.dist(each.place, at) > each.size for at, _, _ in contents)]

    def rank(place: tuple[float, float]) -> tuple[float, float]:
        gap = min((math.dist(place, at) - size for at, size, _ in contents), default=math.inf)
        return round(top_at(place), 2), -gap

    def top_at(place: tuple[float, float]) -> float:
        return max((top for at, size, top in contents if math.dist(place, at) < size + radius),
                   default=floor + box.floor_thickness)

    ranked = sorted(spots(box, radius), key=rank)
    x, y = ranked[min(skipped, len(ranked) - 1)]
    if (top := top_at((x, y))) > floor + box.wall_height + MOST_FILLED:
        raise Full(f"container {box.id} is full: its contents reach {1e3 * (top - floor):.0f} mm above the table")
    return Spot(x, y, top)


def release_height(box: Container, spot: Spot, floor: float, below: float) -> float:
    """Return the height of the tool in world [m] at which the held object clears walls and contents.

    Args:
        box: the container.
        spot: in it.
        floor: height of the table [m].
        below: of the held object, below the tool [m].
    """
    return max(floor + box.wall_height, spot.top) + ABOVE + below
