"""Spheres of the simulated world as messages and images."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from common.config import Surroundings
from common.messages import Color, Pose, Vector3, WorldObject, WorldObjects
from common.perception.pinhole import Pinhole
from common.sim.rendering import draw


def spheres(centres: npt.ArrayLike, around: Surroundings | None = None, states: Sequence[str] = ()) -> WorldObjects:
    """Return spheres at centers (n, 3) [m], with the size and color of the surroundings."""
    usual = around or Surroundings()
    r, g, b = usual.ball_color
    size = 2 * usual.ball_radius
    places = np.asarray(centres, dtype=float).reshape(-1, 3)
    return WorldObjects(objects=[
        WorldObject.model_validate({
            "id": f"ball_{number + 1}", "shape": "sphere", "pose": Pose(position=Vector3(x=x, y=y, z=z)),
            "size": Vector3(x=size, y=size, z=size), "color": Color(r=r, g=g, b=b),
            "state": states[number] if states else "table",
        })
        for number, (x, y, z) in enumerate(places.tolist())
    ])


def draw_spheres(
    centres: npt.ArrayLike, camera: Pinhole, around: Surroundings, **options: Any
) -> npt.NDArray[np.uint8]:
    """Render a plain image of spheres."""
    return draw(spheres(centres, around).objects, camera, around, **options)
