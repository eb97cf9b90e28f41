"""Detect red objects that are no ball on the table, by the shape and the apparent size of their outline.

The outline of a sphere of known size and position is known; a cube or a can has another one, and a cable may be too
thin for one. A disc, such as a printed ball, is an ellipse of another shape the farther it is off the camera axis;
straight below the camera it looks like a ball. A ball on top of something looks larger than one on the table. Where
others occlude its outline, it covers the gaps between them.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
import numpy.typing as npt

from applications.pick_place.segmentation import Mask, Outline
from common.perception.pinhole import Pinhole, ray_distances, silhouettes

Array = npt.NDArray[np.float64]

NOT_ROUND = "it has not the outline of a ball"
FLAT = "it is not as round as a ball there: flat, such as a picture of one"
THIN = "it is long and thinner than a ball, such as a cable"
BELOW = "it is seen together with one that lies higher, as on it"
COVERED = "something lies on it and its neighbours: between them no table is seen"
EXPLAINED = 0.8  # smallest fraction of a blob's outline that its balls must explain
MOST_OVAL = 0.55  # [px] by which the outline of a ball may be longer in one direction
MOST_UNLIKE = 0.5  # [px] by which the apparent sizes of balls in one image may differ
LONG = 2.0  # ball diameters; the visible part of a ball next to the arm or another ball is shorter
NEIGHBOURS = 3.5  # largest distance between the centers of balls that may carry another, in radii: 2 sqrt(3)
GAP = 8  # [px] smallest visible gap between three balls that proves no ball lies on them
BLURRED = 0.3  # [px] by which the balls are enlarged, so that a gap is certain
SEEN = 0.3  # fraction of a gap that is not red if nothing lies on it
FALLING = 0.006  # [m] an object that looks this much larger is above any stack: falling, or held
FEWEST = 3  # balls needed to measure the usual apparent size


@dataclass(frozen=True)
class Outlier:
    """A red object that is no ball on the table: approximate position (3,) [m] in world, pixel, and reason."""

    position: tuple[float, float, float]
    pixel: tuple[float, float]
    reason: str

    @classmethod
    def at(cls, camera: Pinhole, pixel: Array, plane: float, reason: str) -> Outlier:
        """Return the outlier seen at a pixel, at the height of balls on the table."""
        x, y = camera.on_plane(pixel, plane).tolist()
        return cls((x, y, plane), (float(pixel[0]), float(pixel[1])), reason)


def oval(outline: Outline, center: Array, camera: Pinhole) -> float:
    """Return by how much an outline is longer in one direction, compared with a sphere there [m].

    This is the second harmonic of the points' distance from the silhouette around its center. A shadow on one side only
    affects the first.

    Args:
        outline: complete outline.
        center: (3,) of the fitted sphere, relative to the optical center [m].
        camera: the camera.
    """
    distance, _ = ray_distances(outline.rays, center[None])
    from_middle = outline.pixels - camera.project(center + camera.position)
    twice = 2 * np.arctan2(from_middle[:, 1], from_middle[:, 0])
    beyond = distance[:, 0] - distance.mean()
    return float(np.hypot(2 * np.mean(beyond * np.cos(twice)), 2 * np.mean(beyond * np.sin(twice))))


def sized(offset: float, usual: float) -> str:
    """Return why an outline with this offset, compared with the usual one [m], is no ball on the table."""
    away = 1e3 * (offset - usual)
    if away > 0:
        return f"it looks {away:.1f} mm larger than a ball on the table: it lies higher, as on another one"
    return f"it looks {-away:.1f} mm smaller than a ball on the table"


def unlike(offsets: Array, most: float) -> npt.NDArray[np.bool_]:
    """(n,) outlines whose offset differs from that of the others [px]; none if there are too few."""
    if len(offsets) < FEWEST:
        return np.zeros(len(offsets), bool)
    return np.asarray(np.abs(offsets - np.median(offsets)) > most)


def covered(centers: Array, radius: float, red: Mask, camera: Pinhole) -> bool:
    """Return whether something lies on three of a blob's balls: the gap between them is red.

    Args:
        centers: (n, 3) relative to the optical center [m].
        radius: largest red extent of the balls [m]: blur closes a gap.
        red: red pixels, before closing.
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
        if part.shape != free.shape:  # outside of the image
            continue
        gap = cv2.countNonZero(free)
        if gap >= GAP and cv2.countNonZero(cv2.subtract(free, part)) < SEEN * gap:
            return True
    return False
