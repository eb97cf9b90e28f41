"""Motions are planned for the gripper's width: closed fingers fit into a gap, open ones around a wall."""

from __future__ import annotations

import coal
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.config import load_cell
from common.messages import Header, JointState, PlanRequest
from common.planning.camera_obstacles import JointHistory
from common.planning.collision import CollisionWorld, interpolate
from common.planning.obstacles import ObstacleCache
from common.planning.pipeline import PlanningPipeline
from common.planning.point_obstacles import CameraView, KnownShapeFilter
from common.planning.robot_geometry import RobotGeometry, convex_hulls
from common.planning.trajectory import timed_path
from common.planning.validation import fine_samples
from common.robot.finger_joints import finger_positions, measured_width
from common.robot.model import RobotModel
from common.robot.transforms import pose_to_matrix
from tests.common.planning.planning_scenes import CELL, HOME, ROBOT, above, scene, solid, to_joints

UR5 = RobotModel.load(load_cell("ur5").robot)
OPEN, CLOSED = 0.08, 0.0
X, LOW = 0.5, 0.02  # target of the tool, and its height there [m]
# Fingers close along y: only closed ones fit between two walls, only open ones around one wall.
GAP = scene(box=False).model_copy(update={"objects": [
    solid("left", "fixture", "box", [0.1, 0.02, 0.04], (X, 0.05, 0.02)),
    solid("right", "fixture", "box", [0.1, 0.02, 0.04], (X, -0.05, 0.02))]})
WALL = scene(box=False).model_copy(update={"objects": [
    solid("wall", "fixture", "box", [0.1, 0.04, 0.04], (X, 0.0, 0.02))]})
START, GOAL = above(X, 0.0, 0.15), above(X, 0.0, LOW)


class CoalReference:
    """Collision checks of a robot at a gripper width by coal and the model of all joints."""

    def __init__(self, robot: RobotModel, scene_, width: float) -> None:
        self.robot, gripper = robot, robot.config.gripper
        self.model = robot.full_model
        self.hulls = convex_hulls(robot.full_geometry(pin.GeometryType.COLLISION))
        self.shapes = pin.GeometryData(self.hulls)
        self.q, self.data = robot.full_reference.copy(), self.model.createData()
        for name, position in zip(gripper.joints, finger_positions(gripper, width), strict=True):
            self.q[self.model.joints[self.model.getJointId(name)].idx_q] = position
        self.index = [self.model.joints[self.model.getJointId(name)].idx_q for name in robot.joint_names]
        self.solids = [(coal.Box(*o.dimensions), pose_to_matrix(o.pose)) for o in scene_.objects]

    def place(self, q) -> None:
        self.q[self.index] = q
        pin.updateGeometryPlacements(self.model, self.data, self.hulls, self.shapes, self.q)

    def touches(self, q) -> bool:
        self.place(q)
        for item, T in zip(self.hulls.geometryObjects, self.shapes.oMg, strict=True):
            if self.model.frames[item.parentFrame].name == "panda_link0":
                continue
            at = coal.Transform3s(T.rotation, T.translation)
            for box, pose in self.solids:
                where = coal.Transform3s(pose[:3, :3], pose[:3, 3])
                if coal.collide(item.geometry, at, box, where, coal.CollisionRequest(), coal.CollisionResult()):
                    return True
        return False


@pytest.fixture
def pipeline(backend):
    return PlanningPipeline(ROBOT, CELL.motion, CELL.pipeline)


def down(**more) -> PlanRequest:
    return to_joints(GOAL, START, **more)


CASES = [(GAP, CLOSED, True), (GAP, OPEN, False), (WALL, OPEN, True), (WALL, CLOSED, False)]


def test_gap_and_wall_fit_as_intended_according_to_coal():
    for scene_, width, free in CASES:
        assert CoalReference(ROBOT, scene_, width).touches(GOAL) is not free
        assert not CoalReference(ROBOT, scene_, width).touches(START)


def test_motion_is_planned_for_the_current_gripper_width(pipeline):
    for scene_, width, free in CASES * 2:  # in turn: each plan uses its own width
        response = pipeline.plan(down(), scene_, width=width)
        assert response.ok is free, response.message
        if not free:
            assert response.error == "goal_in_collision" and "finger" in response.message
            continue
        reference = CoalReference(ROBOT, scene_, width)
        path, _ = fine_samples(timed_path(response.trajectory), 0.005)
        assert len(path) > 50 and not any(reference.touches(q) for q in path)


def test_gripper_width_of_the_request_overrides_the_current_one(pipeline):
    assert pipeline.plan(down(gripper_width=CLOSED), GAP, width=OPEN).ok
    assert not pipeline.plan(down(gripper_width=OPEN), GAP, width=CLOSED).ok
    assert not pipeline.plan(down(), GAP).ok, "the robot file locks it open"
    refused = pipeline.plan(down(gripper_width=0.1), GAP)
    assert (refused.error, refused.message) == (
        "bad_request", "request_checks: gripper_width 0.1 m is more than the fingers open (0.08 m)")


@pytest.mark.parametrize("robot", [ROBOT, UR5], ids=["panda", "ur5"])
@settings(max_examples=25, deadline=None)
@given(share=st.floats(0, 1), seed=st.integers(0, 1000))
def test_hulls_of_the_fingers_follow_all_joints(robot, share, seed):
    geometry = HULLS[robot.config.name]
    width = share * robot.config.gripper.max_width
    q = np.random.default_rng(seed).uniform(robot.lower, robot.upper)
    reference = CoalReference(robot, scene(box=False), width)
    reference.place(q)
    placed = dict(geometry.finger_placements(width))
    assert len(placed) == len([link for link in geometry.links if "finger" in link or "knuckle" in link])
    pin.forwardKinematics(robot.model, robot.data, q)
    for index, placement in placed.items():
        found = robot.data.oMi[geometry.joints[index]] * placement
        assert found.isApprox(reference.shapes.oMg[index], 1e-9)
    held = {name: value for name, value in robot.config.locked_joints.items() if name == robot.config.gripper.joints[0]}
    usual = measured_width(robot.config.gripper, list(held), list(held.values()))
    for index, placement in geometry.finger_placements(usual):
        assert placement.isApprox(geometry.geometry.geometryObjects[index].placement, 1e-4)


HULLS = {robot.config.name: RobotGeometry(robot) for robot in (ROBOT, UR5)}


def test_states_and_edges_agree_with_coal_at_any_width():
    cache, rng = ObstacleCache(HULLS["panda"]), np.random.default_rng(4)
    disagree = checked = 0
    for _ in range(12):
        width = rng.uniform(0, OPEN)
        for scene_ in (GAP, WALL):
            world, reference = CollisionWorld(ROBOT, scene_, start=START, cache=cache, width=width), CoalReference(
                ROBOT, scene_, width)
            q = GOAL + rng.uniform(-0.05, 0.05, 7)
            hits = [reference.touches(at) for at in interpolate([START, q], 0.01)]
            checked += 1
            if world.edge_free(START, q):
                assert not any(hits)
            elif not any(hits):
                disagree += 1
            assert world.collides(q) or not reference.touches(q)
    assert checked == 24 and disagree <= 3  # a grazing edge may not be proved


def test_home_is_free_at_any_gripper_width():
    for robot in (ROBOT, UR5):
        cache = ObstacleCache(HULLS[robot.config.name])
        for width in np.linspace(0, robot.config.gripper.max_width, 5):
            world = CollisionWorld(robot, scene(box=False).model_copy(update={"objects": []}),
                                   start=robot.named("home"), cache=cache, width=float(width))
            assert not world.collides(robot.named("home")), width


def test_points_on_the_fingers_at_their_width_belong_to_the_robot():
    known, reference = KnownShapeFilter(HULLS["ur5"]), CoalReference(UR5, GAP, UR5.config.gripper.max_width)
    home = UR5.named("home")
    reference.place(home)
    links = [reference.model.frames[item.parentFrame].name for item in reference.hulls.geometryObjects]
    tips = np.array([
        np.array(T.translation) for T, link in zip(reference.shapes.oMg, links, strict=True) if "finger" in link])
    nothing = scene(box=False).model_copy(update={"objects": []})
    given = {"margin": 0.005, "object_margin": 0.0}
    assert known.mask(nothing, home, tips, width=0.085, **given).all()
    assert not known.mask(nothing, home, tips, **given).any(), "the robot file locks it closed"
    view = CameraView("camera", tips, home, 0.085)
    assert not len(known.obstacle(view, nothing, margin=0.005, object_margin=0.0).spheres)
    history = JointHistory(UR5)
    names, gripper = [*UR5.joint_names, *UR5.config.gripper.joints], UR5.config.gripper
    for stamp, width in ((10**9, 0.0), (2 * 10**9, 0.085), (2 * 10**9 + 10**7, 0.04)):
        history.add(JointState(header=Header(stamp=stamp), name=names,
                                position=[*home, *finger_positions(gripper, width)]))
    assert history.width(10**9) == pytest.approx(0.0, abs=1e-9) and history.width(3 * 10**9) is None
    assert history.width(2 * 10**9 + 5 * 10**6) == pytest.approx(0.085)


def test_width_is_read_from_joint_states():
    gripper = ROBOT.config.gripper
    names = [*ROBOT.joint_names, *gripper.joints]
    assert measured_width(gripper, names, [*HOME, 0.031, 0.031]) == pytest.approx(0.062)
    assert measured_width(gripper, ROBOT.joint_names, HOME) is None and measured_width(None, names, [0] * 9) is None
    assert measured_width(gripper, names, [*HOME, -1e-4, 0]) == 0.0
