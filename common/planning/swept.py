"""How near links come to what stands still while the robot goes from one waypoint to the next: swept hulls.

Schulman et al., "Motion planning with sequential convex optimization and convex collision checking" (IJRR 2014): the
hull of a link at both ends of an edge stands for all that it sweeps, and a step is expected to move the hull's nearest
point with the end whose link reaches as far. A link that turns much bulges out of it: the last check proves what is
free.
"""

from __future__ import annotations

from dataclasses import dataclass

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from common.planning.collision import CollisionWorld
from common.planning.proximity import Near

Array = NDArray[np.float64]

_EQUAL = 1e-3  # [m] by which both ends may differ in how far they reach, to share what has to be done
_SIDES = 16  # of the prism about a cylinder
_POINT = 1e-5  # [m] size of what stands for a point: coal makes hulls of bodies
_HALF = 0.55  # of the way between the ends, that of what turns is longer than the straight one
_STILL = coal.Transform3s()


@dataclass(frozen=True)
class _Core:
    """Points (N, 3) in the frame of a joint, and a radius [m] about their hull."""

    points: Array
    radius: float


class SweptPieces:
    """Measures the edges of a path in one collision world."""

    def __init__(self, world: CollisionWorld, clearance: float) -> None:
        """Take over the world's pairs of what moves and what stands; edges that keep a clearance [m] need no hulls."""
        self._world, self._clearance = world, clearance
        bank = world.bank
        items = bank.geometry.geometryObjects
        self._joints = np.array([item.parentJoint for item in items])
        shapes = np.array([isinstance(item.geometry, coal.ShapeBase) for item in items])
        self._usable = (self._joints[bank.second] == 0) & (self._joints[bank.first] > 0) & shapes[bank.second]
        self._cores: dict[int, _Core | None] = {}
        model = bank.model
        self._moved = np.zeros((model.njoints, model.nv))
        for joint in range(1, model.njoints):
            for support in model.supports[joint]:
                if support > 0:
                    self._moved[joint, model.joints[support].idx_v] = 1.0

    def measure(self, path: Array) -> Near:
        """What edges of a path (N, dof) [rad] could come nearer to than the clearance.

        `position` counts waypoints and the middles of edges between them, in order: 2 N - 1.
        """
        found = []
        poses = [self._pose(q) for q in path]
        for i in range(len(path) - 1):
            found += self._piece(path, i, poses[i], poses[i + 1])
        positions, pairs, distances, gradients = zip(*found, strict=True) if found else ((), (), (), ())
        return Near(
            np.array(positions, dtype=int),
            np.array(pairs, dtype=int),
            np.array(distances, dtype=float),
            np.full(len(found), np.inf),
            np.array(gradients, dtype=float).reshape(-1, path.shape[1]),
        )

    def _pose(self, q: Array) -> tuple[list[Array], Array]:
        """(4, 4) of each joint, and the Jacobian (6, dof) of all, world."""
        bank = self._world.bank
        pin.computeJointJacobians(bank.model, bank.data, q)
        return [pose.homogeneous for pose in bank.data.oMi], np.array(bank.data.J)

    def _piece(
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
            thing = bank.geometry.geometryObjects[int(bank.second[pair])]
            result = coal.DistanceResult()
            place = coal.Transform3s(thing.placement.rotation, thing.placement.translation)
            coal.distance(hulls[link], _STILL, thing.geometry, place, coal.DistanceRequest(), result)
            distance = result.min_distance - float(rules.margins[pair])
            if link in nearest and nearest[link][2] <= distance:
                continue
            position, gradient = self._follows(link, np.asarray(result.normal), ends[link], one[1], other[1])
            last = 2 * (len(path) - 1)
            shift = 1 if 2 * i + position == 0 else -1 if 2 * i + position == last else 0  # the ends do not move
            nearest[link] = 2 * i + position + shift, pair, distance, gradient
        return list(nearest.values())

    def _follows(
        self, link: int, n: Array, ends: tuple[Array, Array, float], J_one: Array, J_other: Array
    ) -> tuple[int, Array]:
        """Which end the nearest point moves with, 0 or 2, or 1 for both; and the gradient (dof,) of the distance."""
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
        """(pairs,) [m] about how far apart pairs are at q; 0 or less where they touch."""
        kernel, bank = self._world.kernel, self._world.bank
        return kernel.distances(q)[1] if kernel is not None else bank.distances(q, range(bank.pair_count))

    def _core(self, link: int) -> _Core | None:
        if link not in self._cores:
            self._cores[link] = _core(self._world.bank.geometry.geometryObjects[link])
        return self._cores[link]


def _ends(core: _Core, T_one: Array, T_other: Array) -> tuple[Array, Array, float]:
    """The points (N, 3) at two poses of their joint, and how far [m] at most they are from there half way."""
    one, other = (core.points @ T[:3, :3].T + T[:3, 3] for T in (T_one, T_other))
    return one, other, _HALF * float(np.linalg.norm(other - one, axis=1).max())


def _hull(one: Array, other: Array, radius: float) -> coal.ConvexBase:
    points = coal.StdVec_Vec3s()
    points.extend(list(np.concatenate([one, other])))
    hull = coal.Convex.convexHull(points, False, "Qt")
    hull.setSweptSphereRadius(radius)
    return hull


def _core(item: pin.GeometryObject) -> _Core | None:
    """The points of a shape that a hull can be made of; None for a shape that has none."""
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
