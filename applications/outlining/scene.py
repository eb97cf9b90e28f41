"""The planning scene of a cell that outlines objects: what is fixed, and every solid that a picture showed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from applications.outlining.messages import Contours
from applications.outlining.perceived_solids import PerceivedSolid
from common import messages as m
from common.config import Surroundings
from common.perception.camera_input import FrameError, require_in_range
from common.scene.fixtures import fixture_objects

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
