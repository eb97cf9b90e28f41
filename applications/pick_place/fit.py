"""Fit spheres of known radius to an outline, several at once.

The unknowns are the horizontal position of each sphere, whose height is known, and one offset that they share: a
segmented outline lies a little inside or outside of the true one, by as much for every ball.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from applications.pick_place.blobs import Outline
from common.perception.sphere import ray_distances

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.intp]
BoolMask = npt.NDArray[np.bool_]

_FACING = 0.6  # cosine between the inward normal of the outline and the direction to the centre


@dataclass(frozen=True)
class Fit:
    """Spheres and how well an outline supports them.

    Attributes:
        centers: (k, 3) relative to the optical centre [m].
        offset: of the outline from the silhouettes, positive outside [m].
        owner: (n,) index of the sphere that each point of the outline belongs to, -1 for none.
    """

    centers: Array
    offset: float
    owner: npt.NDArray[np.intp]


@dataclass(frozen=True)
class _Misfit:
    """Points against spheres: (n, k) arrays."""

    beyond: Array  # outside of the silhouette [m]; infinite where the outline faces another way than the sphere would
    distance: Array  # of the ray from the centre [m]
    along: Array  # how far along the ray it passes the centre [m]


def _compare(outline: Outline, centers: Array, radius: float) -> _Misfit:
    distance, along = ray_distances(outline.rays, centers)
    # The rays are perpendicular to the inward normals, so this is the product with the direction to the centre.
    facing = outline.inward @ centers.T > _FACING * distance
    return _Misfit(np.where(facing, distance - radius, np.inf), distance, along)


def _gradients(outline: Outline, misfit: _Misfit, centers: Array, which: Index, owner: Index) -> Array:
    """(m, 2) change of the distances of points from the silhouettes of their owners with the owners' x and y."""
    away = centers[owner, :2] - misfit.along[which, owner][:, None] * outline.rays[which, :2]
    gradients: Array = away / misfit.distance[which, owner][:, None]
    return gradients


def near_points(outline: Outline, centers: Array, radius: float, gate: float) -> BoolMask:
    """(n, k) which points of an outline lie within the gate [m] of the silhouettes of spheres and face as these do."""
    chosen: BoolMask = np.abs(_compare(outline, centers, radius).beyond) < gate
    return chosen


def fit_spheres(
    outline: Outline,
    centers: Array,
    radius: float,
    *,
    offset: float,
    offset_std: float,
    gates: tuple[float, ...] = (6e-3, 4e-3, 2.5e-3, 2.5e-3, 2e-3),
    point_std: float = 8e-4,
) -> Fit:
    """Gauss-Newton on all spheres and the offset from first centres: one step for each gate.

    In each step every point belongs to the sphere whose silhouette it is nearest to, if it lies within the gate.

    Args:
        outline: all edges of a blob.
        centers: (k, 3) first guess relative to the optical centre [m]; heights are kept.
        radius: of all spheres [m].
        offset: expected offset of the outline [m].
        offset_std: how sure that is [m].
        gates: how far off a point may be in each step [m].
        point_std: how exact a point of the outline is [m]: what the expected offset is weighed against. Neighbouring
            points err together, so this is twice the scatter that one sees.
    """
    c = centers.astype(float)
    count, delta = len(c), offset
    weight = (point_std / offset_std) ** 2
    every = np.arange(len(outline))
    for gate in gates:
        misfit = _compare(outline, c, radius + delta)
        nearest = np.argmin(np.abs(misfit.beyond), axis=1)
        residual = misfit.beyond[every, nearest]
        used = np.flatnonzero(np.abs(residual) < gate)
        owner = nearest[used]
        gradients = _gradients(outline, misfit, c, used, owner)
        J = np.zeros((len(used), 2 * count + 1))
        rows = np.arange(len(used))
        J[rows, 2 * owner] = gradients[:, 0]
        J[rows, 2 * owner + 1] = gradients[:, 1]
        J[:, -1] = -1.0
        H = J.T @ J + 1e-6 * np.eye(2 * count + 1)
        g = J.T @ residual[used]
        H[-1, -1] += weight
        g[-1] += weight * (delta - offset)
        step = np.linalg.solve(H, -g)
        delta += float(step[-1])
        moved = step[:-1].reshape(count, 2)
        length = np.hypot(moved[:, 0], moved[:, 1])[:, None]
        c[:, :2] += moved * np.minimum(1.0, 0.5 * radius / np.maximum(length, 1e-12))
    beyond = _compare(outline, c, radius + delta).beyond
    nearest = np.argmin(np.abs(beyond), axis=1)
    residual = beyond[every, nearest]
    return Fit(c, delta, np.where(np.abs(residual) < gates[-1], nearest, -1))


def fit_each(
    outline: Outline,
    owner: Index,
    centers: Array,
    radius: float,
    *,
    offset: float,
    gates: tuple[float, ...],
    close: float,
    hold_offset: bool = False,
) -> tuple[Array, Array, Array]:
    """Fit many spheres in one go, each to points of its own and with an offset of its own.

    Args:
        outline: the points of all.
        owner: (n,) index of the sphere that each point is fitted to, in ascending order, with one or more for each.
        centers: (k, 3) first guesses relative to the optical centre [m]; heights are kept.
        radius: of all spheres [m].
        offset: of the outline, to start from [m].
        hold_offset: find the places only.
        gates: how far off a point may be in each step [m].
        close: how far off a point may be in the end [m].

    Returns:
        (k, 3) centres [m], (k,) offsets [m], (k,) the part of the points of each that is close.
    """
    sizes = np.bincount(owner, minlength=len(centers))
    starts = np.cumsum(sizes) - sizes
    (rx, ry, rz), (ix, iy, iz) = (np.ascontiguousarray(each.T) for each in (outline.rays, outline.inward))
    c, delta = centers.astype(float), np.full(len(sizes), offset)
    free = 2 if hold_offset else 3

    def compare() -> tuple[Array, Array, Array]:
        """How far points are beyond their silhouette [m], and how their distance changes with its x and y."""
        x, y, z = c.T[:, owner]
        along = rx * x + ry * y + rz * z
        distance = np.sqrt(np.maximum(x * x + y * y + z * z - along * along, 1e-18))
        facing = ix * x + iy * y + iz * z > _FACING * distance
        beyond = np.where(facing, distance - radius - delta[owner], np.inf)
        return beyond, (x - along * rx) / distance, (y - along * ry) / distance

    for gate in gates:
        beyond, by_x, by_y = compare()
        near = np.abs(beyond) < gate
        x, y, off = by_x * near, by_y * near, np.where(near, beyond, 0.0)
        products = [x * x, x * y, y * y, x * off, y * off]
        if not hold_offset:
            products += [-x, -y, near.astype(float), -off]
        sums = np.add.reduceat(np.array(products), starts, axis=1)
        H, g = np.empty((len(sizes), free, free)), np.empty((len(sizes), free, 1))
        H[:, 0, 0], H[:, 0, 1], H[:, 1, 0], H[:, 1, 1], g[:, 0, 0], g[:, 1, 0] = sums[[0, 1, 1, 2, 3, 4]]
        if not hold_offset:
            H[:, 0, 2], H[:, 2, 0], H[:, 1, 2], H[:, 2, 1], H[:, 2, 2], g[:, 2, 0] = sums[[5, 5, 6, 6, 7, 8]]
        step = np.linalg.solve(H + 1e-3 * np.eye(free), -g)[..., 0]
        length = np.hypot(step[:, 0], step[:, 1])
        c[:, :2] += step[:, :2] * np.minimum(1.0, 0.5 * radius / np.maximum(length, 1e-12))[:, None]
        if not hold_offset:
            delta += step[:, 2]
    beyond, _, _ = compare()
    return c, delta, np.add.reduceat((np.abs(beyond) < close).astype(float), starts) / sizes
