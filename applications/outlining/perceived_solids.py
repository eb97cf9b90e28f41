"""The objects in a picture as upright solids, for the planning scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from applications.outlining.contours import is_hole
from applications.outlining.duplicates import simplified, without_duplicates
from applications.outlining.messages import Contour
from applications.outlining.top_face import TopFaceOptions, top_face
from common.messages import Color
from common.perception.depth import Depth, DepthError
from common.perception.pinhole import Pinhole

Array = npt.NDArray[np.float64]


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
