"""Perceived objects as upright solids of the planning scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from applications.outlining.contours import is_hole
from applications.outlining.top_face import TopFaceOptions, top_face
from applications.outlining.topics import Contour, Contours
from common import messages as m
from common.config import Surroundings
from common.messages import Color
from common.perception.camera_input import FrameError, require_in_range
from common.perception.depth import Depth, DepthError
from common.perception.pinhole import Pinhole
from common.scene.fixtures import fixture_objects

Array = npt.NDArray[np.float64]

SAME = 1e-9  # points nearer than this are one [m]


def without_duplicates(points: npt.ArrayLike) -> Array:
    """Points (n, d) [m] of a closed outline without those that equal the one before, or at the end the first one."""
    p = np.asarray(points, dtype=float)
    if len(p) < 2:
        return p
    kept = p[np.concatenate([[True], np.linalg.norm(np.diff(p, axis=0), axis=1) > SAME])]
    if len(kept) > 1 and np.linalg.norm(kept[-1] - kept[0]) <= SAME:
        kept = kept[:-1]
    return np.asarray(kept)


def simplified(points: npt.ArrayLike, tolerance: float) -> Array:
    """Those of the points (n, d) [m] of a closed outline without which it would move by more than the tolerance [m].

    Douglas and Peucker, "Algorithms for the reduction of the number of points" (1973), begun at the first point and the
    one that is farthest from it. The first point stays the first.
    """
    p = np.asarray(points, dtype=float)
    if len(p) < 4 or tolerance <= 0:
        return p
    closed = np.vstack([p, p[:1]])
    far = int(np.argmax(np.linalg.norm(p - p[0], axis=1)))
    keep = np.zeros(len(closed), bool)
    keep[[0, far, len(p)]] = True
    parts = [(0, far), (far, len(p))]
    while parts:
        first, last = parts.pop()
        if last - first < 2:
            continue
        distance = _distance(closed[first + 1 : last], closed[first], closed[last])
        worst = int(np.argmax(distance))
        if distance[worst] > tolerance:
            middle = first + 1 + worst
            keep[middle] = True
            parts += [(first, middle), (middle, last)]
    return np.asarray(p[keep[:-1]])


def _distance(points: Array, a: Array, b: Array) -> Array:
    """Distances (n,) of points from the line segment between a and b."""
    side = b - a
    along = np.clip((points - a) @ side / max(float(side @ side), SAME**2), 0.0, 1.0)
    return np.asarray(np.linalg.norm(points - (a + along[:, None] * side), axis=1))


@dataclass(frozen=True, eq=False)
class PerceivedSolid:
    """A prism: `outline` (n, 2) [m] in world, from the height `base` upwards by `height` [m].

    `index` is that of its contour. `touches_border` solids may go on outside of the picture.
    """

    index: int
    label: str
    outline: Array
    base: float
    height: float
    color: Color
    touches_border: bool


def perceived_solids(
    contours: Sequence[Contour], depth: Depth, camera: Pinhole, *, floor: float = 0.0, tolerance: float = 0.001
) -> list[PerceivedSolid]:
    """A solid for every object of the picture whose depth is known.

    Args:
        contours: of the picture; holes are filled, which is on the safe side.
        depth: image (height, width) [m].
        camera: that took both.
        floor: height [m] down to which an object is thought to go when nothing around it is within the range.
        tolerance: by which outlines are simplified [m].
    """
    solids = []
    for contour in contours:
        if is_hole(contours, contour.index) or len(contour.pixels) < 3:
            continue
        try:
            face = top_face(contour.pixels, depth, camera, TopFaceOptions())
        except DepthError:  # such as the ground: out of the camera's range, so out of the arm's way
            continue
        outline = simplified(without_duplicates(face.outline[:, :2]), tolerance)
        base = floor if face.base is None else face.base
        if len(outline) >= 3 and face.top > base:
            solids.append(PerceivedSolid(
                contour.index, contour.label, outline, base, face.top - base, contour.color, contour.touches_border
            ))
    return solids


MOST_PICTURES = 20  # that the boxes about all contours of a picture cover together: to look into more takes minutes
MOST, MOST_CORNERS, MOST_OF_ONE = 400, 5000, 2000  # solids and corners that a planning scene has room for


def require_apart(contours: Contours) -> None:
    """Return when contours lie so much beside one another in their picture as those of things do.

    Raises:
        FrameError: they do not.
    """
    covered = 0.0
    for contour in contours.contours:
        pixels = np.clip(np.array(contour.pixels), 0, (contours.width, contours.height))
        covered += float(np.prod(pixels.max(axis=0) - pixels.min(axis=0)))
    if covered > MOST_PICTURES * contours.width * contours.height:
        raise FrameError("crowded", f"its {len(contours.contours)} contours cover it more than {MOST_PICTURES} times")


def planning_scene(around: Surroundings, solids: Sequence[PerceivedSolid], stamp: int) -> m.PlanningScene:
    """Fixtures and perceived solids, in world, as seen in the picture with that stamp.

    Raises:
        FrameError: more is seen, or farther away, than there is room for; what stands somewhere is not left out of a
            scene.
    """
    corners = [len(solid.outline) for solid in solids]
    if len(corners) > MOST or sum(corners) > MOST_CORNERS or max(corners, default=0) > MOST_OF_ONE:
        raise FrameError("crowded", f"{len(corners)} objects with {sum(corners)} corners are more than a planning "
                                    "scene has room for: is the image full of noise?")
    for solid in solids:
        require_in_range(solid.outline)
        require_in_range((solid.base, solid.base + solid.height))
    header = m.Header(stamp=stamp, frame_id="world")
    return m.PlanningScene(header=header, objects=[*fixture_objects(around), *map(collision_object, solids)])


def collision_object(solid: PerceivedSolid) -> m.CollisionObject:
    """A perceived solid as an upright prism; its id is the label of its contour."""
    x, y = (solid.outline.min(axis=0) + solid.outline.max(axis=0)) / 2
    return m.CollisionObject(
        id=solid.label, role="target", shape="prism", dimensions=[solid.height], color=solid.color,
        outline=[(float(u), float(v)) for u, v in solid.outline - np.array([x, y])],
        pose=m.Pose(position=m.Vector3(x=float(x), y=float(y), z=solid.base + solid.height / 2)),
    )
