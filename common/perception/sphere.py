"""Outline of a sphere in an image: the cone of tangent rays.

A ray with unit direction d from the optical center touches a sphere with center c (relative to the optical center) and
radius r exactly if its distance from c, |c - (c . d) d|, is r. The image is a conic, not a circle about the projected
center; hence centroids are slightly biased and outlines are not.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from common.perception.pinhole import Pinhole

Array = npt.NDArray[np.float64]


def silhouettes(camera: Pinhole, centers: npt.ArrayLike, radius: float, count: int = 64) -> Array:
    """Return pixels (k, count, 2) around the outlines of spheres [px].

    Args:
        camera: the camera.
        centers: (k, 3) in world [m].
        radius: [m].
        count: points per outline.

    Returns:
        nan for spheres that are not completely in front of the optical center.
    """
    positions = np.asarray(centers, dtype=float).reshape(-1, 3)
    c = positions - camera.position
    distance = np.sqrt(np.einsum("ij,ij->i", c, c))[:, None]
    sine = np.clip(radius / np.maximum(distance, 1e-12), 0, 1)
    axis = c / np.maximum(distance, 1e-12)
    # All tangent points lie on a circle in front of the center.
    ring_center = axis * distance * (1 - sine**2)
    around = radius * np.sqrt(1 - sine**2)
    x, y, z = axis.T
    o = np.zeros_like(x)
    first = np.where(np.abs(x)[:, None] < 0.9, np.column_stack([o, z, -y]), np.column_stack([-z, o, x]))
    first /= np.maximum(np.sqrt(np.einsum("ij,ij->i", first, first)), 1e-12)[:, None]
    fx, fy, fz = first.T
    second = np.column_stack([y * fz - z * fy, z * fx - x * fz, x * fy - y * fx])
    angle = np.linspace(0.0, 2 * math.pi, count, endpoint=False)[None, :, None]
    ring = ring_center[:, None] + around[:, None] * (np.cos(angle) * first[:, None] + np.sin(angle) * second[:, None])
    pixels = camera.project(camera.position + ring)
    pixels[camera.to_camera(positions)[:, 2] <= radius] = np.nan
    return pixels


def silhouette(camera: Pinhole, center: npt.ArrayLike, radius: float, count: int = 64) -> Array:
    """Pixels (count, 2) on the outline of one sphere; empty (0, 2) unless it is completely in front of the camera."""
    pixels: Array = silhouettes(camera, center, radius, count)[0]
    return np.empty((0, 2)) if np.isnan(pixels).any() else pixels


def ray_distances(directions: Array, centers: Array) -> tuple[Array, Array]:
    """Compute distances between rays from the optical center and points.

    Args:
        directions: (n, 3) unit vectors.
        centers: (k, 3) relative to the optical center [m].

    Returns:
        (n, k) distances [m], and (n, k) lengths along each ray to the closest approach [m]. The gradient of a distance
        with respect to its center is the unit vector (center - along * direction) / distance.
    """
    along: Array = directions @ centers.T
    square = np.einsum("ij,ij->i", centers, centers) - along**2
    distance: Array = np.sqrt(np.maximum(square, 1e-18))
    return distance, along


def sphere_in_view(camera: Pinhole, center: npt.ArrayLike, radius: float, margin: float = 0.0) -> bool:
    """Whether the outline of a sphere lies in the image, at least `margin` [px] inside its border."""
    outline = silhouette(camera, center, radius, 32)
    return len(outline) > 0 and bool(camera.in_image(outline, margin).all())
