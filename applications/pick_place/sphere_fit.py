"""Fit spheres of known radius to outlines, and separate blobs that consist of several balls.

The unknowns of a fit are the horizontal position of each sphere, whose height is known, and one common offset: a
segmented outline lies a little inside or outside of the true one, by the same amount for every ball.

To separate a blob, each point of its outline votes for the center of a sphere that it could belong to: known radius,
inwards. The votes of one ball meet, also when others occlude or touch it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from applications.pick_place.ball_places import BallGeometry
from applications.pick_place.segmentation import Mask, Outline
from common.perception.pinhole import Pinhole, ray_distances, silhouettes

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.intp]
BoolMask = npt.NDArray[np.bool_]

_FACING = 0.6  # cosine between the inward normal of the outline and the direction to the center


@dataclass(frozen=True)
class Fit:
    """Fitted spheres and their support by an outline.

    Attributes:
        centers: (k, 3) relative to the optical center [m].
        offset: of the outline from the silhouettes, positive outside [m].
        owner: (n,) index of the sphere that each point of the outline belongs to, -1 for none.
    """

    centers: Array
    offset: float
    owner: npt.NDArray[np.intp]


@dataclass(frozen=True)
class _Misfit:
    """Distances between points and spheres: (n, k) arrays."""

    beyond: Array  # outside of the silhouette [m]; infinite where the outline faces another direction than the sphere
    distance: Array  # of the ray from the center [m]
    along: Array  # position along the ray closest to the center [m]


def _compare(outline: Outline, centers: Array, radius: float) -> _Misfit:
    distance, along = ray_distances(outline.rays, centers)
    # The rays are perpendicular to the inward normals, so this is the product with the direction to the center.
    facing = outline.inward @ centers.T > _FACING * distance
    return _Misfit(np.where(facing, distance - radius, np.inf), distance, along)


def _gradients(outline: Outline, misfit: _Misfit, centers: Array, which: Index, owner: Index) -> Array:
    """(m, 2) derivative of the points' distance from their owner's silhouette by the owner's x and y."""
    away = centers[owner, :2] - misfit.along[which, owner][:, None] * outline.rays[which, :2]
    gradients: Array = away / misfit.distance[which, owner][:, None]
    return gradients


def near_points(outline: Outline, centers: Array, radius: float, gate: float) -> BoolMask:
    """(n, k) outline points within the gate [m] of the spheres' silhouettes that face the same direction."""
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
    """Fit all spheres and the offset by Gauss-Newton: one step for each gate.

    In each step every point within the gate belongs to the sphere with the nearest silhouette.

    Args:
        outline: all edges of a blob.
        centers: (k, 3) initial values relative to the optical center [m]; heights stay.
        radius: of all spheres [m].
        offset: expected offset of the outline [m].
        offset_std: its standard deviation [m].
        gates: largest distance of a point in each step [m].
        point_std: standard deviation of a point [m], weighed against the expected offset. Errors of neighboring
            points are correlated, so it is twice the visible scatter.
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
    """Fit many independent spheres at once, each to its own points and with its own offset.

    Args:
        outline: points of all spheres.
        owner: (n,) index of each point's sphere, ascending, with at least one point for each sphere.
        centers: (k, 3) initial values relative to the optical center [m]; heights stay.
        radius: of all spheres [m].
        offset: initial offset of the outline [m].
        hold_offset: fit the positions only.
        gates: largest distance of a point in each step [m].
        close: largest distance of a fitting point at the end [m].

    Returns:
        (k, 3) centers [m], (k,) offsets [m], (k,) fraction of each sphere's points that fit.
    """
    sizes = np.bincount(owner, minlength=len(centers))
    starts = np.cumsum(sizes) - sizes
    (rx, ry, rz), (ix, iy, iz) = (np.ascontiguousarray(each.T) for each in (outline.rays, outline.inward))
    c, delta = centers.astype(float), np.full(len(sizes), offset)
    free = 2 if hold_offset else 3

    def compare() -> tuple[Array, Array, Array]:
        """Return the points' distance beyond their silhouettes [m], and its derivatives by x and y."""
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


_CELL = 0.003  # grid in which votes are counted [m]
_LEAST_VOTES = 0.06  # at a peak, as a fraction of the votes of a complete outline
_LEAST_SUPPORT = 0.14  # visible fraction of a complete outline that a ball needs
_NEAR = 2.0e-3  # a point closer to a silhouette than this belongs to it [m]
_HIDDEN = 0.05  # largest visible fraction of the outline of an occluded ball
_COVERED = 0.85  # fraction of a ball's silhouette that must be red
_MOST_GOING_ON = 0.45  # fraction of a ball's surroundings that may be red without an explanation
_MOST_CANDIDATES = 40


@dataclass(frozen=True)
class _Candidate:
    center: Array  # (3,) relative to the optical center [m]
    points: BoolMask  # of the outline that belong to it
    support: int  # their number
    whole: float  # number of points of its complete outline


def separate(outline: Outline, mask: Mask, camera: Pinhole, resting: BallGeometry, offset: float) -> Array:
    """Return initial values for the balls in a blob: (k, 3) centers relative to the optical center [m].

    Args:
        outline: of the blob.
        mask: red pixels of the complete image.
        camera: the camera.
        resting: radius and possible heights of the balls.
        offset: expected offset of the outline from the silhouettes [m].
    """
    if len(outline) < 8:
        return np.empty((0, 3))
    places = _peaks(_votes(outline, camera, resting, offset), camera, resting)
    candidates = _refined(places, outline, camera, resting, offset)
    if not candidates:
        return np.empty((0, 3))
    red = _are_red(np.array([c.center for c in candidates]), mask, camera, resting.radius)
    candidates = [candidate for candidate, good in zip(candidates, red, strict=True) if good]
    chosen: list[_Candidate] = []
    free = np.ones(len(outline), bool)
    while candidates:
        gains = [np.count_nonzero(c.points & free) / c.whole for c in candidates]
        best = int(np.argmax(gains))
        if gains[best] < _LEAST_SUPPORT:
            break
        candidate = candidates.pop(best)
        if not _clashes(candidate, chosen, outline, resting.radius):
            chosen.append(candidate)
            free &= ~candidate.points
    centers = np.array([c.center for c in chosen]).reshape(-1, 3)
    separated: Array = centers[_end(centers, mask, camera, resting.radius)]
    return separated


def _votes(outline: Outline, camera: Pinhole, resting: BallGeometry, offset: float) -> Array:
    """(n, 2) center that each point votes for, in the plane of ball centers on the table [m], world."""
    drop = resting.plane - camera.position[2]
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.abs(drop / outline.rays[:, 2])
    sine = np.clip((resting.radius + offset) / distance, 0, 0.9)[:, None]
    toward = np.sqrt(1 - sine**2) * outline.rays + sine * outline.inward
    with np.errstate(divide="ignore", invalid="ignore"):
        t = drop / toward[:, 2]
    votes = camera.position[:2] + t[:, None] * toward[:, :2]
    good = np.isfinite(votes).all(axis=1) & (t > 0) & (np.abs(votes - camera.position[:2]).max(axis=1) < 20)
    usable: Array = votes[good]
    return usable


def _peaks(votes: Array, camera: Pinhole, resting: BallGeometry) -> Array:
    """(m, 2) positions with many votes, the most voted for first [m], world."""
    if not len(votes):
        return np.empty((0, 2))
    low = votes.min(axis=0) - 3 * _CELL
    cells = np.floor((votes - low) / _CELL).astype(np.int64)
    shape = cells.max(axis=0) + 4
    if shape.prod() > 4_000_000:
        return np.empty((0, 2))
    counts = np.bincount(np.ravel_multi_index((cells[:, 0], cells[:, 1]), shape), minlength=int(shape.prod()))
    smooth = cv2.GaussianBlur(counts.reshape(shape).astype(np.float32), (7, 7), 1.2)
    # A cell with all votes, spread by one cell, keeps about a tenth of them after smoothing.
    least = 0.1 * _LEAST_VOTES * _whole_outline(camera, resting.radius, -float(resting.plane - camera.position[2]))
    highest = cv2.dilate(smooth, np.ones((5, 5), np.uint8))
    rows, columns = np.nonzero((smooth >= highest) & (smooth > least))
    order = np.argsort(-smooth[rows, columns], kind="stable")[:_MOST_CANDIDATES]
    peaks: Array = low + (np.column_stack([rows, columns])[order] + 0.5) * _CELL
    return peaks


def _whole_outline(camera: Pinhole, radius: float, distance: float) -> float:
    """Return the contour length of a complete ball at a distance [px]: a circle takes 4 sqrt(2) steps per radius."""
    return 5.66 * radius / max(distance, radius) * (camera.fx + camera.fy) / 2


def _refined(
    places: Array, outline: Outline, camera: Pinhole, resting: BallGeometry, offset: float
) -> list[_Candidate]:
    """Return candidates near positions (k, 2), each at the height that fits best, if enough points support it."""
    radius = resting.radius + offset
    starts, place_of = [], []
    for index, place in enumerate(places):
        ray = np.array([place[0], place[1], resting.plane]) - camera.position
        for z in resting.heights(camera, camera.project(ray + camera.position)):
            starts.append(ray * ((z - camera.position[2]) / ray[2]))
            place_of.append(index)
    if not starts:
        return []
    first = np.array(starts)
    near = near_points(outline, first, radius, 0.35 * resting.radius)
    enough = np.flatnonzero(np.count_nonzero(near, axis=0) >= 6)
    if not len(enough):
        return []
    owner, which = np.nonzero(near[:, enough].T)
    centers, _, _ = fit_each(
        outline.take(which), owner, first[enough], resting.radius, offset=offset,
        gates=(8e-3, 6e-3, 4e-3, 3e-3), close=_NEAR, hold_offset=True,
    )
    points = near_points(outline, centers, radius, _NEAR)
    support = np.count_nonzero(points, axis=0)
    best: dict[int, _Candidate] = {}
    for k, center in enumerate(centers):
        place = place_of[enough[k]]
        whole = _whole_outline(camera, resting.radius, float(np.linalg.norm(center)))
        if support[k] < _LEAST_SUPPORT * whole or not resting.can_lie(center + camera.position):
            continue
        if place not in best or support[k] > 1.05 * best[place].support:
            best[place] = _Candidate(center, points[:, k], int(support[k]), whole)
    return list(best.values())


def _clashes(candidate: _Candidate, chosen: list[_Candidate], outline: Outline, radius: float) -> bool:
    """Return whether a candidate equals or intersects a chosen one, or one would occlude visible edges of the other.

    Solid balls do not intersect.
    """
    for other in chosen:
        distance = float(np.linalg.norm(candidate.center - other.center))
        same_layer = abs(candidate.center[2] - other.center[2]) < 0.5 * radius
        if distance < (1.6 if same_layer else 0.5) * radius:
            return True
        lower, upper = sorted((candidate, other), key=lambda one: float(one.center[2]))
        if not same_layer and _is_before(upper, lower, outline, radius):
            return True
    return False


def _is_before(upper: _Candidate, lower: _Candidate, outline: Outline, radius: float) -> bool:
    """Return whether one would occlude visible edges of the other."""
    distance, _ = ray_distances(outline.rays[lower.points], upper.center[None])
    return bool(np.count_nonzero(distance < radius - 2 * _NEAR) > _HIDDEN * lower.whole)


def _red_at(pixels: Array, mask: Mask, camera: Pinhole) -> tuple[BoolMask, BoolMask]:
    """Return for pixels (..., 2) whether they are in the image, and whether they are red."""
    nearest = np.rint(np.where(np.isfinite(pixels), pixels, -1.0)).astype(int)
    seen = np.asarray(camera.in_image(nearest))
    u, v = (np.where(seen, nearest[..., axis], 0) for axis in (0, 1))
    return seen, seen & (mask[v, u] > 0)


def _are_red(centers: Array, mask: Mask, camera: Pinhole, radius: float) -> BoolMask:
    """(k,) whether the image is red where the balls would be."""
    places = centers + camera.position
    outlines, middles = silhouettes(camera, places, 0.82 * radius, 16), camera.project(places)[:, None]
    rings = [middles + part * (outlines - middles) for part in (0.25, 0.55, 0.8, 1.0)]
    seen, red = _red_at(np.concatenate(rings, axis=1), mask, camera)
    visible = np.count_nonzero(seen, axis=1)
    good: BoolMask = (visible > 0) & (np.count_nonzero(red, axis=1) >= _COVERED * visible)
    return good


def _end(centers: Array, mask: Mask, camera: Pinhole, radius: float) -> BoolMask:
    """(k,) whether the balls end where they should: the red around them belongs to other balls."""
    rings = silhouettes(camera, centers + camera.position, 1.15 * radius, 32)
    _, red = _red_at(rings, mask, camera)
    distance, _ = ray_distances(camera.directions(rings.reshape(-1, 2)), centers)
    inside = (distance < 1.05 * radius).reshape(*rings.shape[:2], len(centers))
    inside[np.arange(len(centers)), :, np.arange(len(centers))] = False  # a ball does not explain its own surroundings
    going_on = red & ~inside.any(axis=2)
    good: BoolMask = np.count_nonzero(going_on, axis=1) <= _MOST_GOING_ON * rings.shape[1]
    return good
