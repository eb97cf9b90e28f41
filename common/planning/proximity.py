"""Distances with gradients between the robot and its surroundings: at positions, and of swept links along edges.

Swept hulls follow Schulman et al., "Motion planning with sequential convex optimization and convex collision checking"
(IJRR 2014): the hull of a link at both ends of an edge approximates all that it sweeps, and a step is expected to move
the hull's nearest point with the end whose link reaches as far. A link that turns much bulges out of the hull: the
final check proves what is free.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from common.planning.collision import CollisionWorld

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_EQUAL = 1e-3  # [m] reaches of both ends that differ by less share the gradient
_SIDES = 16  # of the prism about a cylinder
_POINT = 1e-5  # [m] size of the body that replaces a point: coal makes hulls of bodies only
_HALF = 0.55  # of the distance between the ends: the path of a turning point is longer than the straight one
_STILL = coal.Transform3s()


@dataclass(frozen=True)
class NearPairs:
    """Pairs within reach, at several positions of the robot.

    Attributes:
        position: (K,) which of the positions.
        pair: (K,) index of the pair in the collision world.
        distance: (K,) [m] beyond the required distance; negative where a pair is too close.
        reach: (K,) [m] within which the pair was measured.
        gradient: (K, dof) [m/rad] of the distance.
    """

    position: Indices
    pair: Indices
    distance: Array
    reach: Array
    gradient: Array


def concatenated(one: NearPairs, other: NearPairs) -> NearPairs:
    """Return the pairs of both."""
    return NearPairs(*(np.concatenate([getattr(one, f.name), getattr(other, f.name)]) for f in fields(NearPairs)))


def _moved_by(model: pin.Model) -> Array:
    """Return (joints, nv): 1 where a degree of freedom moves the body of a joint, else 0."""
    moved = np.zeros((model.njoints, model.nv))
    for joint in range(1, model.njoints):
        for support in model.supports[joint]:
            if support > 0:
                moved[joint, model.joints[support].idx_v] = 1.0
    return moved


@dataclass
class _Measured:
    """Distances (pairs,) [m] of all pairs at q (dof,), which bound the distances at other positions."""

    q: Array
    distances: Array


class Proximity:
    """Measures one collision world. A pair that was far away is measured again only once it may have come near."""

    def __init__(
        self, world: CollisionWorld, reach: float, *, own_reach: float | None = None, nearest: bool = False
    ) -> None:
        """Copy the world's pairs.

        Args:
            world: the pairs and their required distances.
            reach: [m] beyond the required distance, within which pairs are measured.
            own_reach: the same for two links of the robot; by default `reach`.
            nearest: report only the nearest pair of each link.
        """
        self._world = world
        self._bank = world.bank
        self._bank.mesh_points()
        own = self._bank.second < self._bank.robot_count
        self._reach = np.where(own, reach if own_reach is None else own_reach, reach)
        self._longest = float(self._reach.max(initial=0.0))
        self._nearest = nearest
        self._data = pin.GeometryData(self._bank.geometry)
        self._measured: dict[int, _Measured] = {}
        model = self._bank.model
        joints = [item.parentJoint for item in self._bank.geometry.geometryObjects]
        self._first = np.array([joints[i] for i in self._bank.first], dtype=int)
        self._second = np.array([joints[i] for i in self._bank.second], dtype=int)
        self._moved = _moved_by(model)

    def forget(self) -> None:
        """Discard distances of the last path: the next one is elsewhere."""
        self._measured.clear()

    def measure(self, path: Array) -> NearPairs:
        """Return the pairs within reach at each position of a path (N, dof) [rad]; fastest near the last path."""
        found = [self._at(q, i) for i, q in enumerate(path)]
        return NearPairs(
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
        within = self._reach + rules.margins
        known = self._measured.get(slot)
        if known is None:
            known = self._measured[slot] = self._all(q)
            candidates = np.flatnonzero(known.distances < within)
        else:
            way = float(np.abs(q - known.q) @ bank.lever)
            candidates = np.flatnonzero(known.distances - way * bank.shares < within)
            if len(candidates) > 20 and way > self._longest:  # measured here, fewer will be candidates next time
                del self._measured[slot]
                return self._at(q, slot)
        active = [i for i in candidates.tolist() if i not in rules.disabled]
        if not active:
            return np.zeros(0, dtype=int), np.zeros(0), np.zeros((0, bank.model.nv))
        results = [pin.computeDistance(bank.geometry, data, i) for i in active]
        pairs = np.array(active)
        distances = np.array([result.min_distance for result in results]) - rules.margins[pairs]
        near = np.flatnonzero(distances < self._reach[pairs])
        if self._nearest:
            near = near[np.lexsort((distances[near], bank.first[pairs[near]]))]
            near = near[np.unique(bank.first[pairs[near]], return_index=True)[1]]
        pairs, distances = pairs[near], distances[near]
        results = [results[i] for i in near.tolist()]
        normals, ones, others = (
            np.array([getter(result) for result in results]).reshape(-1, 3) for getter in (_normal, _one, _other)
        )
        return pairs, distances, self._gradients(pairs, normals, ones, others)

    def _all(self, q: Array) -> _Measured:
        pin.computeDistances(self._bank.geometry, self._data)
        return _Measured(q.copy(), np.array([result.min_distance for result in self._data.distanceResults]))

    def _gradients(self, pairs: Indices, normals: Array, ones: Array, others: Array) -> Array:
        """Return (K, dof) the gradient of n (p2 - p1), with the normal n from first to second: n J2(p2) - n J1(p1).

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


@dataclass(frozen=True)
class _Core:
    """Points (N, 3) in the frame of a joint, and a radius [m] about their hull."""

    points: Array
    radius: float


class SweptEdges:
    """Measures the edges of a path in one collision world."""

    def __init__(self, world: CollisionWorld, clearance: float) -> None:
        """Copy the world's pairs of a moving and a fixed shape; edges that keep a clearance [m] need no hulls."""
        self._world, self._clearance = world, clearance
        bank = world.bank
        items = bank.geometry.geometryObjects
        self._joints = np.array([item.parentJoint for item in items])
        shapes = np.array([isinstance(item.geometry, coal.ShapeBase) for item in items])
        self._usable = (self._joints[bank.second] == 0) & (self._joints[bank.first] > 0) & shapes[bank.second]
        self._cores: dict[int, _Core | None] = {}
        self._moved = _moved_by(bank.model)

    def measure(self, path: Array) -> NearPairs:
        """Return the pairs that edges of a path (N, dof) [rad] could bring closer than the clearance.

        `position` counts waypoints and the middles of edges between them, in order: 2 N - 1.
        """
        found = []
        poses = [self._pose(q) for q in path]
        for i in range(len(path) - 1):
            found += self._edge(path, i, poses[i], poses[i + 1])
        positions, pairs, distances, gradients = zip(*found, strict=True) if found else ((), (), (), ())
        return NearPairs(
            np.array(positions, dtype=int),
            np.array(pairs, dtype=int),
            np.array(distances, dtype=float),
            np.full(len(found), np.inf),
            np.array(gradients, dtype=float).reshape(-1, path.shape[1]),
        )

    def _pose(self, q: Array) -> tuple[list[Array], Array]:
        """Return (4, 4) of each joint, and the Jacobian (6, dof) of all, world."""
        bank = self._world.bank
        pin.computeJointJacobians(bank.model, bank.data, q)
        return [pose.homogeneous for pose in bank.data.oMi], np.array(bank.data.J)

    def _edge(
        self, path: Array, i: int, one: tuple[list[Array], Array], other: tuple[list[Array], Array]
    ) -> list[tuple[int, int, float, Array]]:
        bank = self._world.bank
        middle, way = 0.5 * (path[i] + path[i + 1]), 0.5 * float(np.abs(path[i + 1] - path[i]) @ bank.lever)
        rules = self._world.rules_at(middle)
        apart = self._distances(middle) - rules.margins
        near = (apart - way * bank.shares < self._clearance) & self._usable
        near[list(rules.disabled)] = False
        nearest: dict[int, tuple[int, int, float, Array]] = {}
        ends: dict[int, tuple[Array, Array, float]] = {}
        hulls: dict[int, coal.ConvexBase] = {}
        for pair in np.flatnonzero(near).tolist():
            link = int(bank.first[pair])
            core = self._core(link)
            if core is None:
                continue
            if link not in ends:
                ends[link] = _ends(core, *(pose[0][self._joints[link]] for pose in (one, other)))
            if apart[pair] - ends[link][2] >= self._clearance:
                continue
            if link not in hulls:
                hulls[link] = _hull(*ends[link][:2], core.radius)
            obstacle = bank.geometry.geometryObjects[int(bank.second[pair])]
            result = coal.DistanceResult()
            place = coal.Transform3s(obstacle.placement.rotation, obstacle.placement.translation)
            coal.distance(hulls[link], _STILL, obstacle.geometry, place, coal.DistanceRequest(), result)
            distance = result.min_distance - float(rules.margins[pair])
            if link in nearest and nearest[link][2] <= distance:
                continue
            position, gradient = self._nearest_end(link, np.asarray(result.normal), ends[link], one[1], other[1])
            last = 2 * (len(path) - 1)
            shift = 1 if 2 * i + position == 0 else -1 if 2 * i + position == last else 0  # the ends do not move
            nearest[link] = 2 * i + position + shift, pair, distance, gradient
        return list(nearest.values())

    def _nearest_end(
        self, link: int, n: Array, ends: tuple[Array, Array, float], J_one: Array, J_other: Array
    ) -> tuple[int, Array]:
        """Return the end that the nearest point moves with (0 or 2, 1 for both), and the distance's gradient (dof,)."""
        moved = self._moved[self._joints[link]]
        reach, gradients = [], []
        for points, J in ((ends[0], J_one), (ends[1], J_other)):
            x, y, z = p = points[int(np.argmax(points @ n))]
            reach.append(float(p @ n))
            arm = np.array([y * n[2] - z * n[1], z * n[0] - x * n[2], x * n[1] - y * n[0]])  # p x n
            gradients.append(-moved * (n @ J[:3] + arm @ J[3:]))
        if abs(reach[0] - reach[1]) < _EQUAL:
            return 1, 0.5 * (gradients[0] + gradients[1])
        return (0, gradients[0]) if reach[0] > reach[1] else (2, gradients[1])

    def _distances(self, q: Array) -> Array:
        """Return (pairs,) approximate distances [m] at q; 0 or less where a pair touches."""
        kernel, bank = self._world.kernel, self._world.bank
        return kernel.distances(q)[1] if kernel is not None else bank.distances(q, range(bank.pair_count))

    def _core(self, link: int) -> _Core | None:
        if link not in self._cores:
            self._cores[link] = _core(self._world.bank.geometry.geometryObjects[link])
        return self._cores[link]


def _ends(core: _Core, T_one: Array, T_other: Array) -> tuple[Array, Array, float]:
    """Return the points (N, 3) at two poses of their joint, and a bound [m] of their distance to those half way."""
    one, other = (core.points @ T[:3, :3].T + T[:3, 3] for T in (T_one, T_other))
    return one, other, _HALF * float(np.linalg.norm(other - one, axis=1).max())


def _hull(one: Array, other: Array, radius: float) -> coal.ConvexBase:
    points = coal.StdVec_Vec3s()
    points.extend(list(np.concatenate([one, other])))
    hull = coal.Convex.convexHull(points, False, "Qt")
    hull.setSweptSphereRadius(radius)
    return hull


def _core(item: pin.GeometryObject) -> _Core | None:
    """Return the core of a shape, or None for a shape that has none."""
    shape = item.geometry
    dot = _POINT * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    radius = 0.0
    if isinstance(shape, coal.ConvexBase):
        points = np.array([shape.point(k) for k in range(shape.num_points)])
    elif isinstance(shape, coal.Box):
        points = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * np.array(shape.halfSide)
    elif isinstance(shape, coal.Sphere):
        points, radius = dot, shape.radius
    elif isinstance(shape, coal.Capsule):
        ends = np.array([[0, 0, shape.halfLength], [0, 0, -shape.halfLength]])
        points, radius = (dot + ends[:, None]).reshape(-1, 3), shape.radius
    elif isinstance(shape, coal.Cylinder):
        angles = 2 * np.pi * np.arange(_SIDES) / _SIDES
        round_ = shape.radius / np.cos(np.pi / _SIDES) * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        points = np.concatenate(
            [np.hstack([round_, np.full((_SIDES, 1), z)]) for z in (-shape.halfLength, shape.halfLength)])
    else:
        return None
    placement = item.placement
    return _Core(points @ np.array(placement.rotation).T + np.array(placement.translation), radius)
