"""What has the colour of balls and is none that lies on the table: told by its outline and by how large it looks.

The outline of a sphere of known size at a known place is known; that of a cube or a can is another one, and a cable may
be too thin to have one. A disc, such as the picture of a ball on a sheet, is seen as an ellipse of another shape the
further it is off the axis of a camera; straight below it cannot be told from a ball. A ball on top of something looks
larger than one on the table; where others hide its outline, it hides what could be seen between them.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
import numpy.typing as npt

from applications.pick_place.segmentation import Mask, Outline
from common.perception.pinhole import Pinhole
from common.perception.sphere import ray_distances, silhouettes

Array = npt.NDArray[np.float64]

NOT_ROUND = "it has not the outline of a ball"
FLAT = "it is not as round as a ball there: flat, such as a picture of one"
THIN = "it is long and thinner than a ball, such as a cable"
BELOW = "it is seen together with one that lies higher, as on it"
COVERED = "something lies on it and its neighbours: between them no table is seen"
EXPLAINED = 0.8  # part of the outline of a blob that lies on those of its balls, at least
MOST_OVAL = 0.55  # [px] by which the outline of a ball may be longer one way than the other
MOST_UNLIKE = 0.5  # [px] by which balls of one picture may differ in how large they look
LONG = 2.0  # diameters of a ball: what shows of one beside the arm or another ball is shorter
NEIGHBOURS = 3.5  # radii between the centres of balls that may carry one, at most: 2 sqrt(3)
GAP = 8  # [px] of the table that three balls leave to be seen, at least, for one on them to be told
BLURRED = 0.3  # [px] by which balls are taken for larger than their outlines say, so that a gap is surely one
SEEN = 0.3  # part of a gap that is not red where nothing lies on it, at least
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
    """(n,) which outlines are further out or in than those of the others [px]; none where there are too few to tell."""
    if len(offsets) < FEWEST:
        return np.zeros(len(offsets), bool)
    return np.asarray(np.abs(offsets - np.median(offsets)) > most)


def covered(centers: Array, radius: float, red: Mask, camera: Pinhole) -> bool:
    """Whether something lies on three of the balls of a blob: what they leave to be seen between them is red.

    Args:
        centers: (n, 3) relative to the optical centre [m].
        radius: of the balls, as far as they are red at most [m]: what is blurred closes a gap.
        red: what is red, not closed.
        camera: the camera.
    """
    places = centers + camera.position
    apart = np.linalg.norm(places[:, None] - places, axis=2)
    near = [trio for trio in combinations(range(len(places)), 3)
            if max(apart[a, b] for a, b in combinations(trio, 2)) < NEIGHBOURS * radius]
    if not near:
        return False
    drawn = silhouettes(camera, places, radius, 32)
    if not np.isfinite(drawn).all():
        return False
    outlines = np.rint(drawn).astype(np.int32)
    middles = np.rint(camera.project(places)).astype(np.int32)
    for trio in near:
        corner = middles[list(trio)].min(axis=0)
        if (corner < 0).any():
            continue
        width, height = (np.ptp(middles[list(trio)], axis=0) + 1).tolist()
        free = np.zeros((height, width), np.uint8)
        cv2.fillConvexPoly(free, middles[list(trio)] - corner, 255)
        for outline in outlines:
            cv2.fillConvexPoly(free, outline - corner, 0)
        part = red[corner[1]:corner[1] + height, corner[0]:corner[0] + width]
        if part.shape != free.shape:  # it reaches out of the picture
            continue
        gap = cv2.countNonZero(free)
        if gap >= GAP and cv2.countNonZero(cv2.subtract(free, part)) < SEEN * gap:
            return True
    return False
