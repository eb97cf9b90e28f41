"""Obstacles from camera points: no point is lost, known shapes are removed; the kernel agrees with coal."""

import coal
import numpy as np
import pinocchio as pin
import pytest

from common.messages import AttachedObject
from common.perception.pinhole import Pinhole
from common.planning import point_obstacles
from common.planning.collision import interpolate
from common.planning.kernel import library
from common.planning.kernel.oracle import DEPTH, DISTANCE, Oracle
from common.planning.kernel.world import KernelWorld
from common.planning.obstacles import ObstacleCache
from common.planning.pipeline import PlanningPipeline
from common.planning.point_obstacles import CameraView, KnownShapeFilter, PointObstacle, downsampled
from common.planning.robot_geometry import RobotGeometry
from common.robot.transforms import transform
from tests.common.planning.requests import to_joints
from tests.common.planning.scenes import CELL, EMPTY, GEOMETRY, HOME, ROBOT, SPREAD, UR5, ball, held_scene, scene, world
from tests.common.planning.test_kernel import at, robot_with

needs_kernel = pytest.mark.skipif(library.library() is None, reason="the planning kernel is not built here")
TIP = ROBOT.fk(HOME)[:3, 3]
ASIDE = HOME + 0.6 * np.eye(7)[0]


def points(spheres) -> PointObstacle:
    return PointObstacle("points of camera", spheres)


def below_tip(down: float, radius: float) -> PointObstacle:
    """One sphere below the tool at home [m]."""
    x, y, z = TIP
    return points(np.array([[x, y, z - down, radius]]))


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


def post() -> np.ndarray:
    """Points (N, 3) of a post on the table that obstructs motions from one side to the other."""
    y, z = np.meshgrid(np.arange(-0.02, 0.02, 0.004), np.arange(0.01, 0.3, 0.004))
    return np.concatenate([np.stack([np.full(y.size, x), y.ravel(), z.ravel()], axis=1) for x in (0.38, 0.43)])


POST = points(downsampled(post(), 0.02))


def test_world_names_points_and_the_newest_count(backend):
    deep, shared = below_tip(-0.02, 0.02), ObstacleCache(GEOMETRY)

    def collides(obstacle, **more) -> bool:
        return world(scene(), cache=shared, points=[obstacle], **more).collides(HOME)

    assert "points of camera" in world(scene(), points=[deep]).colliding_pair(HOME) and collides(deep)
    assert not collides(deep, allowed=[(link, "points of camera") for link in ROBOT.link_names])
    assert not collides(POST) and collides(deep)


def test_points_are_padded_except_where_the_start_is_within_the_padding(backend):
    near = below_tip(0.02, 0.015)
    assert world(scene(), points=[near]).colliding_pair(HOME) is None
    assert not world(scene(), padding=0.05, points=[near]).collides(HOME)
    assert world(scene(), ASIDE, padding=0.05, points=[near]).collides(HOME)
    held = held_scene(scene(SPREAD[:2]), "ball_0")
    near, deep = below_tip(0.055, 0.01), below_tip(0.035, 0.01)  # 15 mm below a ball of 30 mm, and within it
    pair = ("ball_0", "points of camera")
    assert not world(held, padding=0.03, points=[near]).collides(HOME)
    assert world(held, ASIDE, padding=0.03, points=[near]).colliding_pair(HOME) == pair
    assert world(held, padding=0.03, points=[deep]).colliding_pair(HOME) == pair


def test_points_of_robot_and_known_objects_are_removed(backend):
    rng = np.random.default_rng(2)

    def around_ball(radius: float) -> np.ndarray:
        directions = rng.normal(size=(50, 3))
        return np.array([*SPREAD[0], 0.03]) + radius * directions / np.linalg.norm(directions, axis=1)[:, None]

    held = AttachedObject(link="panda_hand_tcp", object=ball(9, 0, 0, 0, role="attached"))
    base = scene(SPREAD[:2]).model_copy(update={"attached": [held]})
    q = HOME + 0.1
    tip = ROBOT.fk(q)[:3, 3]
    known = [tip + rng.normal(size=(50, 3)) * 0.01, around_ball(0.045)]  # 15 mm off a ball of 30 mm
    off_ball = around_ball(0.055)
    free = [off_ball[off_ball[:, 2] > 0.03], rng.uniform((0.3, 0.4, 0.3), (0.5, 0.6, 0.5), (50, 3))]
    every = np.concatenate([*known, *free])
    mask = KnownShapeFilter(GEOMETRY).mask(base, q, every, margin=0.03, object_margin=0.02)
    assert mask[:100].all() and not mask[100:].any()
    obstacle = KnownShapeFilter(GEOMETRY).obstacle(CameraView("camera", every, q), base, side=0.01)
    assert np.linalg.norm(obstacle.spheres[:, :3] - tip, axis=1).min() > 0.03


CAMERA = Pinhole(100.0, 100.0, 50.0, 40.0, 101, 81, transform(np.diag([1.0, -1.0, -1.0]), (0.4, 0.0, 1.0)))


def test_depth_image_becomes_points_in_world():
    depth = np.full((81, 101), np.nan, dtype=np.float32)
    depth[40, 50], depth[40, 60], depth[0, 0] = 0.8, 0.5, 0.0
    found = point_obstacles.depth_points(depth, CAMERA)
    np.testing.assert_allclose(found, [[0.4, 0, 0.2], [0.45, 0, 0.5]], atol=1e-7)


def test_space_that_no_camera_saw_through_is_occupied():
    depth = np.full((81, 101), 1.0, dtype=np.float32)
    depth[30:51, 40:61] = 0.5  # a block, 0.5 m below the camera
    depth[60:, :] = np.nan
    region = np.array([0.0, -0.4, 0.0]), np.array([0.8, 0.4, 0.8]), 0.05
    spheres = point_obstacles.occluded_spheres([(depth, CAMERA)], *region)

    def occupied(x, y, z):
        return bool((np.linalg.norm(spheres[:, :3] - (x, y, z), axis=1) < spheres[:, 3]).any())

    assert occupied(0.41, 0.01, 0.21) and occupied(0.41, 0.01, 0.41)  # behind the block
    assert not occupied(0.41, 0.01, 0.66) and not occupied(0.26, 0.01, 0.21)  # in front of and next to it
    assert occupied(0.41, -0.36, 0.31)  # no depth measured
    assert occupied(0.02, 0.38, 0.75)  # outside the image
    aside = transform(np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]]), (-0.6, 0, 0.2))
    other = np.full((81, 101), 2.0, np.float32), Pinhole(100.0, 100.0, 50.0, 40.0, 101, 81, aside)
    both = point_obstacles.occluded_spheres([(depth, CAMERA), other], *region)
    assert len(both) < len(spheres)  # each removes what it sees through
    known = KnownShapeFilter(GEOMETRY).unknown("unknown", spheres, scene(), HOME, margin=0.03, object_margin=0.02)
    assert 0 < len(known.spheres) < len(spheres)
    assert not world(scene(), padding=0.02, points=[known]).collides(HOME)


def _positions(response) -> np.ndarray:
    return interpolate(np.array([point.positions for point in response.trajectory.points]), 0.005)


def test_pipeline_plans_around_points(backend):
    pipeline = PlanningPipeline(ROBOT, CELL.motion, CELL.pipeline)
    start, middle, end = ([y, 0.5, 0.0, -2.0, *HOME[4:]] for y in (-0.5, 0.0, 0.5))
    truth = world(EMPTY, start, points=[POST])
    without = pipeline.plan(to_joints(end, start), EMPTY)
    assert without.ok and truth.first_collision(_positions(without)) is not None
    found = pipeline.plan(to_joints(end, start), EMPTY, points=[POST])
    assert found.ok, found.message
    assert truth.first_collision(_positions(found)) is None
    inside = pipeline.plan(to_joints(middle, start), EMPTY, points=[POST])
    assert not inside.ok and "points of camera" in inside.message


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


@needs_kernel
def test_tiny_sphere_on_an_edge_is_found():
    model, geometry = robot_with((coal.Box(0.002, 0.02, 0.02), (0, 0, 0)))
    kernel, _, _ = worlds(model, geometry, np.array([[0.123, 0.0, 0.0, 1e-5]]), held=False)
    assert kernel.colliding(at(-0.5)) < 0 and not kernel.edge_free(at(-0.5), at(0.5))
    assert kernel.edge_free(at(-0.5), at(0.12198))
    kernel.set_points(1, np.zeros((0, 4)))
    kernel.refresh()
    assert kernel.edge_free(at(-0.5), at(0.5))
