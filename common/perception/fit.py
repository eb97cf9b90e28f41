"""Fit spheres of known radius to an outline, several at once.

The unknowns are the horizontal position of each sphere, whose height is known, and one offset that they share: a
segmented outline lies a little inside or outside of the true one, by as much for every ball.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from common.perception.outline import Outline
from common.perception.sphere import ray_distances

Array = npt.NDArray[np.float64]

_FACING = 0.6  # cosine between the inward normal of the outline and the direction to the centre


@dataclass(frozen=True)
class Fit:
    """Spheres and how well an outline supports them.

    Attributes:
        centers: (k, 3) relative to the optical centre [m].
        offset: of the outline from the silhouettes, positive outside [m].
        owner: (n,) index of the sphere that each point of the outline belongs to, -1 for none.
        residuals: (n,) distance of each point from the offset silhouette of its nearest sphere [m].
    """

    centers: Array
    offset: float
    owner: npt.NDArray[np.intp]
    residuals: Array

    def support(self) -> npt.NDArray[np.intp]:
        """(k,) number of points of the outline that belong to each sphere."""
        return np.bincount(self.owner[self.owner >= 0], minlength=len(self.centers))


def misfit(outline: Outline, center: Array, radius: float) -> tuple[Array, Array, npt.NDArray[np.bool_]]:
    """How far rays of an outline pass outside of a sphere.

    Returns:
        (n,) distance from the silhouette, negative inside [m]; (n, 2) its gradient in the horizontal position of the
        sphere; (n,) whether the outline there faces the way in which the sphere would.
    """
    distance, gradient = ray_distances(outline.rays, center)
    facing = np.einsum("ij,ij->i", gradient, outline.inward) > _FACING
    return distance - radius, gradient[:, :2], facing


def fit_spheres(
    outline: Outline,
    centers: Array,
    radius: float,
    *,
    offset: float = 0.0,
    offset_std: float = 1e-3,
    gates: tuple[float, ...] = (6e-3, 4e-3, 2.5e-3, 2.5e-3, 2e-3),
    point_std: float = 4e-4,
) -> Fit:
    """Gauss-Newton from first centres, one step for each gate.

    Args:
        outline: all edges of a blob.
        centers: (k, 3) first guess relative to the optical centre [m]; heights are kept.
        radius: of all spheres [m].
        offset: expected offset of the outline [m].
        offset_std: how sure that is [m]; 0 holds it.
        gates: in each step, points farther than this from every silhouette are left out [m].
        point_std: how exact a point of the outline is [m]; weighs the outline against the expected offset.
    """
    c = centers.astype(float)
    count, delta = len(c), offset
    owner = np.full(len(outline), -1)
    residuals = np.full(len(outline), np.inf)
    for step, gate in enumerate((*gates, gates[-1])):
        owner, residuals, gradients = _assign(outline, c, radius, delta, gate)
        if step == len(gates):
            break
        used = owner >= 0
        rows = np.flatnonzero(used)
        J = np.zeros((len(rows), 2 * count + 1))
        J[np.arange(len(rows)), 2 * owner[used]] = gradients[used, 0]
        J[np.arange(len(rows)), 2 * owner[used] + 1] = gradients[used, 1]
        J[:, -1] = -1.0
        H = J.T @ J + 1e-6 * np.eye(2 * count + 1)
        g = J.T @ residuals[used]
        weight = (point_std / offset_std) ** 2 * 4 if offset_std > 0 else 1e9
        # Neighbouring points of an outline err together: some four of them count as one.
        H[-1, -1] += weight
        g[-1] += weight * (delta - offset)
        change = np.linalg.solve(H, -g)
        delta += float(change[-1])
        moved = change[:-1].reshape(count, 2)
        length = np.linalg.norm(moved, axis=1, keepdims=True)
        c[:, :2] += moved * np.minimum(1.0, 0.5 * radius / np.maximum(length, 1e-12))
    return Fit(c, delta, owner, residuals)


def _assign(
    outline: Outline, centers: Array, radius: float, offset: float, gate: float
) -> tuple[npt.NDArray[np.intp], Array, Array]:
    """Give each point of the outline to the sphere whose offset silhouette it is nearest to, facing the right way."""
    residuals = np.full(len(outline), np.inf)
    gradients = np.zeros((len(outline), 2))
    owner = np.full(len(outline), -1)
    for index, center in enumerate(centers):
        beyond, gradient, facing = misfit(outline, center, radius + offset)
        nearer = facing & (np.abs(beyond) < np.abs(residuals))
        residuals[nearer] = beyond[nearer]
        gradients[nearer] = gradient[nearer]
        owner[nearer] = index
    owner[np.abs(residuals) > gate] = -1
    return owner, residuals, gradients
