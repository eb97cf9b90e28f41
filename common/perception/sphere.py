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
    x, y, z = axis
    first = np.array((0.0, z, -y) if abs(x) < 0.9 else (-z, 0.0, x)) / math.hypot(z, y if abs(x) < 0.9 else x)
    second = np.array((y * first[2] - z * first[1], z * first[0] - x * first[2], x * first[1] - y * first[0]))
    angle = np.linspace(0.0, 2 * math.pi, count, endpoint=False)[:, None]
    return camera.project(middle + around * (np.cos(angle) * first + np.sin(angle) * second))


def ray_distances(directions: Array, centers: Array) -> tuple[Array, Array]:
    """Distances of rays from the optical centre to points.

    Args:
        directions: (n, 3) unit vectors.
        centers: (k, 3) relative to the optical centre [m].

    Returns:
        (n, k) distances [m], and (n, k) how far along each ray it passes each point [m]. The gradient of a distance
        in its centre is the unit vector (center - along * direction) / distance.
    """
    along: Array = directions @ centers.T
    square = np.einsum("ij,ij->i", centers, centers) - along**2
    distance: Array = np.sqrt(np.maximum(square, 1e-18))
    return distance, along


def wholly_in_view(camera: Pinhole, center: npt.ArrayLike, radius: float, margin: float = 0.0) -> bool:
    """Whether the whole silhouette of a sphere lies in the picture, at least `margin` [px] inside its border."""
    outline = silhouette(camera, center, radius, 32)
    return len(outline) > 0 and bool(camera.in_picture(outline, margin).all())
