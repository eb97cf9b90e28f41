"""Sets of points in the compiled kernel: it agrees with coal on a sphere for each point."""

from __future__ import annotations

import coal
import numpy as np
import pinocchio as pin
import pytest

from common.planning.kernel import library
from common.planning.kernel.oracle import DEPTH, DISTANCE, Oracle
from common.planning.kernel.world import KernelWorld
from common.planning.robot_geometry import RobotGeometry
from tests.common.planning.scenes import ROBOT, UR5
from tests.common.planning.test_kernel import at, robot_with

pytestmark = pytest.mark.skipif(library.library() is None, reason="the planning kernel is not built here")


def worlds(model, hulls: pin.GeometryModel, spheres: np.ndarray, held: bool) -> tuple[KernelWorld, Oracle, list]:
    """The kernel with a set of points, coal with a sphere for each point, and the links in the order of the pairs."""
    seen, single = hulls.copy(), hulls.copy()
    for geometry in (seen, single):
        geometry.removeAllCollisionPairs()
        if held:
            place = pin.SE3(pin.exp3(np.array([0.3, -0.2, 0.9])), np.array([0.02, 0.01, 0.1]))
            last = model.njoints - 1
            geometry.addGeometryObject(pin.GeometryObject("held", last, 0, place, coal.Cylinder(0.03, 0.2)))
    links = [i for i, item in enumerate(seen.geometryObjects) if item.parentJoint]
    index = seen.addGeometryObject(pin.GeometryObject("points", 0, 0, pin.SE3.Identity(), coal.Sphere(1e-6)))
    for i in links:
        seen.addCollisionPair(pin.CollisionPair(i, index))
    for k, (x, y, z, r) in enumerate(spheres.tolist()):
        place = pin.SE3(np.eye(3), np.array([x, y, z]))
        one = single.addGeometryObject(pin.GeometryObject(f"s{k}", 0, 0, place, coal.Sphere(r)))
        for i in links:
            single.addCollisionPair(pin.CollisionPair(i, one))
    kernel = KernelWorld(model, seen, points=[index])
    kernel.set_points(index, spheres)
    kernel.refresh()
    return kernel, Oracle(model, single), links


@pytest.mark.parametrize(("robot", "seed"), [(ROBOT, 1), *(
    pytest.param(*case, marks=pytest.mark.campaign) for case in ((ROBOT, 0), (UR5, 0), (UR5, 1)))])
def test_kernel_agrees_with_coal_on_spheres(robot, seed):
    rng, model = np.random.default_rng(seed), robot.model
    count = 60
    around, far = rng.uniform(-np.pi, np.pi, count), rng.uniform(0.35, 0.8, count)  # the base has room
    heights, radii = rng.uniform(0, 0.8, count), rng.uniform(0, 0.03, count)
    spheres = np.column_stack([far * np.cos(around), far * np.sin(around), heights, radii])
    spheres[:20, :3] = rng.uniform((0.45, 0.15, 0.35), (0.55, 0.25, 0.45), (20, 3))  # as dense as camera points
    kernel, oracle, links = worlds(model, RobotGeometry(robot).geometry, spheres, held=seed == 1)
    margin = 0.01 * seed
    kernel.set_rules(np.full(kernel.pair_count, margin))

    def truth(q):
        return oracle.distances(q).reshape(count, len(links)).min(axis=0)

    free, met = [], 0
    for q in rng.uniform(np.array(model.lowerPositionLimit), np.array(model.upperPositionLimit), (40, model.nq)):
        hit, (above, below), exact = kernel.colliding(q), kernel.distances(q), truth(q)
        apart = exact > DISTANCE
        assert np.abs(above - exact)[apart].max(initial=0) < DISTANCE
        assert (above - below)[apart].max(initial=0) < DISTANCE
        assert not ((exact < -DEPTH) & ((above > 0) | (below > 0))).any()
        assert (exact.min() - margin >= -DEPTH) if hit < 0 else (exact[hit] - margin <= DEPTH)
        met += hit >= 0
        if hit < 0:
            free.append(q)
    assert met > 3 and len(free) > 5
    proved = 0
    for _ in range(25):
        i, j = rng.choice(len(free), 2, replace=False)
        span = (free[j] - free[i]) * rng.uniform() ** 2
        bend = rng.normal(size=len(span)) * rng.choice([0.0, 0.3]) * np.linalg.norm(span)
        cubic = np.array([free[i], span - bend, bend, 0 * bend])
        hit, share = kernel.cubics_collision(cubic[None])
        if hit >= 0:
            assert truth(share ** np.arange(4) @ cubic)[hit] - margin < 1e-5
            continue
        proved += 1
        for t in np.linspace(0, 1, 25):
            assert truth(t ** np.arange(4) @ cubic).min() - margin >= -DEPTH
        path = np.linspace(0, 1, 200)[:, None] ** np.arange(4) @ cubic
        assert kernel.first_collision(path)[0] < 0
    assert proved > 3


def test_tiny_sphere_on_an_edge_is_found():
    model, geometry = robot_with((coal.Box(0.002, 0.02, 0.02), (0, 0, 0)))
    kernel, _, _ = worlds(model, geometry, np.array([[0.123, 0.0, 0.0, 1e-5]]), held=False)
    assert kernel.colliding(at(-0.5)) < 0 and not kernel.edge_free(at(-0.5), at(0.5))
    assert kernel.edge_free(at(-0.5), at(0.12198))
    kernel.set_points(1, np.zeros((0, 4)))
    kernel.refresh()
    assert kernel.edge_free(at(-0.5), at(0.5))
