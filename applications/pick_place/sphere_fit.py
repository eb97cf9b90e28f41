"""Fit spheres of known radius to outlines, and separate blobs that consist of several balls."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from applications.pick_place.ball_places import Resting
from applications.pick_place.segmentation import Mask, Outline
from common.perception.pinhole import Pinhole
from common.perception.sphere import ray_distances, silhouettes

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


_CELL = 0.003  # of the grid in which votes are counted [m]
_LEAST_VOTES = 0.06  # at a peak, as part of the votes of a whole outline
_LEAST_SUPPORT = 0.14  # part of a whole outline that a ball must show
_NEAR = 2.0e-3  # a point this near to a silhouette belongs to it [m]
_HIDDEN = 0.05  # part of a whole outline that shows of a ball though another one is before it, at most
_COVERED = 0.85  # part of a ball's silhouette that must be red
_MOST_GOING_ON = 0.45  # part of the surroundings of a ball that may be red for no known reason
_MOST_CANDIDATES = 40


@dataclass(frozen=True)
class _Candidate:
    center: Array  # (3,) relative to the optical centre [m]
    points: BoolMask  # of the outline that belong to it
    support: int  # how many these are
    whole: float  # points that its whole outline has


def separate(outline: Outline, mask: Mask, camera: Pinhole, resting: Resting, offset: float) -> Array:
    """First guesses of the balls in a blob: (k, 3) centres relative to the optical centre [m].

    Args:
        outline: of the blob.
        mask: red pixels of the whole picture.
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
    kept: Array = centers[_end(centers, mask, camera, resting.radius)]
    return kept


def _votes(outline: Outline, camera: Pinhole, resting: Resting, offset: float) -> Array:
    """(n, 2) where each point puts the centre, on the plane of the balls on the table [m], world."""
    drop = resting.plane - camera.position[2]
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.abs(drop / outline.rays[:, 2])
    sine = np.clip((resting.radius + offset) / distance, 0, 0.9)[:, None]
    toward = np.sqrt(1 - sine**2) * outline.rays + sine * outline.inward
    with np.errstate(divide="ignore", invalid="ignore"):
        t = drop / toward[:, 2]
    votes = camera.position[:2] + t[:, None] * toward[:, :2]
    good = np.isfinite(votes).all(axis=1) & (t > 0) & (np.abs(votes - camera.position[:2]).max(axis=1) < 20)
    kept: Array = votes[good]
    return kept


def _peaks(votes: Array, camera: Pinhole, resting: Resting) -> Array:
    """(m, 2) places at which many votes meet, the most voted for first [m], world."""
    if not len(votes):
        return np.empty((0, 2))
    low = votes.min(axis=0) - 3 * _CELL
    cells = np.floor((votes - low) / _CELL).astype(np.int64)
    shape = cells.max(axis=0) + 4
    if shape.prod() > 4_000_000:
        return np.empty((0, 2))
    counts = np.bincount(np.ravel_multi_index((cells[:, 0], cells[:, 1]), shape), minlength=int(shape.prod()))
    smooth = cv2.GaussianBlur(counts.reshape(shape).astype(np.float32), (7, 7), 1.2)
    # A cell that holds all votes of a spread of one cell keeps about a tenth of them after smoothing.
    least = 0.1 * _LEAST_VOTES * _whole_outline(camera, resting.radius, -float(resting.plane - camera.position[2]))
    highest = cv2.dilate(smooth, np.ones((5, 5), np.uint8))
    rows, columns = np.nonzero((smooth >= highest) & (smooth > least))
    order = np.argsort(-smooth[rows, columns], kind="stable")[:_MOST_CANDIDATES]
    peaks: Array = low + (np.column_stack([rows, columns])[order] + 0.5) * _CELL
    return peaks


def _whole_outline(camera: Pinhole, radius: float, distance: float) -> float:
    """Points that the contour of a whole ball at a distance has: a circle takes 4 sqrt(2) steps for each radius."""
    return 5.66 * radius / max(distance, radius) * (camera.fx + camera.fy) / 2


def _refined(
    places: Array, outline: Outline, camera: Pinhole, resting: Resting, offset: float
) -> list[_Candidate]:
    """Candidates near places (k, 2), each at the height that fits best; places that few points support give none."""
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
    """Whether a candidate is one of the chosen again, inside of one, or would hide what is seen of one, or one of it.

    Solid balls on a table are apart.
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
    """Whether one would hide edges that are seen of the other."""
    distance, _ = ray_distances(outline.rays[lower.points], upper.center[None])
    return bool(np.count_nonzero(distance < radius - 2 * _NEAR) > _HIDDEN * lower.whole)


def _red_at(pixels: Array, mask: Mask, camera: Pinhole) -> tuple[BoolMask, BoolMask]:
    """Which pixels are in the picture, and which of all are red in it; in the shape of the pixels, without (u, v)."""
    nearest = np.rint(np.where(np.isfinite(pixels), pixels, -1.0)).astype(int)
    seen = np.asarray(camera.in_picture(nearest))
    u, v = (np.where(seen, nearest[..., axis], 0) for axis in (0, 1))
    return seen, seen & (mask[v, u] > 0)


def _are_red(centers: Array, mask: Mask, camera: Pinhole, radius: float) -> BoolMask:
    """(k,) whether what balls there would cover of the picture is red."""
    places = centers + camera.position
    outlines, middles = silhouettes(camera, places, 0.82 * radius, 16), camera.project(places)[:, None]
    rings = [middles + part * (outlines - middles) for part in (0.25, 0.55, 0.8, 1.0)]
    seen, red = _red_at(np.concatenate(rings, axis=1), mask, camera)
    visible = np.count_nonzero(seen, axis=1)
    good: BoolMask = (visible > 0) & (np.count_nonzero(red, axis=1) >= _COVERED * visible)
    return good


def _end(centers: Array, mask: Mask, camera: Pinhole, radius: float) -> BoolMask:
    """(k,) whether balls end where they should: what is red around them is other balls. Larger things go on and on."""
    rings = silhouettes(camera, centers + camera.position, 1.15 * radius, 32)
    _, red = _red_at(rings, mask, camera)
    distance, _ = ray_distances(camera.directions(rings.reshape(-1, 2)), centers)
    inside = (distance < 1.05 * radius).reshape(*rings.shape[:2], len(centers))
    inside[np.arange(len(centers)), :, np.arange(len(centers))] = False  # itself explains nothing
    going_on = red & ~inside.any(axis=2)
    good: BoolMask = np.count_nonzero(going_on, axis=1) <= _MOST_GOING_ON * rings.shape[1]
    return good
