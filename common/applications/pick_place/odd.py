"""What has the colour of balls and is none that lies on the table: told by its outline and by how large it looks.

The outline of a sphere of known size at a known place is known; that of a cube or a can is another one, and a cable may
be too thin to have one. A disc, such
as the picture of a ball on a sheet, is seen as an ellipse of another shape the further it is off the axis of a camera;
straight below it cannot be told from a ball. A ball on top of something looks larger than one on the table.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from common.applications.pick_place.blobs import Outline
from common.perception.pinhole import Pinhole
from common.perception.sphere import ray_distances

Array = npt.NDArray[np.float64]

NOT_ROUND = "it has not the outline of a ball"
FLAT = "it is not as round as a ball there: flat, such as a picture of one"
THIN = "it is long and thinner than a ball, such as a cable"
BELOW = "it is seen together with one that lies higher, as on it"
EXPLAINED = 0.8  # part of the outline of a blob that lies on those of its balls, at least
MOST_OVAL = 0.55  # [px] by which the outline of a ball may be longer one way than the other
MOST_UNLIKE = 0.5  # [px] by which balls of one picture may differ in how large they look
LONG = 2.0  # diameters of a ball: what shows of one beside the arm or another ball is shorter
FALLING = 0.006  # [m] what looks so much larger is higher than a stack: it falls, or hangs in the hand
FEWEST = 3  # balls by which it is told how large they look


@dataclass(frozen=True)
class Odd:
    """What is red and no ball on the table: about where (3,) [m] in world, at which pixel, and why."""

    position: tuple[float, float, float]
    pixel: tuple[float, float]
    reason: str

    @classmethod
    def at(cls, camera: Pinhole, pixel: Array, plane: float, reason: str) -> Odd:
        """What is seen at a pixel, as if it lay at the height of balls on the table."""
        x, y = camera.on_plane(pixel, plane).tolist()
        return cls((x, y, plane), (float(pixel[0]), float(pixel[1])), reason)


def oval(outline: Outline, center: Array, camera: Pinhole) -> float:
    """By how much an outline is longer one way than across it, compared with a sphere there [m].

    The second harmonic of how far the points are outside of the silhouette, about its middle. A shadow, which eats one
    side, is in the first.

    Args:
        outline: all round.
        center: (3,) of the sphere that fits it, relative to the optical centre [m].
        camera: the camera.
    """
    distance, _ = ray_distances(outline.rays, center[None])
    from_middle = outline.pixels - camera.project(center + camera.position)
    twice = 2 * np.arctan2(from_middle[:, 1], from_middle[:, 0])
    beyond = distance[:, 0] - distance.mean()
    return float(np.hypot(2 * np.mean(beyond * np.cos(twice)), 2 * np.mean(beyond * np.sin(twice))))


def sized(offset: float, usual: float) -> str:
    """Why an outline that is further out than usual [m] is not that of a ball on the table."""
    away = 1e3 * (offset - usual)
    if away > 0:
        return f"it looks {away:.1f} mm larger than a ball on the table: it lies higher, as on another one"
    return f"it looks {-away:.1f} mm smaller than a ball on the table"


def unlike(offsets: Array, most: float) -> npt.NDArray[np.bool_]:
    """(n,) which outlines are further out or in than those of the others [m]; none where there are too few to tell."""
    if len(offsets) < FEWEST:
        return np.zeros(len(offsets), bool)
    return np.asarray(np.abs(offsets - np.median(offsets)) > most)
