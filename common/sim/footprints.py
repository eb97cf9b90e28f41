"""Outlines of objects seen from above: containment, overlap and distance."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from common.config import Fixture
from common.sim.solids import circle, triangulate

Array = NDArray[np.float64]

TOUCH = 1e-6  # [m] a smaller overlap counts as contact


def footprint(fixture: Fixture) -> Array:
    """Outline (N, 2) [m] of a fixture seen from above; a tilted fixture is replaced by its bounding circle."""
    x, y, _ = fixture.position
    if fixture.shape == "box" and not any(fixture.rpy[:2]):
        cos, sin = math.cos(fixture.rpy[2]), math.sin(fixture.rpy[2])
        a, b = fixture.dimensions[0] / 2, fixture.dimensions[1] / 2
        corners = np.array([(-a, -b), (a, -b), (a, b), (-a, b)])
        return np.asarray(corners @ np.array([[cos, sin], [-sin, cos]]) + (x, y))
    is_round = fixture.shape != "box" and not any(fixture.rpy[:2])
    radius = fixture.dimensions[0] if is_round else math.hypot(*fixture.dimensions)
    return np.asarray(circle(radius) + np.array([x, y]))


def heights(fixture: Fixture) -> tuple[float, float]:
    """Lowest and highest z of a fixture [m]."""
    if fixture.shape == "sphere":
        half = fixture.dimensions[0]
    elif any(fixture.rpy[:2]):
        half = math.hypot(*fixture.dimensions)
    else:
        half = fixture.dimensions[-1] / 2
    return fixture.position[2] - half, fixture.position[2] + half


def within(inner: Array, outer: Array) -> bool:
    """Whether an outline (N, 2) lies in a convex, counterclockwise one (K, 2); touching the edge is allowed."""
    side = np.roll(outer, -1, axis=0) - outer
    offset = inner[:, None] - outer
    beyond = (side[:, 0] * offset[..., 1] - side[:, 1] * offset[..., 0]) / np.hypot(*side.T)
    return bool((beyond >= -TOUCH).all())


def overlap(a: Array, b: Array) -> bool:
    """Whether two counterclockwise outlines (N, 2) and (K, 2) share an area; touching does not count."""
    return not boxes_disjoint(a, b) and parts_meet(convex_parts(a), convex_parts(b))


def boxes_disjoint(a: Array, b: Array) -> bool:
    """Whether the bounding boxes of two outlines (N, 2) and (K, 2) share no area."""
    return bool((a.max(axis=0) < b.min(axis=0) + TOUCH).any() or (b.max(axis=0) < a.min(axis=0) + TOUCH).any())


def parts_meet(a: Array, b: Array) -> bool:
    """Whether a convex part (n, N, 2) of one outline overlaps a convex part (m, K, 2) of another."""
    low_a, high_a, low_b, high_b = a.min(axis=1), a.max(axis=1), b.min(axis=1), b.max(axis=1)
    near = ((high_a[:, None] >= low_b + TOUCH) & (high_b >= low_a[:, None] + TOUCH)).all(axis=2)
    return any(convex_overlap(a[i], b[j]) for i, j in np.argwhere(near))


def convex_parts(outline: Array) -> Array:
    """The outline itself (1, N, 2) if it is convex, else triangles (n, 3, 2); all counterclockwise."""
    return outline[None] if is_convex(outline) else triangulate(outline)


def is_convex(outline: Array) -> bool:
    """Whether a counterclockwise outline (N, 2) has no reflex corner."""
    side = np.roll(outline, -1, axis=0) - outline
    following = np.roll(side, -1, axis=0)
    return bool((side[:, 0] * following[:, 1] - side[:, 1] * following[:, 0] >= -1e-12).all())


def convex_overlap(a: Array, b: Array) -> bool:
    """Whether two convex outlines overlap: no side of either separates them."""
    for one, other in ((a, b), (b, a)):
        side = np.roll(one, -1, axis=0) - one
        length = np.hypot(side[:, 0], side[:, 1])
        outward = np.column_stack([side[:, 1], -side[:, 0]])[length > 1e-9] / length[length > 1e-9, None]
        if ((other @ outward.T).min(axis=0) > (one @ outward.T).max(axis=0) - TOUCH).any():
            return False
    return True


def covers_point(outline: Array, x: float, y: float) -> bool:
    """Whether a point [m] lies within an outline (N, 2)."""
    return bool(_inside(outline, np.array([[x, y]]))[0])


def distances(points: Array, outline: Array) -> Array:
    """Distance [m] of points (N, 2) from an area with this outline (K, 2); 0 inside."""
    side = np.roll(outline, -1, axis=0) - outline
    offset = points[:, None] - outline
    length = np.maximum(np.einsum("kj,kj->k", side, side), 1e-18)  # squared
    fraction = np.clip(np.einsum("nkj,kj->nk", offset, side) / length, 0, 1)
    away = np.hypot(*np.moveaxis(offset - fraction[..., None] * side, -1, 0)).min(axis=1)
    return np.where(_inside(outline, points), 0.0, away)


def _inside(outline: Array, points: Array) -> NDArray[np.bool_]:
    """Mask of points (N, 2) within an outline (K, 2): a ray to the right crosses it an odd number of times."""
    following = np.roll(outline, -1, axis=0)
    x, y = points[:, :1], points[:, 1:]
    above, above_next = outline[:, 1] > y, following[:, 1] > y
    rise = np.where(following[:, 1] == outline[:, 1], 1.0, following[:, 1] - outline[:, 1])
    crossing = outline[:, 0] + (y - outline[:, 1]) * (following[:, 0] - outline[:, 0]) / rise
    return np.asarray(((above != above_next) & (x < crossing)).sum(axis=1) % 2 == 1)
