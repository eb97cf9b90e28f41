"""Where plain pictures used to be drawn: `common.sim.rendering` is where they are now."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import numpy.typing as npt

from common.config import Surroundings
from common.messages import Color, Pose, Vector3, WorldObject
from common.perception.pinhole import Pinhole
from common.sim import rendering


def draw(
    balls: npt.ArrayLike, camera: Pinhole, surroundings: Surroundings, **options: Any
) -> npt.NDArray[np.uint8]:
    """Deprecated: `common.sim.rendering.draw`, which takes objects of any shape."""
    warnings.warn("draw is in common.sim.rendering now and takes the objects of scene_objects", DeprecationWarning, 2)
    r, g, b = surroundings.ball_color
    size = 2 * surroundings.ball_radius
    objects = [
        WorldObject(id=f"ball_{number}", shape="sphere", pose=Pose(position=Vector3(x=x, y=y, z=z)),
                    size=Vector3(x=size, y=size, z=size), color=Color(r=r, g=g, b=b))
        for number, (x, y, z) in enumerate(np.asarray(balls, dtype=float).reshape(-1, 3).tolist(), 1)
    ]
    return rendering.draw(objects, camera, surroundings, **options)
