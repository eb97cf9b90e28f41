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


def silhouettes(camera: Pinhole, centers: npt.ArrayLike, radius: float, count: int = 64) -> Array:
    """Pixels (k, count, 2) on the outlines of spheres, all the way round [px].

    Args:
        camera: the camera.
        centers: (k, 3) in world [m].
        radius: [m].
        count: number of points of each.

    Returns:
        nan for spheres that are not wholly in front of the optical centre.
    """
    places = np.asarray(centers, dtype=float).reshape(-1, 3)
    c = places - camera.position
    distance = np.sqrt(np.einsum("ij,ij->i", c, c))[:, None]
    sine = np.clip(radius / np.maximum(distance, 1e-12), 0, 1)
    axis = c / np.maximum(distance, 1e-12)
    # All tangent points lie on a circle in front of the centre.
    middle = axis * distance * (1 - sine**2)
    around = radius * np.sqrt(1 - sine**2)
    x, y, z = axis.T
    o = np.zeros_like(x)
    first = np.where(np.abs(x)[:, None] < 0.9, np.column_stack([o, z, -y]), np.column_stack([-z, o, x]))
    first /= np.maximum(np.sqrt(np.einsum("ij,ij->i", first, first)), 1e-12)[:, None]
    fx, fy, fz = first.T
    second = np.column_stack([y * fz - z * fy, z * fx - x * fz, x * fy - y * fx])
    angle = np.linspace(0.0, 2 * math.pi, count, endpoint=False)[None, :, None]
    ring = middle[:, None] + around[:, None] * (np.cos(angle) * first[:, None] + np.sin(angle) * second[:, None])
    pixels = camera.project(camera.position + ring)
    pixels[camera.to_camera(places)[:, 2] <= radius] = np.nan
    return pixels


def silhouette(camera: Pinhole, center: npt.ArrayLike, radius: float, count: int = 64) -> Array:
    """Pixels (count, 2) on the outline of one sphere; empty (0, 2) when it is not wholly in front of the camera."""
    pixels: Array = silhouettes(camera, center, radius, count)[0]
    return np.empty((0, 2)) if np.isnan(pixels).any() else pixels


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


def sphere_in_view(camera: Pinhole, center: npt.ArrayLike, radius: float, margin: float = 0.0) -> bool:
    """Whether the whole silhouette of a sphere lies in the picture, at least `margin` [px] inside its border."""
    outline = silhouette(camera, center, radius, 32)
    return len(outline) > 0 and bool(camera.in_picture(outline, margin).all())
