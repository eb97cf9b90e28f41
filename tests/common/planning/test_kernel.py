"""The compiled kernel agrees with coal at states and along edges, and its planner returns free paths."""

import threading

import coal
import numpy as np
import pinocchio as pin
import pytest

from common.planning.collision import interpolate
from common.planning.kernel import library
from common.planning.kernel.build import build, compilers
from common.planning.kernel.oracle import Oracle, compare, random_geometry
from common.planning.kernel.solvers import find_path
from common.planning.kernel.world import CONTACT_ALLOWED, KernelWorld
from common.planning.path import blended_path
from common.planning.problem import Cancel
from common.planning.retiming import parametrise
from common.planning.robot_geometry import RobotGeometry
from tests.common.planning.requests import above
from tests.common.planning.scenes import GEOMETRY, ROBOT, TABLE, UR5, world

pytestmark = pytest.mark.skipif(library.library() is None, reason="the planning kernel is not built here")


def robot_with(*shapes) -> tuple[pin.Model, pin.GeometryModel]:
    """A joint that slides along x with a shape on it, and others at points [m]."""
    model, geometry = pin.Model(), pin.GeometryModel()
    one = np.ones(1)
    model.addJoint(0, pin.JointModelPX(), pin.SE3.Identity(), "slide", one, one, -one, one)
    for number, (shape, at) in enumerate(shapes):
        place = pin.SE3(np.eye(3), np.array(at))
        geometry.addGeometryObject(pin.GeometryObject(str(number), 0 if number else 1, 0, place, shape))
        if number:
            geometry.addCollisionPair(pin.CollisionPair(0, number))
    return model, geometry


def slider(*shapes) -> KernelWorld:
    return KernelWorld(*robot_with(*shapes))


def at(x: float) -> np.ndarray:
    return np.array([x])


@pytest.mark.parametrize(("robot", "seed"), [
    (ROBOT, 0), (UR5, 1), *(pytest.param(*case, marks=pytest.mark.campaign) for case in ((ROBOT, 1), (UR5, 0)))])
def test_kernel_agrees_with_coal_on_random_worlds(robot, seed):
    rng = np.random.default_rng(seed)
    geometry = random_geometry(robot.model, RobotGeometry(robot).geometry, rng, obstacles=4, held=1 + seed)
    found = compare(robot.model, geometry, rng, states=40, edges=20, samples=30, margin=0.01 * seed)
    assert found.faults == []
    assert found.pairs > 1000 and found.free_edges > 0
    assert found.worst_distance < 1e-6


@pytest.mark.parametrize("gap", [1e-7, 1e-5, 1e-3])
def test_close_edge_is_free_and_grazing_edge_is_not(gap):
    for sign, free in ((1, True), (-1, False)):
        kernel = slider((coal.Sphere(0.1), (0, 0.2 + sign * gap, 0)), (coal.Box(0.2, 0.2, 0.2), (0, 0, 0)))
        assert kernel.edge_free(at(-1.0), at(1.0)) == free


def test_thin_wall_between_the_ends_of_an_edge_is_found():
    hit, share = slider((coal.Sphere(0.001), (0, 0, 0)), (coal.Box(1e-5, 1, 1), (0.3217, 0, 0))).edge_collision(
        at(-1.0), at(1.0))
    assert hit == 0 and 2 * share - 1 == pytest.approx(0.3217, abs=1.1e-3)


def test_cubic_that_bulges_into_a_wall_is_not_free():
    kernel = slider((coal.Sphere(0.1), (0, 0, 0)), (coal.Box(0.2, 1, 1), (0.7, 0, 0)))
    bulge = np.array([[[0.0], [2.0], [-2.0], [0.0]]])  # from 0 to 0 through 0.5
    assert kernel.edge_free(at(0.0), at(0.0)) and kernel.cubics_collision(bulge)[0] == 0
    assert kernel.cubics_collision(0.999 * bulge)[0] == -1
    kernel.set_rules(np.full(1, CONTACT_ALLOWED))
    assert kernel.cubics_collision(bulge)[0] == -1


def test_margins_and_allowed_contacts_are_applied():
    kernel = slider((coal.Sphere(0.1), (0, 0, 0)), (coal.Capsule(0.1, 0.3), (0.25, 0, 0)))
    for margin, hit in ((0.0, -1), (0.0499, -1), (0.0501, 0), (CONTACT_ALLOWED, -1)):
        kernel.set_rules(np.full(1, margin))
        assert kernel.colliding(at(0.0)) == hit


def test_contact_is_allowed_within_the_contact_distance():
    kernel = slider((coal.Sphere(0.1), (0, 0, 0)), (coal.Box(0.2, 0.2, 0.2), (0.19, 0, 0)))
    kernel.set_rules(np.zeros(1), np.full(1, CONTACT_ALLOWED), 1, np.zeros(3), np.zeros(3), 0.02)
    assert kernel.colliding(at(0.0)) == -1
    assert kernel.edge_free(at(0.0), at(-0.5))  # the contact ends within the contact distance
    assert not kernel.edge_free(at(0.0), at(0.03))
    kernel.set_rules(np.zeros(1), np.full(1, CONTACT_ALLOWED), 1, np.zeros(3), np.zeros(3), 0.005)
    assert not kernel.edge_free(at(0.0), at(-0.5))


def test_paths_are_free_reach_their_ends_and_depend_on_the_seed():
    around = world(TABLE)
    left, right = above(0.45, 0.35, 0.03), above(0.45, 0.12, 0.03)
    assert not around.edge_free(left, right)
    oracle = Oracle(around.bank.model, around.bank.geometry)
    paths = [find_path(around.kernel, left, right[None], seed=seed).waypoints for seed in (1, 1, 2)]
    for path in paths:
        np.testing.assert_array_equal(path[[0, -1]], [left, right])
        assert (path >= ROBOT.lower).all() and (path <= ROBOT.upper).all()
        assert min(oracle.distances(q).min() for q in interpolate(path, 0.05)) > -1e-6
    np.testing.assert_array_equal(paths[0], paths[1])
    assert paths[2].shape != paths[0].shape or (paths[2] != paths[0]).any()


def test_impossible_search_ends_on_time_and_when_cancelled():
    kernel = slider((coal.Sphere(0.1), (0, 0, 0)), (coal.Box(0.1, 1, 1), (0, 0, 0)))
    ends = at(-0.9), np.array([[0.9]])
    found = find_path(kernel, *ends, seconds=0.02)
    assert found.waypoints is None and found.error == "timeout"
    assert found.search_seconds < 5
    cancel = Cancel()
    timer = threading.Timer(0.02, cancel.set)
    timer.start()
    assert find_path(kernel, *ends, seconds=60, cancel=cancel.word).error == "cancelled"  # the timer's thread runs
    timer.join()
    assert find_path(kernel, *ends, nodes=10).error == "no_path"


def test_both_libraries_agree(monkeypatch):
    if not (library.FOLDER / f"{library.NAME}_avx2.so").exists():
        pytest.skip("one library serves this processor")
    rng = np.random.default_rng(5)
    geometry = random_geometry(ROBOT.model, GEOMETRY.geometry, rng)
    fast = KernelWorld(ROBOT.model, geometry)
    plain = library._open(library.FOLDER / f"{library.NAME}.so")
    monkeypatch.setattr("common.planning.kernel.world.library", lambda: plain)
    slow = KernelWorld(ROBOT.model, geometry)
    for q in rng.uniform(ROBOT.lower, ROBOT.upper, (50, ROBOT.dof)):
        np.testing.assert_allclose(fast.distances(q)[0], slow.distances(q)[0], atol=1e-9)
        assert (fast.colliding(q) < 0) == (slow.colliding(q) < 0)


def test_missing_compiler_builds_nothing_and_other_versions_are_not_loaded(tmp_path, monkeypatch):
    monkeypatch.setenv("CC", "a-compiler-that-is-not-there")
    assert ["a-compiler-that-is-not-there"] not in compilers()
    for none in ([], [["false"]]):
        (tmp_path / "planning_kernel.so").write_bytes(b"of older sources")
        monkeypatch.setattr("common.planning.kernel.build.compilers", lambda none=none: none)
        assert build(tmp_path, tmp_path) == [] == list(tmp_path.iterdir())
    assert library._open(tmp_path / "planning_kernel.so") is None
    monkeypatch.setattr(library, "VERSION", -1)
    assert library._open(library.FOLDER / f"{library.NAME}.so") is None


def test_timing_is_the_same_without_the_kernel():
    path = blended_path(np.random.default_rng(2).uniform(-1, 1, (6, 7)), np.full(6, 0.2))[0]
    fast = parametrise(path, np.ones(7), np.full(7, 3.0))
    with library.without_kernel():
        plain = parametrise(path, np.ones(7), np.full(7, 3.0))
    for one, other in zip(vars(fast).values(), vars(plain).values(), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)
