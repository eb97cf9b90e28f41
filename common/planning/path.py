"""Smooth paths through waypoints: straight lines in joint space with parabolic blends at the corners."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_SAME = 1e-9  # [rad] waypoints closer than this are one
_SHORTEST = 1e-5  # [rad], [m] a shorter blend is a stop
_LESS_THAN_HALF = 0.45  # of an edge: what is left is long enough to be timed
_TURN_BACK = -0.985  # cosine of the angle at a corner that is too sharp to blend


@dataclass(frozen=True)
class SmoothPath:
    """Parabolic pieces that join smoothly: q(s) = start + d0 s + (d1 - d0) s^2 / (2 length), 0 <= s <= length.

    Attributes:
        starts: (P, dof) [rad]; d0, d1: (P, dof) derivative dq/ds at the piece's ends; lengths: (P,).
    """

    starts: Array
    d0: Array
    d1: Array
    lengths: Array

    @property
    def end(self) -> Array:
        """The last position (dof,) [rad]."""
        return np.asarray(self.starts[-1] + 0.5 * (self.d0[-1] + self.d1[-1]) * self.lengths[-1])

    def divided(self, step: float) -> SmoothPath:
        """Return the same path in pieces in which no joint moves by more than `step` [rad]."""
        moves = np.maximum(np.abs(self.d0), np.abs(self.d1)).max(axis=1) * self.lengths
        counts = np.maximum(1, np.ceil(moves / step - 1e-9).astype(int))
        owner = np.repeat(np.arange(len(counts)), counts)
        number = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
        lengths = (self.lengths / counts)[owner]
        slope = ((self.d1 - self.d0) / self.lengths[:, None])[owner]
        s = (number * lengths)[:, None]
        d0 = self.d0[owner] + slope * s
        starts = self.starts[owner] + (self.d0[owner] + 0.5 * slope * s) * s
        return SmoothPath(starts, d0, d0 + slope * lengths[:, None], lengths)

    def positions(self, step: float) -> Array:
        """Return (N, dof) positions [rad] along the path, at most `step` [rad] apart in each joint."""
        return np.concatenate([self.divided(step).starts, self.end[None, :]])


def distinct(waypoints: Sequence[Array] | Array) -> Array:
    """Return (N, dof) waypoints without those that repeat the one before; the last one stays as it is."""
    points = np.array(waypoints, dtype=float)
    differs = np.concatenate([[True], np.abs(np.diff(points, axis=0)).max(axis=1) > _SAME])
    result: Array = points[differs]
    result[-1] = points[-1]
    return result


def dense_path(waypoints: Array) -> SmoothPath:
    """Return the uniform quadratic B-spline with these control points (N, dof), from the first to the last.

    For waypoints that lie close together, such as those of a straight line of the tool: it passes the middles of the
    edges, and misses the waypoints by an eighth of the second difference.
    """
    edges = np.diff(waypoints, axis=0)
    if len(edges) == 1:
        return SmoothPath(waypoints[:1], edges, edges, np.ones(1))
    middles = waypoints[:-1] + 0.5 * edges
    starts = np.concatenate([waypoints[:1], middles])
    d0 = np.concatenate([edges[:1], edges])
    d1 = np.concatenate([edges, edges[-1:]])
    lengths = np.ones(len(starts))
    lengths[[0, -1]] = 0.5
    return SmoothPath(starts, d0, d1, lengths)


def blended_path(waypoints: Array, blends: Array, lengths: Array | None = None) -> list[SmoothPath]:
    """Return straight edges with a parabola about each corner; one path for each stretch between unblended corners.

    Args:
        waypoints: (N, dof) [rad], each different from the one before.
        blends: (N,) length taken from both edges at each waypoint; close to 0 means a stop. At most half the shorter
            edge is used, a little less with `lengths`, which may differ slightly from the edges.
        lengths: (N - 1,) of the edges, which then measure the path; by default their lengths in joint space [rad].
    """
    edges = np.diff(waypoints, axis=0)
    spans = np.linalg.norm(edges, axis=1)
    most = 0.5 if lengths is None else _LESS_THAN_HALF
    lengths = spans if lengths is None else lengths
    directions = edges / lengths[:, None]
    cosines = (edges[:-1] * edges[1:]).sum(axis=1) / (spans[:-1] * spans[1:])
    cut = np.zeros(len(waypoints))
    longest = np.minimum(blends[1:-1], most * np.minimum(lengths[:-1], lengths[1:]))
    cut[1:-1] = np.where((longest > _SHORTEST) & (cosines > _TURN_BACK), longest, 0.0)
    paths = []
    pieces: list[tuple[Array, Array, Array, float]] = []
    for i, (direction, length) in enumerate(zip(directions, lengths, strict=True)):
        straight = length - cut[i] - cut[i + 1]
        if straight > _SAME:
            pieces.append((waypoints[i] + cut[i] * direction, direction, direction, straight))
        if cut[i + 1] > 0:
            pieces.append((waypoints[i + 1] - cut[i + 1] * direction, direction, directions[i + 1], 2 * cut[i + 1]))
        else:
            paths.append(SmoothPath(*(np.array(column) for column in zip(*pieces, strict=True))))
            pieces = []
    return paths


_ITERATIONS = 150
_SHORTEST_LINE = 0.25  # of the longest edge: shorter ones count as this long, or they alone would limit the steps


def smoothed(points: Array, tolerances: Array) -> Array:
    """Return points (N, d) moved within their tolerances (N,) [m] so that the line through them bends least.

    The bend is the square of the curvature along the line; the first and the last point stay. A convex problem, solved
    to a few percent by projected gradients with Nesterov's momentum: Beck and Teboulle, "A fast iterative
    shrinkage-thresholding algorithm" (2009).
    """
    if len(points) < 3 or not tolerances.any():
        return points
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    lengths = np.maximum(lengths, _SHORTEST_LINE * lengths.max())
    lengths = (lengths / lengths.max())[:, None]
    before, after = 1 / lengths[:-1], 1 / lengths[1:]
    weights = 2 / (lengths[:-1] + lengths[1:])
    radii = tolerances.copy()
    radii[[0, -1]] = 0.0
    radii = radii[:, None]
    # Bound of the gradient's change per move, by Gershgorin circles.
    steepest = 2 * float((weights * (before + after) ** 2 * 2).max())
    moved = points.copy()
    ahead, momentum = moved, 1.0
    for _ in range(_ITERATIONS):
        bend = weights * ((ahead[2:] - ahead[1:-1]) * after - (ahead[1:-1] - ahead[:-2]) * before)
        gradient = np.zeros_like(points)
        gradient[:-2] += bend * before
        gradient[1:-1] -= bend * (before + after)
        gradient[2:] += bend * after
        offset = ahead - gradient / steepest - points
        distance = np.linalg.norm(offset, axis=1, keepdims=True)
        following = points + offset * np.minimum(1.0, radii / np.maximum(distance, 1e-12))
        grown = (1 + np.sqrt(1 + 4 * momentum**2)) / 2
        ahead = following + (momentum - 1) / grown * (following - moved)
        moved, momentum = following, grown
    return moved
