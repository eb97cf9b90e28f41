"""Convex pieces of which objects consist: boxes, prisms, cones, superquadrics, pieces of rings, and their meshes.

A piece is a stack of rings of points: (rings, points, 3) [any unit], each ring a convex polygon, counterclockwise seen
from the top. Its surface consists of the bands between neighboring rings and of the first and the last ring.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Piece = Array  # (rings, points, 3)

AXES = {"x": 0, "y": 1, "z": 2}
POINTED = 0.04  # radius of the first and last ring of a superquadric, as a fraction


def polygon(count: int, radius: float = 1.0, squeeze: float = 1.0) -> Array:
    """Corners (count, 2) of a regular polygon, its y axis scaled by `squeeze`."""
    angles = 2 * math.pi * (np.arange(count) + 0.5) / count
    return radius * np.column_stack([np.cos(angles), squeeze * np.sin(angles)])


def prism(section: Array, height: float, top: float = 1.0) -> Piece:
    """Prism about z with a convex section (n, 2), centered; the upper end is scaled by `top`."""
    return np.stack([np.column_stack([scale * section, np.full(len(section), z)])
                     for scale, z in ((1.0, -height / 2), (top, height / 2))])


def box(x: float, y: float, z: float) -> Piece:
    """Box about the origin."""
    return prism(np.array([(-x, -y), (x, -y), (x, y), (-x, y)]) / 2, z)


def cylinder(radius: float, height: float, *, top: float = 1.0, count: int = 12) -> Piece:
    """Cylinder or cone about z, centered."""
    return prism(polygon(count, radius), height, top)


def superquadric(size: npt.ArrayLike, roundness: npt.ArrayLike, *, rings: int = 6, count: int = 12) -> Piece:
    """Superquadric with these half axes; exponents below 1 give a box, 1 an ellipsoid, 2 an octahedron.

    Barr, "Superquadrics and angle-preserving transformations" (1981); convex for exponents up to 2.
    """
    upright, around = np.asarray(roundness, float).tolist()
    angles = 2 * math.pi * np.arange(count) / count
    section = np.column_stack([_power(np.cos(angles), around), _power(np.sin(angles), around)])
    steps = np.linspace(-math.pi / 2, math.pi / 2, rings)
    width = np.maximum(_power(np.cos(steps), upright), POINTED)
    heights = _power(np.sin(steps), upright)
    points = np.stack([np.column_stack([r * section, np.full(count, z)]) for r, z in zip(width, heights, strict=True)])
    return np.asarray(points * np.asarray(size, float))


def _power(values: Array, exponent: float) -> Array:
    return np.asarray(np.sign(values) * np.abs(values) ** exponent)


def lathe(profile: Sequence[tuple[float, float]], *, count: int = 12) -> list[Piece]:
    """Solid of revolution about z: a cone for each pair of neighboring (radius, z), z increasing."""
    found = []
    for (r0, z0), (r1, z1) in pairwise(profile):
        found.append(np.stack([np.column_stack([polygon(count, r), np.full(count, z)])
                               for r, z in ((r0, z0), (r1, z1))]))
    return found


def tube(
    radii: Sequence[tuple[float, float, float]], *, count: int = 10, start: float = 0.0, stop: float = 2 * math.pi
) -> list[Piece]:
    """Wedges of a ring about z from one angle to another [rad], for each band of (inner, outer, z) to the next one."""
    angles = np.linspace(start, stop, count + 1)
    found = []
    for (a0, b0, z0), (a1, b1, z1) in pairwise(radii):
        for first, last in pairwise(angles):
            directions = np.array([(math.cos(t), math.sin(t)) for t in (first, last)])
            found.append(np.stack([
                np.column_stack([np.concatenate([a * directions[:1], b * directions, a * directions[1:]]),
                                 np.full(4, z)]) for a, b, z in ((a0, b0, z0), (a1, b1, z1))]))
    return found


def ring(inner: float, outer: float, height: float, *, count: int = 10, start: float = 0.0,
         stop: float = 2 * math.pi) -> list[Piece]:
    """Ring about z, centered, or an arc of it."""
    return tube([(inner, outer, -height / 2), (inner, outer, height / 2)], count=count, start=start, stop=stop)


def moved(piece: Piece, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Piece:
    """Shift a piece."""
    return np.asarray(piece + np.array([x, y, z]))


def turned(piece: Piece, axis: str, angle: float) -> Piece:
    """Rotate a piece about an axis through the origin [rad]."""
    i, j = [index for index in range(3) if index != AXES[axis]]
    c, s = math.cos(angle), math.sin(angle) * (-1.0 if axis == "y" else 1.0)
    result = piece.copy()
    result[..., i], result[..., j] = c * piece[..., i] - s * piece[..., j], s * piece[..., i] + c * piece[..., j]
    return result


def points_of(pieces: Sequence[Piece]) -> Array:
    """All points (n, 3)."""
    return np.concatenate([piece.reshape(-1, 3) for piece in pieces])


def triangles_of(piece: Piece) -> Array:
    """Surface (n, 3, 3), normals outward if the rings are counterclockwise and ordered along their normal."""
    rings, count, _ = piece.shape
    index = np.arange(rings * count).reshape(rings, count)
    a, b = index[:-1], np.roll(index[:-1], -1, axis=1)
    c, d = np.roll(index[1:], -1, axis=1), index[1:]
    bands = np.concatenate([np.stack([a, b, c], axis=-1).reshape(-1, 3), np.stack([a, c, d], axis=-1).reshape(-1, 3)])
    fan = np.array([(0, k, k + 1) for k in range(1, count - 1)])
    faces = np.concatenate([bands, fan[:, ::-1], (rings - 1) * count + fan])
    return np.asarray(piece.reshape(-1, 3)[faces])


def volume_and_center(triangles: Array) -> tuple[float, Array]:
    """Volume and center of mass (3,) of a closed convex surface (n, 3, 3) [unit of the triangles, cubed]."""
    inside = triangles.mean(axis=(0, 1))
    a, b, c = np.moveaxis(triangles - inside, 1, 0)
    volumes = np.abs(np.einsum("ni,ni->n", a, np.cross(b, c))) / 6
    total = max(float(volumes.sum()), 1e-15)
    return total, np.asarray(inside + (volumes[:, None] * (a + b + c) / 4).sum(axis=0) / total)
