"""Find balls of known size in a depth image, stacked or not, by votes for their centers.

Each point on a sphere puts its center one radius behind it along the normal. The points of one ball agree, whatever
occludes or touches the rest of it. A center with many votes is fitted to its points.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
import numpy.typing as npt

from applications.pick_place.segmentation import Mask
from common.perception.depth import Depth, Rays, is_valid
from common.perception.pinhole import Pinhole

Array = npt.NDArray[np.float64]

WINDOW = 5  # [px] over which depth is averaged before normals are computed
JUMP = 0.015  # [m] neighbors farther apart belong to different objects
CELL = 0.01  # [m] grid in which votes are counted
GATE = 0.006  # [m] a point closer to a ball's surface than this belongs to it
AGREEING = 0.65  # fraction of the points on the surface that must vote for the center
SPREAD = 0.7  # largest spread of the votes relative to that of the points: on a flat object both are equal
MISSES = 20  # consecutive centers that are no ball: the rest is something else, such as a red cloth
LEAST = 0.15  # fraction of a complete ball's points that must be visible
GATES = (0.012, 0.009, 0.006, 0.005, 0.004, 0.004, 0.004)  # [m] in each Gauss-Newton step


def find_balls_in_depth(mask: Mask, depth: Depth, camera: Pinhole, radius: float) -> Array:
    """Return the centers (n, 3) of balls [m] in world.

    Args:
        mask: (height, width), nonzero where a pixel has the color of the balls.
        depth: (height, width) [m], NaN or 0 where unknown.
        camera: that took both.
        radius: of the balls [m].
    """
    red = (mask > 0) & is_valid(depth)
    found: list[Array] = []
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask)
    for number in range(1, count):
        x, y, width, height = (int(value) for value in stats[number][:4])
        top, left = max(0, y - WINDOW), max(0, x - WINDOW)
        cut = slice(top, y + height + WINDOW), slice(left, x + width + WINDOW)
        part = red[cut] & (labels[cut] == number)
        points, votes = _votes(part, depth[cut], camera, (left, top), radius)
        found += _balls(points, votes, camera, radius)
    return np.array(found).reshape(-1, 3)


def _votes(
    red: npt.NDArray[np.bool_], depth: Depth, camera: Pinhole, corner: tuple[int, int], radius: float
) -> tuple[Array, Array]:
    """Return points (n, 3) on red pixels, and the ball center that each votes for (n, 3) [m], world."""
    weight = cv2.blur(red.astype(np.float32), (WINDOW, WINDOW))
    smooth = cv2.blur(np.where(red, depth, np.float32(0)), (WINDOW, WINDOW)) / np.maximum(weight, 1e-6)
    v, u = np.mgrid[0 : red.shape[0], 0 : red.shape[1]]
    rays = Rays.through(camera, np.stack([u + corner[0], v + corner[1]], axis=-1))
    points = rays.at_depth(np.where(red, depth, 0.0))
    level = rays.at_depth(smooth)
    along, down = np.zeros_like(level), np.zeros_like(level)
    along[:, 1:-1], down[1:-1] = level[:, 2:] - level[:, :-2], level[2:] - level[:-2]
    normals = np.cross(along, down)
    length = np.linalg.norm(normals, axis=-1)
    sound = red & (weight > 0.99) & (length > 0)
    sound &= (np.linalg.norm(along, axis=-1) < JUMP) & (np.linalg.norm(down, axis=-1) < JUMP)
    outward = normals[sound] / length[sound][:, None]
    outward *= -np.sign(np.einsum("ij,ij->i", outward, rays.directions[sound]))[:, None]
    return points[sound], level[sound] - radius * outward


def _balls(points: Array, votes: Array, camera: Pinhole, radius: float) -> Iterator[Array]:
    """Yield centers (3,) [m] with many votes, the most voted for first."""
    misses = 0
    while len(points) and misses < MISSES:
        cells = np.floor(votes / CELL).astype(np.int64)
        cells -= cells.min(axis=0)
        numbers = np.ravel_multi_index((cells[:, 0], cells[:, 1], cells[:, 2]), cells.max(axis=0) + 1)
        _, which, counts = np.unique(numbers, return_inverse=True, return_counts=True)
        center = votes[which == np.argmax(counts)].mean(axis=0)
        misses += 1
        near = np.linalg.norm(votes - center, axis=1) < 1.5 * CELL
        center = _fitted(points, votes[near].mean(axis=0), radius)
        distance = np.linalg.norm(points - center, axis=1)
        own = np.abs(distance - radius) < GATE
        depth = max(float(camera.to_camera(center)[2]), radius)
        whole = np.pi * camera.fx * camera.fy * (radius / depth) ** 2
        if np.count_nonzero(own) >= LEAST * whole:
            agreeing = np.linalg.norm(votes[own] - center, axis=1) < 1.5 * CELL
            # On a flat object each point votes for a center of its own, however small it is.
            if np.mean(agreeing) >= AGREEING and _spread(votes[own]) <= SPREAD * _spread(points[own]):
                misses = 0
                yield center
            left = distance > radius + GATE
        elif counts.max() < 0.02 * whole:
            return
        else:
            left = ~(near | own)
        points, votes = points[left], votes[left]


def _spread(points: Array) -> float:
    """Return the median distance of points (n, 3) from their median [m]."""
    return float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)))


def _fitted(points: Array, center: Array, radius: float) -> Array:
    """Return the center of the sphere through the points near its surface."""
    for gate in GATES:
        away = points - center
        distance = np.linalg.norm(away, axis=1)
        near = np.abs(distance - radius) < gate
        if np.count_nonzero(near) < 12:
            break
        J = -away[near] / distance[near][:, None]
        step = np.linalg.solve(J.T @ J + 1e-6 * np.eye(3), -J.T @ (distance[near] - radius))
        center = center + step * min(1.0, 0.5 * radius / max(float(np.linalg.norm(step)), 1e-12))
    return center
