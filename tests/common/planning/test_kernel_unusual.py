"""The compiled kernel with unusual input: NaN, joints outside limits, unsupported shapes."""

import threading
from itertools import pairwise
from time import thread_time

import coal
import numpy as np
import pinocchio as pin
import pytest

from common.planning.kernel import library
from common.planning.kernel.solvers import find_path
from common.planning.kernel.world import KernelUnavailable, KernelWorld
from tests.common.planning.scenes import GEOMETRY, HOME, ROBOT, TABLE, only, scene, solid, world
from tests.common.planning.test_kernel import at, robot_with, slider

pytestmark = pytest.mark.skipif(library.library() is None, reason="the planning kernel is not built here")

ONE = np.ones(1)
BALL, ORIGIN = coal.Sphere(0.1), (0, 0, 0)


def far_from_everything() -> KernelWorld:
    return slider((BALL, ORIGIN), (coal.Box(0.2, 0.2, 0.2), (5, 0, 0)))


def reaching_arm(limit: float) -> KernelWorld:
    """A joint that turns and one that slides along x within a limit [m], and a sphere 2 m away in direction 1 rad."""
    model, geometry = pin.Model(), pin.GeometryModel()
    turn = model.addJoint(0, pin.JointModelRZ(), pin.SE3.Identity(), "turn", ONE, ONE, -3 * ONE, 3 * ONE)
    slide = model.addJoint(turn, pin.JointModelPX(), pin.SE3.Identity(), "slide", ONE, ONE, -limit * ONE, limit * ONE)
    geometry.addGeometryObject(pin.GeometryObject("tip", slide, 0, pin.SE3.Identity(), coal.Sphere(0.05)))
    place = pin.SE3(np.eye(3), 2 * np.array([np.cos(1), np.sin(1), 0]))
    geometry.addGeometryObject(pin.GeometryObject("post", 0, 0, place, coal.Sphere(0.05)))
    geometry.addCollisionPair(pin.CollisionPair(0, 1))
    return KernelWorld(model, geometry)


@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf])
def test_nan_and_infinity_are_not_free(number):
    for kernel, free in ((far_from_everything(), at(0.0)), (world(scene()).kernel, HOME)):
        none = free.copy()
        none[0] = number
        assert kernel.colliding(none) >= 0
        assert not kernel.edge_free(free, none) and not kernel.edge_free(none, free)
        assert kernel.first_collision(np.array([free, none, free, free]))[0] == 1
        curve = np.zeros((1, 4, kernel.dof))
        curve[0, 0], curve[0, 2] = free, none
        assert kernel.cubics_collision(curve)[0] >= 0


def test_extremely_long_edge_is_not_free():
    assert not world(scene()).edge_free(HOME, np.array([1e7, *HOME[1:]]))


@pytest.mark.parametrize("limit", [0.1, 3.0, 1e308, np.inf])
def test_edge_outside_the_limits_of_a_sliding_joint_is_checked(limit):
    kernel, rng = reaching_arm(limit), np.random.default_rng(0)
    for _ in range(50):
        a, b = np.array([1 - rng.uniform(0.2, 1), 2.0]), np.array([1 + rng.uniform(0.2, 1), 2.0])
        assert not kernel.edge_free(a, b)
        cubic = np.array([a, b - a, [0.0, 0.0], [0.0, 0.0]])
        assert kernel.cubics_collision(cubic[None])[0] == 0 and kernel.edge_free(a - (0, 0.2), b - (0, 0.2))
    along = np.stack([np.linspace(0, 2, 401), np.full(401, 2.0)], axis=1)
    assert kernel.first_collision(along)[0] == 190
    assert not kernel.edge_free(np.array([1.0, 0.0]), np.array([1.0, 3.0]))


def swept(shape: coal.CollisionGeometry) -> coal.CollisionGeometry:
    shape.setSweptSphereRadius(0.1)
    return shape


def shapes(*given):
    return robot_with((BALL, ORIGIN), *given)


def with_joint(joint) -> tuple[pin.Model, pin.GeometryModel]:
    model = pin.Model()
    model.addJoint(0, joint, pin.SE3.Identity(), "joint")
    return model, pin.GeometryModel()


def composite() -> pin.JointModelComposite:
    joint = pin.JointModelComposite()
    joint.addJoint(pin.JointModelRZ(), pin.SE3(np.eye(3), np.array([1.0, 0, 0])))
    return joint


@pytest.mark.parametrize(("arguments", "text"), [
    (with_joint(pin.JointModelHX(0.5)), "HX"),
    (with_joint(composite()), "Composite"),
    (with_joint(pin.JointModelFreeFlyer()), "one degree of freedom"),
    (shapes((coal.Cone(0.1, 0.2), (5, 0, 0))), "Cone"),
    (shapes((swept(coal.Box(0.2, 0.2, 0.2)), (0.25, 0, 0))), "swept"),
    *((shapes((coal.Sphere(size), (0.05 + size, 0, 0))), "larger than") for size in (1e8, 1e155, 1e308)),
])
def test_unsupported_joint_or_shape_is_refused(arguments, text):
    with pytest.raises(KernelUnavailable, match=text):
        KernelWorld(*arguments)


def test_scene_with_an_extremely_large_shape_uses_coal():
    huge = world(only(solid("ground", "fixture", "box", [1e8, 1e8, 1.0], (0, 0, -0.6))))
    assert huge.kernel is None and not huge.collides(HOME)


def test_pair_of_two_fixed_shapes_is_checked():
    for gap, free in ((0.3, True), (0.1, False)):
        model, geometry = shapes((BALL, (3, 0, 0)), (BALL, (3 + gap, 0, 0)))
        geometry.removeAllCollisionPairs()
        geometry.addCollisionPair(pin.CollisionPair(1, 2))
        kernel = KernelWorld(model, geometry)
        assert (kernel.colliding(at(0.0)) < 0) == free and kernel.edge_free(at(0.0), ONE) == free


def test_tiny_steps_of_a_search_respect_limits():
    kernel, ends = far_from_everything(), (at(-0.9), np.array([[0.9]]))
    found = find_path(kernel, *ends, reach=1e-5, nodes=1000)
    assert found.error == "no_path" and found.nodes <= 1000
    began = thread_time()  # not what a busy machine adds
    found = find_path(kernel, *ends, reach=1e-8, nodes=10**9, seconds=0.05)
    assert found.error == "timeout" and thread_time() - began < 1


def test_wrong_arguments_are_refused():
    kernel = KernelWorld(ROBOT.model, GEOMETRY.geometry)
    with pytest.raises(ValueError, match="shape"):
        kernel.colliding(np.zeros(6))
    with pytest.raises(ValueError, match="margins"):
        kernel.set_rules(np.zeros(3))
    with pytest.raises(ValueError, match="goals"):
        find_path(far_from_everything(), at(-0.9), np.zeros((0, 1)))
    with pytest.raises(IndexError):
        far_from_everything().set_pose(2, np.eye(4))


def test_threads_sharing_a_world_get_the_same_answers():
    shared = world(TABLE)
    edges = [*pairwise(np.random.default_rng(0).uniform(ROBOT.lower, ROBOT.upper, (100, ROBOT.dof)))]
    expected = [shared.edge_free(a, b) for a, b in edges]
    wrong: list[int] = []

    def ask() -> None:
        for _ in range(10):
            wrong.extend(i for i, (a, b) in enumerate(edges) if shared.edge_free(a, b) != expected[i])

    threads = [threading.Thread(target=ask) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []
