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

SAME = 1e-9  # points closer than this are equal [m]


def without_duplicates(points: npt.ArrayLike) -> Array:
    """Return points (n, d) [m] of a closed outline without consecutive duplicates, also across its end."""
    p = np.asarray(points, dtype=float)
    if len(p) < 2:
        return p
    distinct = p[np.concatenate([[True], np.linalg.norm(np.diff(p, axis=0), axis=1) > SAME])]
    if len(distinct) > 1 and np.linalg.norm(distinct[-1] - distinct[0]) <= SAME:
        distinct = distinct[:-1]
    return np.asarray(distinct)


def simplified(points: npt.ArrayLike, tolerance: float) -> Array:
    """Return the points (n, d) [m] of a closed outline needed to keep it within the tolerance [m].

    Douglas and Peucker, "Algorithms for the reduction of the number of points" (1973), started with the first point and
    the one farthest from it. The first point stays the first.
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
    """Return the distances (n,) of points from the line segment between a and b."""
    side = b - a
    along = np.clip((points - a) @ side / max(float(side @ side), SAME**2), 0.0, 1.0)
    return np.asarray(np.linalg.norm(points - (a + along[:, None] * side), axis=1))


@dataclass(frozen=True, eq=False)
class PerceivedSolid:
    """A prism: `outline` (n, 2) [m] in world, from the height `base` upwards by `height` [m].

    `index` is that of its contour. A solid with `touches_border` may extend beyond the image.
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
    """Return a solid for every object of the image with known depth.

    Args:
        contours: of the image; holes are filled, which is the safe side.
        depth: image (height, width) [m].
        camera: that took both.
        floor: height [m] assumed below an object without anything lower within range around it.
        tolerance: for simplified outlines [m].
    """
    solids = []
    for contour in contours:
        if is_hole(contours, contour.index) or len(contour.pixels) < 3:
            continue
        try:
            face = top_face(contour.pixels, depth, camera, TopFaceOptions())
        except DepthError:  # such as the ground: out of the camera's range, so out of the arm's reach
            continue
        outline = simplified(without_duplicates(face.outline[:, :2]), tolerance)
        base = floor if face.base is None else face.base
        if len(outline) >= 3 and face.top > base:
            solids.append(PerceivedSolid(
                contour.index, contour.label, outline, base, face.top - base, contour.color, contour.touches_border
            ))
    return solids


MOST_PICTURES = 20  # image areas that the bounding boxes of all contours may cover together: more takes minutes
MOST, MOST_CORNERS, MOST_OF_ONE = 400, 5000, 2000  # limits of a planning scene: solids, corners of all, corners of one


def require_apart(contours: Contours) -> None:
    """Return if the contours overlap no more than those of real objects.

    Raises:
        FrameError: they overlap more.
    """
    covered = 0.0
    for contour in contours.contours:
        pixels = np.clip(np.array(contour.pixels), 0, (contours.width, contours.height))
        covered += float(np.prod(pixels.max(axis=0) - pixels.min(axis=0)))
    if covered > MOST_PICTURES * contours.width * contours.height:
        raise FrameError("crowded", f"its {len(contours.contours)} contours cover it more than {MOST_PICTURES} times")


def planning_scene(around: Surroundings, solids: Sequence[PerceivedSolid], stamp: int) -> m.PlanningScene:
    """Return fixtures and perceived solids in world, with the stamp of their image.

    Raises:
        FrameError: more objects, or farther ones, than fit; none may be missing from a planning scene.
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
    """Convert a perceived solid to an upright prism; its id is the label of its contour."""
    x, y = (solid.outline.min(axis=0) + solid.outline.max(axis=0)) / 2
    return m.CollisionObject(
        id=solid.label, role="target", shape="prism", dimensions=[solid.height], color=solid.color,
        outline=[(float(u), float(v)) for u, v in solid.outline - np.array([x, y])],
        pose=m.Pose(position=m.Vector3(x=float(x), y=float(y), z=solid.base + solid.height / 2)),
    )
