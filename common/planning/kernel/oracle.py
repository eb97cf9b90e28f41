"""Compare the kernel with coal at random positions, shapes and edges, and report where they disagree."""

from __future__ import annotations

from dataclasses import dataclass, field

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from common.planning.kernel.world import KernelWorld

Array = NDArray[np.float64]

DEPTH = 1e-6  # [m] shapes that penetrate deeper must not be reported as free
DISTANCE = 1e-6  # [m] largest difference of distances
_COAL_TOLERANCE = 1e-10  # coal's own is 1e-6, and its distances of cylinders are wrong by three times that


@dataclass
class Comparison:
    """What was compared, and how far the answers differ."""

    states: int = 0
    pairs: int = 0
    free_edges: int = 0
    blocked_edges: int = 0
    worst_distance: float = 0.0  # [m] between the two distances of a pair that is apart
    widest: float = 0.0  # [m] between the kernel's own two bounds of such a pair
    faults: list[str] = field(default_factory=list)

    def __add__(self, other: Comparison) -> Comparison:
        return Comparison(
            self.states + other.states,
            self.pairs + other.pairs,
            self.free_edges + other.free_edges,
            self.blocked_edges + other.blocked_edges,
            max(self.worst_distance, other.worst_distance),
            max(self.widest, other.widest),
            self.faults + other.faults,
        )


def random_shape(rng: np.random.Generator) -> coal.CollisionGeometry:
    """Return a sphere, box, cylinder, capsule or hull of 1 mm to 0.6 m."""
    a, b, c = np.exp(rng.uniform(np.log(0.001), np.log(0.3), 3)).tolist()
    kind = rng.integers(5)
    if kind == 0:
        return coal.Sphere(a)
    if kind == 1:
        return coal.Box(2 * a, 2 * b, 2 * c)
    if kind == 2:
        return coal.Cylinder(a, 2 * b)
    if kind == 3:
        return coal.Capsule(a, 2 * b)
    points = coal.StdVec_Vec3s()
    for point in rng.normal(size=(int(rng.integers(5, 40)), 3)) * (max(a, 0.01), max(b, 0.01), max(c, 0.01)):
        points.append(point)
    return coal.Convex.convexHull(points, True, "Qt")


def random_geometry(
    model: pin.Model, geometry: pin.GeometryModel, rng: np.random.Generator, *, obstacles: int = 6, held: int = 1
) -> pin.GeometryModel:
    """Return a robot's shapes among random ones, `held` of which the last joint carries."""
    grown = geometry.copy()
    links = [(i, item.parentJoint) for i, item in enumerate(geometry.geometryObjects)]
    last = model.njoints - 1

    def add(joint: int, spread: float) -> int:
        place = pin.SE3(pin.exp3(rng.normal(size=3) * 2), rng.uniform(-spread, spread, 3))
        return int(grown.addGeometryObject(pin.GeometryObject(f"x{grown.ngeoms}", joint, 0, place, random_shape(rng))))

    around = [add(0, 1.0) for _ in range(obstacles)]
    carried = [add(last, 0.2) for _ in range(held)]
    pairs = [(i, other) for i, joint in links if joint for other in around]
    pairs += [(i, other) for i, joint in links if joint != last for other in carried]
    pairs += [(one, other) for one in carried for other in around]
    for one, other in pairs:
        grown.addCollisionPair(pin.CollisionPair(one, other))
    return grown


class Oracle:
    """Coal's distances of all pairs, as exact as coal can compute them."""

    def __init__(self, model: pin.Model, geometry: pin.GeometryModel) -> None:
        self._model, self._geometry = model, geometry
        self._data, self._shapes = model.createData(), pin.GeometryData(geometry)
        for request in self._shapes.distanceRequests:
            request.gjk_tolerance = _COAL_TOLERANCE
            request.gjk_max_iterations = 1000

    def distances(self, q: Array) -> Array:
        """Return (pairs,) distances [m] at q; negative where shapes touch."""
        pin.forwardKinematics(self._model, self._data, q)
        pin.updateGeometryPlacements(self._model, self._data, self._geometry, self._shapes)
        pin.computeDistances(self._geometry, self._shapes)
        return np.array([result.min_distance for result in self._shapes.distanceResults])


def compare(
    model: pin.Model,
    geometry: pin.GeometryModel,
    rng: np.random.Generator,
    *,
    states: int,
    edges: int = 0,
    samples: int = 40,
    margin: float = 0.0,
) -> Comparison:
    """Compare both at random states, and on edges and cubics between them at random positions.

    Args:
        states: number of random positions within the limits; edges: between free ones, long and short.
        samples: positions of each free edge at which coal checks.
        margin: required distance [m] of all pairs.
    """
    kernel, oracle, found = KernelWorld(model, geometry), Oracle(model, geometry), Comparison()
    kernel.set_rules(np.full(kernel.pair_count, margin))
    lower, upper = np.array(model.lowerPositionLimit), np.array(model.upperPositionLimit)
    free: list[Array] = []
    for _ in range(states):
        q = rng.uniform(lower, upper)
        hit = kernel.colliding(q)
        above, below = kernel.distances(q)
        truth = oracle.distances(q)
        apart = truth > DISTANCE
        found.states, found.pairs = found.states + 1, found.pairs + len(truth)
        if apart.any():
            off = np.abs(above - truth)[apart]
            found.worst_distance = max(found.worst_distance, float(off.max()))
            found.widest = max(found.widest, float((above - below)[apart].max()))
            if off.max() > DISTANCE:
                i = int(np.flatnonzero(apart)[off.argmax()])
                found.faults.append(f"{_named(geometry, i)}: {above[i]:.9f} m, coal has {truth[i]:.9f} m")
        for i in np.flatnonzero((truth < -DEPTH) & ((above > 0) | (below > 0))).tolist():
            found.faults.append(f"{_named(geometry, i)}: apart by {above[i]:g} m, coal has {truth[i]:g} m")
        least = float(truth.min(initial=np.inf)) - margin
        if hit < 0 and least < -DEPTH:
            found.faults.append(f"{_named(geometry, int(truth.argmin()))}: free, coal has {truth.min():g} m")
        if hit >= 0 and least > DEPTH:
            found.faults.append(f"{_named(geometry, hit)}: not free, coal has {least:g} m more than the margin")
        if hit < 0:
            free.append(q)
    if len(free) > 1:
        for _ in range(edges):
            _compare_edge(kernel, oracle, geometry, free, rng, samples, margin, found)
    return found


def _compare_edge(
    kernel: KernelWorld, oracle: Oracle, geometry: pin.GeometryModel, free: list[Array], rng: np.random.Generator,
    samples: int, margin: float, found: Comparison,
) -> None:
    """Compare both on an edge or cubic between two of the free positions."""
    i, j = rng.choice(len(free), 2, replace=False)
    span = (free[j] - free[i]) * rng.uniform() ** 2
    bend, twist = rng.normal(size=(2, len(span))) * rng.choice([0.0, 0.3]) * np.linalg.norm(span)
    cubic = np.array([free[i], span - bend - twist, bend, twist])
    if bend.any():
        hit, at = kernel.cubics_collision(cubic[None])
    else:
        hit, at = kernel.edge_collision(free[i], free[i] + span)
    if hit >= 0:
        found.blocked_edges += 1
        least = float(oracle.distances(at ** np.arange(4) @ cubic)[hit]) - margin
        if least > 1e-5:
            found.faults.append(f"{_named(geometry, hit)}: edge not free where coal has {least:g} m to spare")
        return
    found.free_edges += 1
    for share in rng.uniform(size=samples):
        truth = oracle.distances(share ** np.arange(4) @ cubic)
        if truth.min(initial=np.inf) - margin < -DEPTH:
            where = _named(geometry, int(truth.argmin()))
            found.faults.append(f"{where}: edge free, coal has {truth.min():g} m at {share:.6f}")


def _named(geometry: pin.GeometryModel, index: int) -> str:
    pair = geometry.collisionPairs[index]
    items = [geometry.geometryObjects[i] for i in (pair.first, pair.second)]
    return " - ".join(f"{item.name} ({type(item.geometry).__name__})" for item in items)
