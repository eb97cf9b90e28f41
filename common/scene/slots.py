"""The places of equal spheres in a container, and which of them are taken as seen in the picture."""

from __future__ import annotations

from collections.abc import Collection, Iterable

import numpy as np
from numpy.typing import NDArray

from common.config import Container
from common.perception.pinhole import Pinhole

Array = NDArray[np.float64]


def slot_positions(box: Container, radius: float, table_height: float) -> Array:
    """Centres (layers, 4, 3) of the spheres that fill the container [m], world: 2 x 2 in each layer.

    A layer stands straight on the one below it.
    """
    d = box.slot_offset
    corners = [(-d, -d), (-d, d), (d, -d), (d, d)]
    lowest = table_height + box.floor_thickness + radius
    return np.array([
        [(box.x + dx, box.y + dy, lowest + 2 * radius * layer) for dx, dy in corners] for layer in range(box.layers)
    ])


def column_at(box: Container, place: tuple[float, float]) -> tuple[float, float]:
    """(x, y) of the column of slots that is nearest to a place [m], world."""
    d = box.slot_offset
    return box.x + (d if place[0] > box.x else -d), box.y + (d if place[1] > box.y else -d)


def low_columns(box: Container, places: Iterable[tuple[float, float, float]], same: float) -> list[tuple[float, float]]:
    """(x, y) of the columns of slots in which least lies, which may be all of them [m], world.

    Args:
        box: the container.
        places: centres of what lies in it or is about to [m], world; each is in the column that it is nearest to.
        same: columns whose uppermost centres differ by less are as high [m].
    """
    d = box.slot_offset
    heights = {(box.x + dx, box.y + dy): -np.inf for dx in (-d, d) for dy in (-d, d)}
    for x, y, z in places:
        if max(abs(x - box.x), abs(y - box.y)) <= box.half_side:
            column = column_at(box, (x, y))
            heights[column] = max(heights[column], z)
    least = min(heights.values())
    return [column for column, height in heights.items() if height == least or height - least < same]


def occupied_slots(
    pixels: Iterable[tuple[float, float]], camera: Pinhole, slots: Array, radius: float, free: Collection[int] = ()
) -> tuple[set[int], set[int]]:
    """Which slots hold a sphere that is seen, and which one that cannot be, as indices.

    Each seen sphere belongs to the slot whose centre is imaged nearest to it, the nearest pairs first, one to one.
    Below one that is seen stand those that carry it, though they are hidden; but none in a slot that is known to be
    free: above that it hangs or falls.

    Args:
        pixels: (u, v) of the spheres that are seen inside the container.
        camera: with its pose in world.
        slots: (n, 3) [m], world, as `slot_positions` has them, in its order.
        radius: of a sphere [m].
        free: slots that hold a sphere only if it is seen.
    """
    images = camera.project(slots)
    seen = np.array(list(pixels)).reshape(-1, 2)
    reach = camera.fx * radius / float(np.min(camera.to_camera(slots)[:, 2]))
    away = images[:, None] - seen
    distances = np.hypot(away[..., 0], away[..., 1])
    near = np.argwhere(distances <= reach).tolist()
    taken: set[int] = set()
    matched: set[int] = set()
    for slot, number in sorted(near, key=lambda pair: distances[pair[0], pair[1]]):
        if slot in taken or number in matched:
            continue
        taken.add(slot)
        matched.add(number)
    carriers = {slot - 4 * below for slot in taken for below in range(1, slot // 4 + 1)}
    return taken, carriers - taken - set(free)
