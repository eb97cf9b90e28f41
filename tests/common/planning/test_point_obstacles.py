"""Obstacles from camera points: no point is lost, and the kernel agrees with coal on spheres."""

from __future__ import annotations

import time

import coal
import numpy as np
import pinocchio as pin
import pytest

from common.messages import AttachedObject, JointGoal, PlanRequest
from common.perception.pinhole import Pinhole
from common.planning.collision import CollisionWorld, interpolate
from common.planning.kernel import library
from common.planning.kernel.oracle import DEPTH, DISTANCE, Oracle
from common.planning.kernel.world import KernelWorld
from common.planning.pipeline import PlanningPipeline
from common.planning.point_obstacles import (
    CameraView,
    KnownShapeFilter,
    PointObstacle,
    depth_points,
    downsampled,
    occluded_spheres,
)
from common.planning.robot_geometry import RobotGeometry
from common.robot.transforms import transform
from tests.common.planning.planning_scenes import CELL, GEOMETRY, HOME, ROBOT, SPREAD, ball, cache, held_scene, scene
from tests.common.planning.ur5_scene import ROBOT as UR5

needs_kernel = pytest.mark.skipif(library.library() is None, reason="the planning kernel is not built here")


@pytest.mark.parametrize("side", [0.005, 0.01, 0.1])
def test_every_point_is_inside_a_sphere(backend, side):
    rng = np.random.default_rng(int(side * 1000))
    seen = np.concatenate([rng.normal(size=(500, 3)) * 0.05, rng.uniform(-1, 1, (500, 3)), np.full((3, 3), 0.3)])
    seen[::100] = np.nan
    skip = rng.uniform(size=len(seen)) < 0.1
    spheres = downsampled(seen, side, skip)
    left = seen[~skip & np.isfinite(seen).all(axis=1)]
    away = np.linalg.norm(left[:, None] - spheres[None, :, :3], axis=2) - spheres[None, :, 3]
    assert (away.min(axis=1) <= 0).all()
    assert (spheres[:, 3] >= side / 2).all() and (spheres[:, 3] <= side * 3**0.5).all()
    assert len(spheres) == len(np.unique(np.floor(left / side), axis=0))


@needs_kernel
def test_spheres_are_the_same_without_the_kernel():
    seen = np.random.default_rng(1).uniform(-0.3, 0.3, (3000, 3))
    one = downsampled(seen, 0.02)
    with library.without_kernel():
        other = downsampled(seen, 0.02)
    assert len(one) == len(other)
    np.testing.assert_allclose(one[np.lexsort(one.T)], other[np.lexsort(other.T)], atol=1e-9)


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


@needs_kernel
@pytest.mark.parametrize(("robot", "seed"), [("panda", 1), *(
    pytest.param(*case, marks=pytest.mark.campaign) for case in (("panda", 0), ("ur5", 0), ("ur5", 1)))])
def test_kernel_agrees_with_coal_on_spheres(robot, seed):
    rng = np.random.default_rng(seed)
    one = ROBOT if robot == "panda" else UR5
    model, geometry = one.model, (GEOMETRY if robot == "panda" else RobotGeometry(UR5)).geometry
    count = 60
    around, far = rng.uniform(-np.pi, np.pi, count), rng.uniform(0.35, 0.8, count)  # the base has room
    spheres = np.column_stack(
        [far * np.cos(around), far * np.sin(around), rng.uniform(0, 0.8, count), rng.uniform(0, 0.03, count)]
    )
    spheres[:20, :3] = rng.uniform((0.45, 0.15, 0.35), (0.55, 0.25, 0.45), (20, 3))  # as dense as camera points
    kernel, oracle, links = worlds(model, geometry, spheres, held=seed == 1)
    margin = 0.01 * seed
    kernel.set_rules(np.full(kernel.pair_count, margin))
    lower, upper = np.array(model.lowerPositionLimit), np.array(model.upperPositionLimit)

    def truth(q):
        return oracle.distances(q).reshape(count, len(links)).min(axis=0)

    free, met = [], 0
    for q in rng.uniform(lower, upper, (60, model.nq)):
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
    for _ in range(40):
        i, j = rng.choice(len(free), 2, replace=False)
        span = (free[j] - free[i]) * rng.uniform() ** 2
        bend = rng.normal(size=len(span)) * rng.choice([0.0, 0.3]) * np.linalg.norm(span)
        cubic = np.array([free[i], span - bend, bend, 0 * bend])
        hit, at = kernel.cubics_collision(cubic[None])
        if hit >= 0:
            assert truth(at ** np.arange(4) @ cubic)[hit] - margin < 1e-5
            continue
        proved += 1
        for t in np.linspace(0, 1, 40):
            assert truth(t ** np.arange(4) @ cubic).min() - margin >= -DEPTH
        path = np.linspace(0, 1, 200)[:, None] ** np.arange(4) @ cubic
        assert kernel.first_collision(path)[0] < 0
    assert proved > 3


@needs_kernel
def test_tiny_sphere_on_an_edge_is_found():
    model, geometry = pin.Model(), pin.GeometryModel()
    one = np.ones(1)
    model.addJoint(0, pin.JointModelPX(), pin.SE3.Identity(), "slide", one, one, -one, one)
    geometry.addGeometryObject(pin.GeometryObject("a", 1, 0, pin.SE3.Identity(), coal.Box(0.002, 0.02, 0.02)))
    kernel, _, _ = worlds(model, geometry, np.array([[0.123, 0.0, 0.0, 1e-5]]), held=False)
    assert kernel.colliding(np.array([-0.5])) < 0
    assert not kernel.edge_free(np.array([-0.5]), np.array([0.5]))
    assert kernel.edge_free(np.array([-0.5]), np.array([0.12198]))
    kernel.set_points(1, np.zeros((0, 4)))
    kernel.refresh()
    assert kernel.edge_free(np.array([-0.5]), np.array([0.5]))


def post() -> np.ndarray:
    """Points (N, 3) of a post on the table that obstructs motions from one side to the other."""
    y, z = np.meshgrid(np.arange(-0.02, 0.02, 0.004), np.arange(0.01, 0.3, 0.004))
    return np.concatenate([np.stack([np.full(y.size, x), y.ravel(), z.ravel()], axis=1) for x in (0.38, 0.43)])


def test_world_pads_points_and_names_them(backend):
    spheres = downsampled(post(), 0.02)
    tip = ROBOT.fk(HOME)[:3, 3]
    near = PointObstacle("points of camera", np.array([[*tip, 0.015]]) - (0, 0, 0.02, 0))
    world = CollisionWorld(ROBOT, scene(), start=HOME, cache=cache(), points=[near])
    assert world.colliding_pair(HOME) is None
    deep = PointObstacle("points of camera", np.array([[*tip, 0.02]]) - (0, 0, -0.02, 0))
    shared = cache()
    world = CollisionWorld(ROBOT, scene(), start=HOME, cache=shared, points=[deep])
    assert world.collides(HOME) and "points of camera" in (world.colliding_pair(HOME) or ())
    allowed = [(link, "points of camera") for link in ROBOT.link_names]
    assert not CollisionWorld(ROBOT, scene(), start=HOME, allowed=allowed, cache=shared, points=[deep]).collides(HOME)
    # the newest points count
    other = PointObstacle("points of camera", spheres)
    assert not CollisionWorld(ROBOT, scene(), start=HOME, cache=shared, points=[other]).collides(HOME)
    assert CollisionWorld(ROBOT, scene(), start=HOME, cache=shared, points=[deep]).collides(HOME)
    # padding applies, except where the start is within it
    gap = CollisionWorld(ROBOT, scene(), start=HOME, padding=0.05, cache=shared, points=[near])
    assert not gap.collides(HOME)
    elsewhere = HOME + np.array([0.6, 0, 0, 0, 0, 0, 0])
    assert CollisionWorld(ROBOT, scene(), start=elsewhere, padding=0.05, cache=shared, points=[near]).collides(HOME)


def test_attached_object_is_padded_from_points_except_at_the_start(backend):
    base, tip = held_scene(scene(SPREAD[:2]), "ball_0"), ROBOT.fk(HOME)[:3, 3]
    middle = np.array([[*tip, 0.01]]) - (0, 0, 0.055, 0)  # 15 mm below a ball of 30 mm
    near, deep = (PointObstacle("points of camera", middle - (0, 0, down, 0)) for down in (0.0, -0.02))

    def world(start, points):
        return CollisionWorld(ROBOT, base, start=start, padding=0.03, cache=cache(), points=[points])

    assert not world(HOME, near).collides(HOME)
    assert world(HOME + 0.6 * np.eye(7)[0], near).colliding_pair(HOME) == ("ball_0", "points of camera")
    assert world(HOME, deep).colliding_pair(HOME) == ("ball_0", "points of camera")


def test_points_of_robot_and_known_objects_are_removed(backend):
    rng = np.random.default_rng(2)
    base = scene(SPREAD[:2])
    held = ball(9, 0, 0, 0, role="attached")
    base = base.model_copy(update={"attached": [AttachedObject(link="panda_hand_tcp", object=held)]})
    q = HOME + 0.1
    tip = ROBOT.fk(q)[:3, 3]
    on_robot = tip + rng.normal(size=(50, 3)) * 0.01
    on_ball = np.array([*SPREAD[0], 0.03]) + 0.045 * _directions(rng, 50)  # 15 mm off a ball of 30 mm
    off_ball = np.array([*SPREAD[0], 0.03]) + 0.055 * _directions(rng, 50)
    off_ball = off_ball[off_ball[:, 2] > 0.03]
    free = rng.uniform((0.3, 0.4, 0.3), (0.5, 0.6, 0.5), (50, 3))
    known = KnownShapeFilter(GEOMETRY)
    every = np.concatenate([on_robot, on_ball, off_ball, free])
    mask = known.mask(base, q, every, margin=0.03, object_margin=0.02)
    assert mask[:100].all() and not mask[100:].any()
    obstacle = known.obstacle(CameraView("camera", every, q), base, side=0.01)
    assert np.linalg.norm(obstacle.spheres[:, :3] - tip, axis=1).min() > 0.03


def _directions(rng, count):
    found = rng.normal(size=(count, 3))
    return found / np.linalg.norm(found, axis=1)[:, None]


@needs_kernel
def test_mask_agrees_with_coal():
    rng = np.random.default_rng(3)
    q = HOME + 0.2
    seen = ROBOT.fk(q)[:3, 3] + rng.normal(size=(300, 3)) * 0.15
    given = {"margin": 0.02, "object_margin": 0.01}
    fast = KnownShapeFilter(GEOMETRY).mask(scene(SPREAD), q, seen, **given)
    with library.without_kernel():
        slow = KnownShapeFilter(GEOMETRY).mask(scene(SPREAD), q, seen, **given)
    assert fast.any() and not fast.all()
    assert (fast == slow).all()


CAMERA = Pinhole(100.0, 100.0, 50.0, 40.0, 101, 81, transform(np.diag([1.0, -1.0, -1.0]), (0.4, 0.0, 1.0)))


def test_depth_image_becomes_points_in_world():
    depth = np.full((81, 101), np.nan, dtype=np.float32)
    depth[40, 50], depth[40, 60], depth[0, 0] = 0.8, 0.5, 0.0
    np.testing.assert_allclose(depth_points(depth, CAMERA), [[0.4, 0, 0.2], [0.45, 0, 0.5]], atol=1e-7)


def test_space_that_no_camera_saw_through_is_occupied():
    depth = np.full((81, 101), 1.0, dtype=np.float32)
    depth[30:51, 40:61] = 0.5  # a block, 0.5 m below the camera
    depth[60:, :] = np.nan
    low, high = np.array([0.0, -0.4, 0.0]), np.array([0.8, 0.4, 0.8])
    spheres = occluded_spheres([(depth, CAMERA)], low, high, 0.05)
    middles = spheres[:, :3]

    def occupied(x, y, z):
        return bool((np.linalg.norm(middles - (x, y, z), axis=1) < spheres[:, 3]).any())

    assert occupied(0.41, 0.01, 0.21) and occupied(0.41, 0.01, 0.41)  # behind the block
    assert not occupied(0.41, 0.01, 0.66) and not occupied(0.26, 0.01, 0.21)  # in front of and next to it
    assert occupied(0.41, -0.36, 0.31)  # no depth measured
    assert occupied(0.02, 0.38, 0.75)  # outside the image
    aside = transform(np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]]), (-0.6, 0, 0.2))
    other = Pinhole(100.0, 100.0, 50.0, 40.0, 101, 81, aside)
    both = occluded_spheres([(depth, CAMERA), (np.full((81, 101), 2.0, np.float32), other)], low, high, 0.05)
    assert len(both) < len(spheres)  # each removes what it sees through
    known = KnownShapeFilter(GEOMETRY).unknown("unknown", spheres, scene(), HOME, margin=0.03, object_margin=0.02)
    assert 0 < len(known.spheres) < len(spheres)
    assert not CollisionWorld(ROBOT, scene(), start=HOME, padding=0.02, cache=cache(), points=[known]).collides(HOME)


def _across(number: int = 1) -> PlanRequest:
    start, end = HOME.copy(), HOME.copy()
    start[:4], end[:4] = (-0.5, 0.5, 0.0, -2.0), (0.5, 0.5, 0.0, -2.0)
    return PlanRequest(id=str(number), start=start.tolist(), goal=JointGoal(positions=end.tolist()))


def test_pipeline_plans_around_points(backend):
    pipeline = PlanningPipeline(ROBOT, CELL.motion, CELL.pipeline)
    request = _across()
    seen = PointObstacle("points of camera", downsampled(post(), 0.02))
    truth = CollisionWorld(ROBOT, scene(box=False), start=request.start, cache=cache(), points=[seen])
    without = pipeline.plan(request, scene(box=False))
    assert without.ok and truth.first_collision(_positions(without)) is not None
    found = pipeline.plan(request, scene(box=False), points=[seen])
    assert found.ok, found.message
    assert truth.first_collision(_positions(found)) is None
    end = request.goal.model_copy(update={"positions": [0.0, *request.goal.positions[1:]]})
    inside = pipeline.plan(request.model_copy(update={"goal": end}), scene(box=False), points=[seen])
    assert not inside.ok and "points of camera" in inside.message


def _positions(response) -> np.ndarray:
    return interpolate(np.array([point.positions for point in response.trajectory.points]), 0.005)


@needs_kernel
def test_obstacle_is_created_in_the_time_of_a_frame():
    rng = np.random.default_rng(4)
    seen = rng.uniform((0.2, -0.8, 0), (1.2, 0.8, 0.02), (100_000, 3))
    known, shared = KnownShapeFilter(GEOMETRY), cache()

    def set_up():
        obstacle = known.obstacle(CameraView("camera", seen, HOME), scene(SPREAD))
        return CollisionWorld(ROBOT, scene(SPREAD), start=HOME, cache=shared, points=[obstacle])

    set_up()
    began = time.process_time()
    for _ in range(3):
        set_up()
    assert (time.process_time() - began) / 3 < 0.15  # a fifth of that on an idle machine
