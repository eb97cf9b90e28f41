"""Collision shapes for coal, from what a URDF describes: nothing that is not finite or has no extent gets there."""

from __future__ import annotations

from pathlib import Path

import coal
import numpy as np
from numpy.typing import NDArray

from common.errors import ConfigError
from common.robot.link_shapes import Shape
from common.robot.mesh_files import triangles_of

Array = NDArray[np.float64]

THINNEST = 1e-5  # [m] thickness below which a mesh counts as flat
PLATE = 1e-3  # [m] thickness that a flat mesh gets
FARTHEST = 1e4  # [m] of a corner from the origin of its mesh
_DIRECTION = np.array([0.8571, 0.4143, 0.3061]) * np.sqrt([2.0, 3.0, 5.0])


def coal_shape(shape: Shape, field: str, path: Path | None) -> coal.CollisionGeometry:
    """Return a shape about its own origin; `path` is the file of a mesh.

    Raises:
        ConfigError: the mesh cannot be read, or its corners lie on a line; names the field.
    """
    if path is None:
        primitives = {"box": coal.Box, "capsule": coal.Capsule, "cylinder": coal.Cylinder, "sphere": coal.Sphere}
        return primitives[shape.kind](*shape.size)
    corners = solid(triangles_of(field, path) * np.array(shape.size), field, path)
    points, faces = distinct(corners)
    mesh = coal.BVHModelOBBRSS()
    mesh.beginModel(len(faces), len(points))
    mesh.addVertices(points)
    mesh.addTriangles(faces)
    mesh.endModel()
    return mesh


def solid(triangles: Array, field: str, path: Path) -> Array:
    """Return triangles (n, 3, 3) [m] whose hull has a volume: those of a flat mesh twice, as the sides of a thin plate.

    Raises:
        ConfigError: all corners lie on one line, or are farther away than any robot.
    """
    points = triangles.reshape(-1, 3)
    low, high = points.min(axis=0), points.max(axis=0)
    x, y, z = high - low
    if max(np.abs(low).max(), np.abs(high).max()) > FARTHEST:
        raise ConfigError(field, str(path), f"is a mesh of {x:.3g} x {y:.3g} x {z:.3g} m: check its unit and scale")
    axes = np.linalg.eigh(np.cov((points - low).T))[1]  # from the thinnest to the longest
    extents = np.ptp(points @ axes, axis=0)
    if extents[1] < THINNEST:
        raise ConfigError(field, str(path), f"is a mesh of {x:.3g} x {y:.3g} x {z:.3g} m: its corners lie on a line")
    if extents[0] >= THINNEST:
        return triangles
    normal = PLATE / 2 * axes[:, 0]
    return np.concatenate([triangles + normal, triangles - normal])


def distinct(triangles: Array) -> tuple[Array, NDArray[np.intp]]:
    """Return the distinct corners (k, 3) of triangles (n, 3, 3), and the indices (n, 3) of each one's."""
    points = triangles.reshape(-1, 3)
    # Sorted by one number of each: several times faster than by rows. Two points with one number are an accident.
    _, first, index = np.unique(points @ _DIRECTION, return_index=True, return_inverse=True)
    found = points[first]
    if not np.array_equal(found[index], points):
        found, index = np.unique(points, axis=0, return_inverse=True)
    return found, index.reshape(-1, 3)
