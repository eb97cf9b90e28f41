"""Motions are planned for the gripper's width: closed fingers fit into a gap, open ones around a wall."""

from functools import cache

import coal
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.messages import Header, JointState
from common.planning.camera_obstacles import JointHistory
from common.planning.collision import CollisionWorld
from common.planning.obstacles import ObstacleCache
from common.planning.pipeline import PlanningPipeline
from common.planning.point_obstacles import CameraView, KnownShapeFilter
from common.planning.robot_geometry import RobotGeometry, convex_hulls
from common.planning.trajectory import timed_path
from common.planning.validation import fine_samples
from common.robot.finger_joints import finger_positions, measured_width
from common.robot.model import RobotModel
from common.robot.transforms import pose_to_matrix
from tests.common.planning.requests import above, to_joints
from tests.common.planning.scenes import CELL, EMPTY, GEOMETRY, HOME, ROBOT, UR5, only, solid

HULLS = {"panda": GEOMETRY, "ur5": RobotGeometry(UR5)}
OPEN, CLOSED = 0.08, 0.0
X, LOW = 0.5, 0.02  # target of the tool, and its height there [m]
# Fingers close along y: only closed ones fit between two walls, only open ones around one wall.
GAP = only(*[solid(f"wall at {y}", "fixture", "box", [0.1, 0.02, 0.04], (X, y, 0.02)) for y in (-0.05, 0.05)])
WALL = only(solid("wall", "fixture", "box", [0.1, 0.04, 0.04], (X, 0.0, 0.02)))
START, GOAL = above(X, 0.0, 0.15), above(X, 0.0, LOW)
CASES = [(GAP, CLOSED, True), (GAP, OPEN, False), (WALL, OPEN, True), (WALL, CLOSED, False)]


@cache
def collision_hulls(robot: RobotModel) -> pin.GeometryModel:
    return convex_hulls(robot.full_geometry())


class CoalReference:
    """Collision checks of a robot at a gripper width by coal and the model of all joints."""

    def __init__(self, robot: RobotModel, scene, width: float) -> None:
        self.robot, gripper = robot, robot.config.gripper
        self.model = robot.full_model
        self.hulls = collision_hulls(robot)
        self.shapes = pin.GeometryData(self.hulls)
        self.q, self.data = robot.full_reference.copy(), self.model.createData()
        for name, position in zip(gripper.joints, finger_positions(gripper, width), strict=True):
            self.q[self.model.joints[self.model.getJointId(name)].idx_q] = position
        self.index = [self.model.joints[self.model.getJointId(name)].idx_q for name in robot.joint_names]
        self.links = [self.model.frames[item.parentFrame].name for item in self.hulls.geometryObjects]
        self.solids = [(coal.Box(*o.dimensions), pose_to_matrix(o.pose)) for o in scene.objects]

    def place(self, q) -> None:
        self.q[self.index] = q
        pin.updateGeometryPlacements(self.model, self.data, self.hulls, self.shapes, self.q)

    def touches(self, q) -> bool:
        self.place(q)
        for link, item, T in zip(self.links, self.hulls.geometryObjects, self.shapes.oMg, strict=True):
            at = coal.Transform3s(T.rotation, T.translation)
            for box, pose in self.solids:
                where = coal.Transform3s(pose[:3, :3], pose[:3, 3])
                hit = coal.collide(item.geometry, at, box, where, coal.CollisionRequest(), coal.CollisionResult())
                if hit and link != "panda_link0":
                    return True
        return False


@pytest.fixture
def pipeline(backend):
    return PlanningPipeline(ROBOT, CELL.motion, CELL.pipeline)


def test_motion_is_planned_for_the_current_gripper_width(pipeline):
    for scene, width, free in CASES * 2:  # in turn: each plan uses its own width
        reference = CoalReference(ROBOT, scene, width)
        assert reference.touches(GOAL) is not free and not reference.touches(START)
        response = pipeline.plan(to_joints(GOAL, START), scene, width=width)
        assert response.ok is free, response.message
        if free:
            path, _ = fine_samples(timed_path(response.trajectory), 0.005)
            assert len(path) > 50 and not any(reference.touches(q) for q in path[::4])
        else:
            assert response.error == "goal_in_collision" and "finger" in response.message


def test_gripper_width_of_the_request_overrides_the_current_one(pipeline):
    assert pipeline.plan(to_joints(GOAL, START, gripper_width=CLOSED), GAP, width=OPEN).ok
    assert not pipeline.plan(to_joints(GOAL, START, gripper_width=OPEN), GAP, width=CLOSED).ok
    assert not pipeline.plan(to_joints(GOAL, START), GAP).ok, "the robot file locks it open"
    refused = pipeline.plan(to_joints(GOAL, START, gripper_width=0.1), GAP)
    assert (refused.error, refused.message) == (
        "bad_request", "request_checks: gripper_width 0.1 m is more than the fingers open (0.08 m)")


@pytest.mark.parametrize("robot", [ROBOT, UR5], ids=["panda", "ur5"])
@settings(max_examples=10, deadline=None)
@given(share=st.floats(0, 1), seed=st.integers(0, 1000))
def test_hulls_of_the_fingers_follow_all_joints(robot, share, seed):
    geometry = HULLS[robot.config.name]
    width = share * robot.config.gripper.max_width
    q = np.random.default_rng(seed).uniform(robot.lower, robot.upper)
    reference = CoalReference(robot, EMPTY, width)
    reference.place(q)
    placed = dict(geometry.finger_placements(width))
    assert len(placed) == len([link for link in geometry.links if "finger" in link or "knuckle" in link])
    pin.forwardKinematics(robot.model, robot.data, q)
    for index, placement in placed.items():
        found = robot.data.oMi[geometry.joints[index]] * placement
        assert found.isApprox(reference.shapes.oMg[index], 1e-9)
    driven = robot.config.gripper.joints[0]
    usual = measured_width(robot.config.gripper, [driven], [robot.config.locked_joints[driven]])
    for index, placement in geometry.finger_placements(usual):
        assert placement.isApprox(geometry.geometry.geometryObjects[index].placement, 1e-4)


@pytest.mark.parametrize("robot", [ROBOT, UR5], ids=["panda", "ur5"])
def test_home_is_free_at_any_gripper_width(robot):
    obstacles = ObstacleCache(HULLS[robot.config.name])
    for width in np.linspace(0, robot.config.gripper.max_width, 5):
        world = CollisionWorld(robot, only(), start=robot.named("home"), cache=obstacles, width=float(width))
        assert not world.collides(robot.named("home")), width


def test_points_on_the_fingers_at_their_width_belong_to_the_robot():
    known, reference = KnownShapeFilter(HULLS["ur5"]), CoalReference(UR5, GAP, UR5.config.gripper.max_width)
    home = UR5.named("home")
    reference.place(home)
    tips = np.array([
        T.translation for T, link in zip(reference.shapes.oMg, reference.links, strict=True) if "finger" in link])
    margins = {"margin": 0.005, "object_margin": 0.0}
    assert known.mask(only(), home, tips, width=0.085, **margins).all()
    assert not known.mask(only(), home, tips, **margins).any(), "the robot file locks it closed"
    assert not len(known.obstacle(CameraView("camera", tips, home, 0.085), only(), **margins).spheres)


def test_width_is_read_from_joint_states_and_their_history():
    gripper = ROBOT.config.gripper
    names = [*ROBOT.joint_names, *gripper.joints]
    assert measured_width(gripper, names, [*HOME, 0.031, 0.031]) == pytest.approx(0.062)
    assert measured_width(gripper, ROBOT.joint_names, HOME) is None and measured_width(None, names, [0] * 9) is None
    assert measured_width(gripper, names, [*HOME, -1e-4, 0]) == 0.0
    history, gripper = JointHistory(UR5), UR5.config.gripper
    names = [*UR5.joint_names, *gripper.joints]
    for stamp, width in ((10**9, 0.0), (2 * 10**9, 0.085), (2 * 10**9 + 10**7, 0.04)):
        position = [*UR5.named("home"), *finger_positions(gripper, width)]
        history.add(JointState(header=Header(stamp=stamp), name=names, position=position))
    assert history.width(10**9) == pytest.approx(0.0, abs=1e-9) and history.width(3 * 10**9) is None
    assert history.width(2 * 10**9 + 5 * 10**6) == pytest.approx(0.085)
