"""The part of a picture that the robot occludes: all rendered pixels of it, and few more."""

import cv2
import numpy as np
import pytest

from common.config import Surroundings, load_cell
from common.messages import Header, JointState
from common.perception.occlusion import BY_ROBOT, MARGIN, Occlusion, RobotOcclusion, RobotSilhouettes
from common.perception.pinhole import Pinhole
from common.robot.model import RobotModel
from common.sim.rendering import Renderer

CELL = load_cell("panda")
AROUND = CELL.section(Surroundings)
assert isinstance(AROUND, Surroundings)
ABOVE = Pinhole.from_config(AROUND.camera)
SIDE = Pinhole.from_config(AROUND.camera.model_copy(update={"position": (1.15, 0.0, 0.85), "rpy": (-2.4, 0.0, 1.5708)}))


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    return RobotModel.load(CELL.robot)


@pytest.mark.parametrize("camera", [ABOVE, SIDE], ids=["above", "side"])
def test_occlusion_covers_the_rendered_arm_tightly(robot: RobotModel, camera: Pinhole) -> None:
    silhouettes, rng = RobotSilhouettes(robot), np.random.default_rng(1)
    renderer, empty = (Renderer(AROUND, *shown, plain=True, camera=camera) for shown in ([robot], []))
    for _ in range(2):
        q = robot.named("home") + rng.uniform(-0.6, 0.6, 7)
        state = JointState(header=Header(), name=list(robot.joint_names), position=q.tolist(), velocity=[], effort=[])
        arm = (renderer.render([], state).colour != empty.render([]).colour).any(axis=2)
        hidden = silhouettes.occlusion(camera, [q])
        assert hidden.distance is not None
        occluded, size = (hidden.distance <= MARGIN).astype(np.uint8), (camera.width, camera.height)
        mask = cv2.resize(occluded, size, interpolation=0) > 0
        assert not (arm & ~mask).any() and mask.sum() < 2.0 * arm.sum() + 8000


def test_positions_below_the_gripper_or_outside_the_image_are_occluded(robot: RobotModel) -> None:
    hidden = RobotSilhouettes(robot).occlusion(ABOVE, [robot.named("home")])
    below, clear, outside = (0.15, 0.0, 0.03), (0.6, 0.1, 0.03), (0.4, 0.6, 0.03)
    assert hidden.occludes([below, clear, outside], 0.03).tolist() == [True, False, True]
    assert hidden.touches([below, clear, outside], 0.03).tolist() == [True, False, False]


def test_arm_behind_the_camera_occludes_nothing(robot: RobotModel) -> None:
    q = robot.named("home")
    q[0] += 2.0
    away = Pinhole(ABOVE.fx, ABOVE.fy, ABOVE.cx, ABOVE.cy, 640, 480, ABOVE.T_world_optical + np.array(
        [[0, 0, 0, 0.3], [0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]]))
    places = [(0.7, y, 0.03) for y in np.linspace(-0.3, 0.3, 9)]
    assert not RobotSilhouettes(robot).occlusion(away, [q]).occludes(places, 0.03).any()


def test_unusable_image_occludes_everything() -> None:
    unusable = Occlusion(ABOVE, "the lens is covered")
    assert unusable.covers_image
    assert unusable.occludes([(0.4, 0.0, 0.03)])[0] and unusable.touches([(0.4, 0.0, 0.03)])[0]


def test_swept_region_is_occluded_until_an_image_is_taken_at_standstill(robot: RobotModel) -> None:
    before, home = RobotOcclusion(RobotSilhouettes(robot)), robot.named("home")
    turned = home + np.array([1.2, 0, 0, 0, 0, 0, 0])
    below = [(0.15, 0.0, 0.03)]
    first = before.in_image(ABOVE, 100, home, 100)
    moving = before.in_image(ABOVE, 150, turned, 200)
    at_rest = before.in_image(ABOVE, 250, turned, 300)
    assert first is not None and moving is not None and at_rest is not None
    assert [bool(one.occludes(below, 0.03)[0]) for one in (first, moving, at_rest)] == [True, True, False]
    assert before.in_image(ABOVE, 350, turned, 400) is at_rest and at_rest.by == BY_ROBOT


def test_occlusion_is_unknown_without_joint_readings(robot: RobotModel) -> None:
    assert RobotOcclusion(RobotSilhouettes(robot)).in_image(ABOVE, 1, None, 0) is None
