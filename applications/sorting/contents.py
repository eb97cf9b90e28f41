"""What lies in a container: whether more objects arrived than were released there."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import BaseModel

from applications.sorting.topics import SeenObject

APART = 0.020  # [m] between outlines of the same color that are two objects
SAME_COLOR = 0.2  # distance of red, green, blue, each 0 to 1, of one color that has two names
LEAST_VOLUME = 5e-6  # [m^3] less is noise


class Contents(BaseModel):
    """What an image showed in a container, and what was released there since.

    Attributes:
        things: in the newest image that shows the container.
        most: by color, the most objects that were seen at once or released.
        pending: color names of the objects that were released after that image.
    """

    things: list[SeenObject] = []
    most: dict[str, int] = {}
    pending: list[str] = []

    def updated(self, images: Sequence[Sequence[SeenObject]]) -> Contents:
        """Return the contents that images show, the newest last, without pending releases."""
        released, most = Counter(self.pending), dict(self.most)
        seen = [Counter(thing.color_name for thing in things) for things in images]
        for color in {*most, *released, *(each for counts in seen for each in counts)}:
            most[color] = max(most.get(color, 0) + released[color], *(counts[color] for counts in seen))
        return Contents(things=list(images[-1]), most=most)

    def more(self, images: Sequence[Sequence[SeenObject]]) -> tuple[int, list[SeenObject]]:
        """Return how many objects arrived in addition to the released ones, and all that are new in the newest image.

        An object counts if every image shows that there are more objects, and more of its color, than ever before: what
        was covered and is visible now, what was pushed, and one object that is seen as two are not new.

        Args:
            images: objects in the container in each image, the newest last.
        """
        found = [self._new(things) for things in images]
        growth = min(min(len(new), len(things) - len(self.things)) for new, things in zip(found, images, strict=True))
        extra = min(max(0, growth - len(self.pending)), len(self.pending))
        return extra, found[-1] if extra else []

    def _new(self, things: Sequence[SeenObject]) -> list[SeenObject]:
        known = {thing.id for thing in self.things}
        new: list[SeenObject] = []
        groups = sorted(separate(things), key=lambda thing: thing.id in known)
        for color, count in Counter(thing.color_name for thing in groups).items():
            more = max(0, count - self.most.get(color, 0))
            new += [thing for thing in groups if thing.color_name == color][:more]
        return new


def separate(things: Sequence[SeenObject]) -> list[SeenObject]:
    """Return the objects that are certainly different ones: of other colors, or far from each other."""
    found: list[SeenObject] = []
    for thing in sorted(things, key=lambda each: -each.volume):
        if thing.volume >= LEAST_VOLUME and not any(
                same_color(thing, other) and gap(thing, other) <= APART for other in found):
            found.append(thing)
    return found


def same_color(one: SeenObject, other: SeenObject) -> bool:
    """Return whether two objects have one color, which may have two names."""
    a, b = one.color, other.color
    return one.color_name == other.color_name or math.dist((a.r, a.g, a.b), (b.r, b.g, b.b)) < SAME_COLOR


def gap(one: SeenObject, other: SeenObject) -> float:
    """Return the distance between the outlines of two objects [m]; 0 if they overlap."""
    a, b = _outline(one), _outline(other)
    inside = [cv2.pointPolygonTest(polygon, (float(x), float(y)), True)
              for polygon, points in ((a, b), (b, a)) for x, y in points]
    return max(0.0, -max(inside)) / 1000


def _outline(thing: SeenObject) -> npt.NDArray[np.float32]:
    """Return the corners (n, 2) [mm] of an object; of the rectangle of its size without an outline."""
    if len(thing.outline) > 2:
        return np.array(thing.outline, np.float32) * 1000
    box = ((thing.center.x, thing.center.y), (thing.size.x, thing.size.y), math.degrees(thing.yaw))
    return np.asarray(cv2.boxPoints(box), np.float32) * 1000
