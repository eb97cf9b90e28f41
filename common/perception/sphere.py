"""How a sphere looks: the cone of rays that touch it.

A ray with unit direction d from the optical centre touches the sphere with centre c (relative to the optical centre)
and radius r exactly where its distance from c, |c - (c . d) d|, is r. In the picture that is a conic, not a circle
about the image of the centre, which is why centroids are a little off and outlines are not.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from common.perception.pinhole import Pinhole

Array = npt.NDArray[np.float64]


def silhouette(camera: Pinhole, center: npt.ArrayLike, radius: float, count: int = 64) -> Array:
    """Pixels (count, 2) on the outline of a sphere, all the way round.

    Args:
        camera: the camera.
        center: (3,) in world [m].
        radius: [m].
        count: number of points.

    Returns:
        (count, 2) [px]; empty (0, 2) when the sphere is not wholly in front of the optical centre.
    """
    c = np.asarray(center, dtype=float) - camera.position
    distance = float(np.linalg.norm(c))
    if distance <= radius or float(camera.to_camera(center)[2]) <= radius:
        return np.empty((0, 2))
    axis = c / distance
    # All tangent points lie on a circle in front of the centre.
    sine = radius / distance
    middle = camera.position + axis * distance * (1 - sine**2)
    around = radius * math.sqrt(1 - sine**2)
    first = np.cross(axis, (1.0, 0.0, 0.0) if abs(axis[0]) < 0.9 else (0.0, 1.0, 0.0))
    first /= np.linalg.norm(first)
    second = np.cross(axis, first)
    angle = np.linspace(0.0, 2 * math.pi, count, endpoint=False)[:, None]
    return camera.project(middle + around * (np.cos(angle) * first + np.sin(angle) * second))


def ray_distances(directions: Array, center: Array) -> tuple[Array, Array]:
    """Distance of rays from a point and the direction from each ray to it.

    Args:
        directions: (n, 3) unit vectors of rays from the optical centre.
        center: (3,) relative to the optical centre [m].

    Returns:
        (n,) distances [m], and (n, 3) unit vectors: the gradient of the distance in the centre.
    """
    away = center - (directions @ center)[:, None] * directions
    distance = np.sqrt(np.einsum("ij,ij->i", away, away))
    return distance, away / np.maximum(distance, 1e-12)[:, None]


def wholly_in_view(camera: Pinhole, center: npt.ArrayLike, radius: float, margin: float = 0.0) -> bool:
    """Whether the whole silhouette of a sphere lies in the picture, at least `margin` [px] inside its border."""
    outline = silhouette(camera, center, radius, 32)
    return len(outline) > 0 and bool(camera.in_picture(outline, margin).all())
