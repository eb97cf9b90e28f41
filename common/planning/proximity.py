"""How near the robot is to what it may not touch, and which way leads away: distances with gradients."""

from __future__ import annotations

from dataclasses import dataclass, fields

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from common.planning.collision import CollisionWorld

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class Near:
    """Pairs within reach, at several positions of the robot.

    Attributes:
        position: (K,) which of the positions.
        pair: (K,) index of the pair in the collision world.
        distance: (K,) [m] how much farther apart they are than they must be; negative where they are too close.
        reach: (K,) [m] within which the pair was looked for.
        gradient: (K, dof) [m/rad] of the distance.
    """

    position: Indices
    pair: Indices
    distance: Array
    reach: Array
    gradient: Array


def joined(one: Near, other: Near) -> Near:
    """What is near in both."""
    return Near(*(np.concatenate([getattr(one, f.name), getattr(other, f.name)]) for f in fields(Near)))


@dataclass
class _Known:
    """Distances (pairs,) [m] of all pairs at q (dof,): how close they can be elsewhere follows from them."""

    q: Array
    distances: Array


class Proximity:
    """Measures one collision world. A pair that was far away is measured again only when it may have come near."""

    def __init__(
        self, world: CollisionWorld, reach: float, *, own_reach: float | None = None, nearest: bool = False
    ) -> None:
        """Take over the world's pairs.

        Args:
            world: which pairs count, and how far apart they must be.
            reach: pairs farther apart [m] than they must be by this are of no interest.
            own_reach: the same for two links of the robot; as `reach` when not given.
            nearest: of the pairs of each link only the nearest.
        """
        self._world = world
        self._bank = world.bank
        self._bank.mesh_points()
        own = self._bank.second < self._bank.robot_count
        self._reach = np.where(own, reach if own_reach is None else own_reach, reach)
        self._longest = float(self._reach.max(initial=0.0))
        self._nearest = nearest
        self._data = pin.GeometryData(self._bank.geometry)
        self._known: dict[int, _Known] = {}
        model = self._bank.model
        joints = [item.parentJoint for item in self._bank.geometry.geometryObjects]
        self._first = np.array([joints[i] for i in self._bank.first], dtype=int)
        self._second = np.array([joints[i] for i in self._bank.second], dtype=int)
        self._moved = np.zeros((model.njoints, model.nv))  # 1 where a joint's body is moved by a degree of freedom
        for joint in range(1, model.njoints):
            for support in model.supports[joint]:
                if support > 0:
                    self._moved[joint, model.joints[support].idx_v] = 1.0

    def forget(self) -> None:
        """Measure everything again: the next path has little to do with the last."""
        self._known.clear()

    def measure(self, path: Array) -> Near:
        """Pairs within reach at each position of a path (N, dof) [rad], which best differs little from the last."""
        found = [self._at(q, i) for i, q in enumerate(path)]
        return Near(
            np.repeat(np.arange(len(path)), [len(pairs) for pairs, _, _ in found]),
            np.concatenate([pairs for pairs, _, _ in found]),
            np.concatenate([distances for _, distances, _ in found]),
            np.concatenate([self._reach[pairs] for pairs, _, _ in found]),
            np.concatenate([gradients for _, _, gradients in found]),
        )

    def _at(self, q: Array, slot: int) -> tuple[Indices, Array, Array]:
        bank, data, kinematics = self._bank, self._data, self._bank.data
        rules = self._world.rules_at(q)
        pin.computeJointJacobians(bank.model, kinematics, q)
        pin.updateGeometryPlacements(bank.model, kinematics, bank.geometry, data)
        wanted = self._reach + rules.margins
        known = self._known.get(slot)
        if known is None:
            known = self._known[slot] = self._all(q)
            candidates = np.flatnonzero(known.distances < wanted)
        else:
            way = float(np.abs(q - known.q) @ bank.lever)
            candidates = np.flatnonzero(known.distances - way * bank.shares < wanted)
            if len(candidates) > 20 and way > self._longest:  # measured again from here, fewer will do the next time
                del self._known[slot]
                return self._at(q, slot)
        left = [i for i in candidates.tolist() if i not in rules.disabled]
        if not left:
            return np.zeros(0, dtype=int), np.zeros(0), np.zeros((0, bank.model.nv))
        results = [pin.computeDistance(bank.geometry, data, i) for i in left]
        pairs = np.array(left)
        distances = np.array([result.min_distance for result in results]) - rules.margins[pairs]
        keep = np.flatnonzero(distances < self._reach[pairs])
        if self._nearest:
            keep = keep[np.lexsort((distances[keep], bank.first[pairs[keep]]))]
            keep = keep[np.unique(bank.first[pairs[keep]], return_index=True)[1]]
        pairs, distances = pairs[keep], distances[keep]
        kept = [results[i] for i in keep.tolist()]
        normals, ones, others = (
            np.array([getter(result) for result in kept]).reshape(-1, 3) for getter in (_normal, _one, _other)
        )
        return pairs, distances, self._gradients(pairs, normals, ones, others)

    def _all(self, q: Array) -> _Known:
        pin.computeDistances(self._bank.geometry, self._data)
        return _Known(q.copy(), np.array([result.min_distance for result in self._data.distanceResults]))

    def _gradients(self, pairs: Indices, normals: Array, ones: Array, others: Array) -> Array:
        """(K, dof) of n (p2 - p1), with the normal n from the first to the second: n J2(p2) - n J1(p1).

        A column of the world Jacobian moves a point p by v + w x p, and n (w x p) = w (p x n).
        """
        J = self._bank.data.J
        lifted = normals @ J[:3]
        by_second = self._moved[self._second[pairs]] * (lifted + np.cross(others, normals) @ J[3:])
        by_first = self._moved[self._first[pairs]] * (lifted + np.cross(ones, normals) @ J[3:])
        return np.asarray(by_second - by_first)


def _normal(result: coal.DistanceResult) -> Array:
    return np.asarray(result.normal)


def _one(result: coal.DistanceResult) -> Array:
    return np.asarray(result.getNearestPoint1())


def _other(result: coal.DistanceResult) -> Array:
    return np.asarray(result.getNearestPoint2())
