"""Collision checks of one request: positions, edges and paths among the solids of a planning scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from common.planning.contact_rules import ContactRules, Pair, required_distances
from common.planning.obstacles import MARGINS
from common.planning.path import SmoothPath

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Hit:
    """Where along a path the first collision was found, and between what."""

    index: int
    q: Array
    pair: Pair


@dataclass(frozen=True)
class Obstruction:
    """Why an edge is not free: a code for programs, a message for people, and the pair if two things collide."""

    error: str
    message: str
    colliding: Pair | None


class CollisionWorld(ContactRules):
    """Checks joint positions, edges and paths for collision, for one request on one scene.

    Planners and validation use the same world, so they apply the same rules of contact. With tool constraints,
    positions that violate them are not free either (`collides`, `edge_free`, `blends_free`); messages distinguish them.
    """

    def collides(self, q: Array) -> bool:
        """Return whether the robot at q (dof,) [rad] collides with itself or an obstacle, or violates a constraint."""
        if self.constraints is not None and not self.constraints.holds(q):
            return True
        if self._kernel is not None and self._kernel.colliding(q) >= 0:
            return True
        rules = self._coal_rules_at(q)
        return rules is not None and rules.hit(q)

    def colliding_pair(self, q: Array) -> Pair | None:
        """Return the names of a link or attached object and of what it collides with at q, or None."""
        if self._kernel is not None:
            hit = self._kernel.colliding(q)
            if hit >= 0:
                close = self._kernel.distances(q)[0] <= required_distances(self.rules_at(q))
                return self.pair(int(close.argmax()) if close.any() else hit)
        rules = self._coal_rules_at(q)
        if rules is None or not rules.hit(q):
            return None
        found = rules.pairs(q)
        return self.pair(found[0]) if found else None

    def _proved_free(self, q: Array, moves: float, tcp_moves: float) -> bool:
        """Return whether all positions are free at which no point is farther than `moves` [m] from its place at q."""
        level = next((i for i, margin in enumerate(MARGINS) if margin >= moves), None)
        if level is None:
            return False
        near, far = (self._near, self._far) if self._kernel is None else (self._penetrating, None)
        if near is far:
            return not self._far.hit(q, level)
        travel, rules = self._travel(q), []
        if travel + tcp_moves >= self.contact_distance:
            rules.append(far)
        if travel - tcp_moves < self.contact_distance:
            rules.append(near)
        return not any(rule.hit(q, level) for rule in rules if rule is not None)

    def edge_free(self, a: Array, b: Array) -> bool:
        """Return whether the straight line in joint space from a to b (dof,) [rad] is free.

        Bisects: if the middle is free with a margin of at least the path of any point to the ends, the piece is proved
        free. Where nothing can be proved the pieces end at paths of 1 mm, and their middles decide.
        """
        if self.constraints is not None and not self.constraints.edge_satisfies(a, b):
            return False
        if self._kernel is not None:
            proved = self._kernel.edge_free(a, b)
            if not proved or self._penetrating is None:
                return proved
        span = b - a
        length = float(np.abs(span) @ self._lever)
        tcp_length = float(np.abs(span) @ self._tcp_lever)
        count = max(1, math.ceil(length / (2 * MARGINS[-1])))
        half = 0.5 / count
        pieces = (np.arange(count) * 2 * half + half).tolist()
        while pieces:
            left = []
            for middle in pieces:
                q = a + middle * span
                if self._proved_free(q, length * half, tcp_length * half):
                    continue
                if self.collides(q):
                    return False
                left += [middle - half / 2, middle + half / 2]
            if length * half <= MARGINS[1]:
                return True
            pieces, half = left, half / 2
        return True

    def first_collision(self, path: Array) -> Hit | None:
        """Return the first of the positions (N, dof) [rad] that collides; skips ranges that are proved free."""
        found = None
        if self._kernel is not None:
            index, hit = self._kernel.first_collision(path)
            if index >= 0:
                q = path[index].copy()
                found = Hit(index, q, self.colliding_pair(q) or self.pair(hit))
                path = path[:index]
            if self._penetrating is None or not len(path):
                return found
        stack = [(0, len(path) - 1)]
        while stack:
            i, j = stack.pop()
            m = (i + j) // 2
            q = path[m]
            if i < j:
                away = np.abs(path[i : j + 1] - q).max(axis=0)
                if self._proved_free(q, float(away @ self._lever), float(away @ self._tcp_lever)):
                    continue
                if m > i:
                    stack += [(m + 1, j), (i, m)]
                else:
                    stack += [(j, j), (i, i)]
                continue
            if self.collides(q):
                return Hit(m, q.copy(), self.colliding_pair(q) or ("unknown", "unknown"))
        return found

    def blends_free(self, path: SmoothPath, step: float) -> bool:
        """Return whether the parabolas of a path are free: proved by the kernel, else checked in steps [rad].

        Straight lines of the path must be free already.
        """
        bent = (path.d0 != path.d1).any(axis=1)
        lengths = path.lengths[bent, None]
        d0, d1 = path.d0[bent] * lengths, path.d1[bent] * lengths
        cubics = np.stack([path.starts[bent], d0, 0.5 * (d1 - d0), np.zeros_like(d0)], axis=1)
        if self.constraints is not None and self.constraints.first_violation(cubics) is not None:
            return False
        if self._kernel is None:
            return self.first_collision(path.positions(step)) is None
        if self._kernel.cubics_collision(cubics)[0] >= 0:
            return False
        return self._penetrating is None or self.first_collision(path.positions(step)) is None

    def check_cubics(self, pieces: Array) -> tuple[bool, Hit | None]:
        """Return whether cubics (N, 4, dof) in r from 0 to 1 are proved free, and the collision found instead."""
        if self._kernel is None:
            return False, None
        index, where = self._kernel.cubics_collision(pieces)
        if index < 0:
            return self._penetrating is None, None
        piece = min(int(where), len(pieces) - 1)
        q = (where - piece) ** np.arange(4) @ pieces[piece]
        pair = self.colliding_pair(q)
        return False, None if pair is None else Hit(piece, q, pair)

    def obstruction(self, a: Array, b: Array, step: float) -> Obstruction:
        """Return why the straight line from a to b (dof,) [rad] is not free; collisions are checked in steps [rad]."""
        hit = self.first_collision(interpolate([a, b], step))
        if hit is None and self.constraints is not None:
            violation = self.constraints.edge_violation(a, b)
            if violation:
                return Obstruction("constraint", violation, None)
        pair = hit.pair if hit else ("robot", "scene")
        return Obstruction("collision", f"{pair[0]} collides with {pair[1]}", pair)


def interpolate(waypoints: Sequence[Array] | Array, step: float) -> Array:
    """Return positions (N, dof) [rad] along straight lines between waypoints, at most `step` apart in each joint."""
    pieces = [np.asarray(waypoints[0], dtype=float)[None, :]]
    for a, b in pairwise(waypoints):
        count = max(1, math.ceil(float(np.abs(b - a).max()) / step))
        pieces.append(a + np.linspace(0, 1, count + 1)[1:, None] * (b - a))
    return np.concatenate(pieces)
