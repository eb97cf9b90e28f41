"""Find the objects on a surface: in the tray, in the other containers and on the table; with ids that are stable."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from applications.sorting.describing import Segment, described
from applications.sorting.places import TABLE, containers_of, features, in_container, on_table
from applications.sorting.seeing import crop
from applications.sorting.segments import segments
from applications.sorting.surface import Surface
from applications.sorting.topics import MAX_OBJECTS, SeenObject
from common.config import Surroundings

Labels = npt.NDArray[np.int32]
Bools = npt.NDArray[np.bool_]
Values = npt.NDArray[np.float32]

PAD = 4  # [cells] around a segment that its description uses
MARGIN = 0.01  # [m] around a container
SAME_PLACE = 0.02  # [m] an object whose center moved less did not move
SAME_SIZE = 0.03  # [m] largest difference of length, width or top of one object in two images
SAME_TOP = 0.02  # [m] difference of heights
SAME_COLOR = 0.3  # difference of red, green or blue, each 0 to 1
COVERED = 0.5  # fraction of the smaller one that both cover
FADES = 5  # images after which an object that is not seen is forgotten


def find_objects(
    surface: Surface, world: Surroundings, before: Labels | None = None
) -> tuple[Labels, list[SeenObject]]:
    """Return all objects of a surface of containers and the table around them.

    Args:
        surface: at most a part of the world.
        world: its containers and fixtures, which are no objects.
        before: labels of the image before, if it was of the same grid.

    Returns:
        labels (rows, columns): k + 1 at the cells of object k, 0 elsewhere; and the objects, with ids 1, 2, ...
    """
    labels = np.zeros(surface.top.shape, np.int32)
    found: list[SeenObject] = []
    containers = containers_of(world)
    gain = np.ones(3, np.float32)
    for place in containers:
        area = place.area(MARGIN)
        piece, part = crop(surface, area)
        if piece.top.size == 0:
            continue
        colors = features(piece.color)
        inside = in_container(piece, colors, place)
        gain = inside.gain
        _add(found, labels[part], piece, colors, inside.mask, inside.near_wall, inside.gain, place.id, place.floor,
             None if before is None else before[part])
    mask = on_table(surface, containers, world)
    for part in _islands(mask):
        piece = _piece(surface, part)
        nowhere = np.zeros(piece.top.shape, bool)
        _add(found, labels[part], piece, features(piece.color), mask[part], nowhere, gain, TABLE, world.table_height,
             None if before is None else before[part])
    return labels, found


def _add(
    found: list[SeenObject], labels: Labels, piece: Surface, colors: Values, mask: Bools, near_wall: Bools,
    gain: Values, place: str, floor: float, before: Labels | None,
) -> None:
    """Append the objects of a mask to those found, and write their labels."""
    if not mask.any():
        return
    parts = segments(mask, piece.top, colors, before)
    boxes = _boxes(parts.labels, parts.count)
    for number, box in enumerate(boxes, 1):
        if len(found) >= MAX_OBJECTS:
            return
        cells = parts.labels[box] == number
        segment = Segment(cells, _piece(piece, box), (parts.labels[box] > 0) & ~cells, near_wall[box], gain,
                          number in parts.patched)
        found.append(described(segment, str(len(found) + 1), place, floor))
        labels[box][cells] = len(found)


def _boxes(labels: Labels, count: int) -> list[tuple[slice, slice]]:
    """Rows and columns of each label with a margin of `PAD`."""
    rows, columns = np.nonzero(labels)
    number = labels[rows, columns]
    low, high = np.full((count + 1, 2), 2**30), np.full((count + 1, 2), -1)
    for axis, at in ((0, rows), (1, columns)):
        np.minimum.at(low[:, axis], number, at)
        np.maximum.at(high[:, axis], number, at)
    low = np.maximum(low - PAD, 0)
    return [(slice(int(low[k, 0]), int(high[k, 0]) + PAD + 1), slice(int(low[k, 1]), int(high[k, 1]) + PAD + 1))
            for k in range(1, count + 1)]


def _islands(mask: Bools) -> list[tuple[slice, slice]]:
    """Rows and columns of regions around the connected parts of a mask; parts that are near are in one region."""
    if not mask.any():
        return []
    near = cv2.dilate(mask.astype(np.uint8), np.ones((2 * PAD + 1, 2 * PAD + 1), np.uint8))
    count, labels, _, _ = cv2.connectedComponentsWithStats(near)
    return _boxes(np.asarray(labels * mask, np.int32), count - 1)


def _piece(surface: Surface, part: tuple[slice, slice]) -> Surface:
    rows, columns = part
    origin = (surface.origin[0] + surface.step * columns.start, surface.origin[1] + surface.step * rows.start)
    return Surface(origin, surface.step, surface.top[part], surface.color[part], surface.floor)


class Identities:
    """Gives objects the ids of those that were at the same places in earlier images, and others new ones."""

    def __init__(self) -> None:
        """Start without objects."""
        self._known: dict[str, tuple[SeenObject, int]] = {}
        self._before: tuple[Labels, list[SeenObject]] | None = None
        self._next, self._image = 1, 0

    def named(self, found: Sequence[SeenObject], labels: Labels | None = None) -> list[SeenObject]:
        """Return the objects of the newest image with their ids, in the same order.

        Args:
            found: in the newest image.
            labels: (rows, columns) k + 1 at the cells of found[k]; objects that cover the same cells in two images are
                the same ones even if their visible size differs.
        """
        self._image += 1
        pairs = [
            (distance, index, name)
            for index, seen in enumerate(found) for name, (known, _) in self._known.items()
            if (distance := _difference(seen, known)) < 1]
        pairs = sorted([*self._covering(found, labels), *pairs])
        names: dict[int, str] = {}
        for _, index, name in pairs:
            if index not in names and name not in names.values():
                names[index] = name
        result = []
        for index, seen in enumerate(found):
            if index not in names:
                names[index] = f"o{self._next}"
                self._next += 1
            named = seen.model_copy(update={"id": names[index]})
            self._known[names[index]] = named, self._image
            result.append(named)
        self._known = {name: item for name, item in self._known.items() if self._image - item[1] < FADES}
        self._before = None if labels is None else (labels, result)
        return result

    def _covering(self, found: Sequence[SeenObject], labels: Labels | None) -> list[tuple[float, int, str]]:
        """Return pairs of objects of this image and the one before that cover the same cells; negative sorts first."""
        if labels is None or self._before is None or self._before[0].shape != labels.shape:
            return []
        earlier, objects = self._before
        width = len(objects) + 1
        both = (labels > 0) & (earlier > 0)
        common = np.bincount(
            labels[both].astype(np.int64) * width + earlier[both], minlength=(len(found) + 1) * width
        ).reshape(-1, width)
        sizes = np.bincount(labels[labels > 0], minlength=len(found) + 1)
        sizes_before = np.bincount(earlier[earlier > 0], minlength=width)
        pairs = []
        for a, b in np.argwhere(common > 0).tolist():
            share = common[a, b] / max(1, min(sizes[a], sizes_before[b]))
            if share > COVERED and _alike(found[a - 1], objects[b - 1]):
                union = sizes[a] + sizes_before[b] - common[a, b]
                pairs.append((-float(common[a, b] / union), a - 1, objects[b - 1].id))
        return pairs


def _alike(a: SeenObject, b: SeenObject) -> bool:
    """Return whether two objects have about the same height and color."""
    color = max(abs(a.color.r - b.color.r), abs(a.color.g - b.color.g), abs(a.color.b - b.color.b))
    return a.place == b.place and abs(a.top - b.top) < SAME_TOP and color < SAME_COLOR


def _difference(a: SeenObject, b: SeenObject) -> float:
    """Return how different two objects are; from 1 on they are not the same one at the same place."""
    away = math.hypot(a.center.x - b.center.x, a.center.y - b.center.y) / SAME_PLACE
    size = max(abs(a.size.x - b.size.x), abs(a.size.y - b.size.y), abs(a.top - b.top)) / SAME_SIZE
    return max(away, size) if a.place == b.place else 1.0

