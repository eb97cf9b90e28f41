"""Balls are found in any light: bright and dim, warm and cold, with one side in shadow, in noise."""

import math

import cv2
import numpy as np
import pytest

from applications.pick_place.detector import Detector
from common.config import Light, Scenery
from common.messages import Header, JointState, WorldObjects
from common.perception.pinhole import silhouettes
from common.robot.model import RobotModel
from common.sim.camera import CameraParameters, SimulatedCamera
from common.sim.rendering import Renderer
from common.sim.sensors import tint
from tests.applications.pick_place.rendered import AROUND, CAMERA, CELL, SIDE, ball, camera_of, in_light, picture

PLACES = [(0.40, -0.30, 0.03), (0.60, -0.10, 0.03), (0.25, 0.20, 0.03), (0.15, -0.15, 0.03), (0.62, 0.02, 0.03)]
BALLS = [ball(*place) for place in PLACES]
BOX = AROUND.container


def assert_found(image, camera=CAMERA):
    found = Detector(AROUND).detect(image, camera)
    assert len(found) == len(PLACES), found
    assert all(min(math.dist(place[:2], one.position[:2]) for one in found) < 0.003 for place in PLACES)


@pytest.fixture(scope="module")
def scene():
    return Renderer(AROUND, RobotModel.load(CELL.robot), camera=CAMERA).render(BALLS).colour


@pytest.fixture(scope="module")
def from_the_side():
    return picture(BALLS, SIDE)


@pytest.mark.parametrize("kelvin", [2700, 4000, 6500, 10_000])
@pytest.mark.parametrize(("bright", "shade"), [(1.0, 0.1), (0.5, 0.3), (0.15, 1.0)])
def test_balls_are_found_within_3_mm_without_false_detections(scene, kelvin, bright, shade):
    rng = np.random.default_rng(1)
    fall = np.linspace(1.0, 0.7, 640)[None, :, None] * np.where(np.arange(480) < 245, 1.0, shade)[:, None, None]
    values = scene * tint(kelvin) * bright * fall  # a shadow across it, and light that fades along it
    assert_found(in_light(values + np.sqrt(0.02 * values + 0.3) * rng.standard_normal(values.shape), 1.0))


@pytest.mark.parametrize("bright", [1.0, 0.5])
@pytest.mark.parametrize("kelvin", [2700, 3000, 3500])
def test_floor_next_to_the_table_does_not_affect_the_light_estimate(from_the_side, kelvin, bright):
    assert_found(in_light(from_the_side, tint(kelvin) * bright), camera_of(SIDE))


@pytest.mark.slow
@pytest.mark.parametrize("number", [0, 3, *(pytest.param(number, marks=pytest.mark.campaign) for number in (1, 2))])
def test_balls_are_found_in_rendered_light_and_shadow(number):
    pytest.importorskip("mujoco")
    rng, robot = np.random.default_rng(number), RobotModel.load(CELL.robot)
    turn, lux = rng.uniform(0, 2 * math.pi), 10 ** rng.uniform(2, 4)
    lamp = Light(position=(0.4 + math.cos(turn), math.sin(turn), 1.2), aim=(0.4, 0.0, 0.0), illuminance=lux,
                 temperature=[2700.0, 4000.0, 6500.0, 10_000.0][number])
    lit = Scenery(simulator="mujoco", lights={"lamp": lamp}, ambient=0.2 * lux)
    q = robot.named("home")
    q[0] += 2.6
    locked = robot.config.locked_joints
    joints = JointState(header=Header(), name=[*robot.joint_names, *locked], position=[*q.tolist(), *locked.values()])
    sensor = CameraParameters(auto_exposure=True, full_well=10_000)
    eye = SimulatedCamera(AROUND, lit, [CELL.robot], sensor, rng, plain=True)
    assert_found(eye.capture(WorldObjects(objects=BALLS), [joints], 0).colour)


@pytest.mark.parametrize(("color", "count"), [
    ((0, 85, 255), 0), ((14, 85, 255), 1), ((0, 40, 170), 1),  # the floor's; a ball's as bright; one in the shadow
])
def test_overexposed_orange_container_floor_is_no_ball(color, count):
    image = np.full((CAMERA.height, CAMERA.width, 3), 128, np.uint8)
    for place in ((BOX.x, BOX.y, 0.035), PLACES[0]):
        outline = silhouettes(CAMERA, np.array([place]), AROUND.ball_radius, 32)[0]
        cv2.fillConvexPoly(image, np.rint(outline).astype(np.int32), color)
    found = Detector(AROUND).detect(image, CAMERA)
    inside = [one for one in found if math.dist(one.position[:2], (BOX.x, BOX.y)) < BOX.half_side]
    assert len(inside) == count and len(found) == count + 1, "outside of the container each is a ball"


@pytest.mark.parametrize(("color", "light"), [
    ((1.0, 0.6, 0.0), 1700), ((1.0, 0.6, 0.0), 2000), ((1.0, 0.6, 0.0), 2700),
    ((0.0, 0.0, 0.0), 2000), ((0.0, 0.8, 0.0), 2000), ((1.0, 0.9, 0.0), 2000), ((0.0, 0.0, 0.0), 2700)])
def test_balls_in_a_container_are_found_however_warm_and_bright_the_light_is(color, light):
    box = BOX.model_copy(update={"color": color})
    around = AROUND.model_copy(update={"container": box, "containers": {"box": box}})
    inside = [ball(box.x - 0.04, box.y - 0.04, 0.035), ball(box.x + 0.04, box.y + 0.04, 0.035)]
    assert len(Detector(around).detect(in_light(picture(inside, around), tint(light) * 3.0), CAMERA)) == 2


@pytest.mark.parametrize("color", [(1.0, 0.0, 0.1), (1.0, 0.01, 0.1), (0.8, 0.0, 0.2), (1.0, 0.15, 0.1)])
def test_ball_in_the_container_is_found_for_any_configured_color(color):
    bright = in_light(picture([ball(BOX.x, BOX.y, 0.035)]), 2.0)
    assert len(Detector(AROUND.model_copy(update={"ball_color": color})).detect(bright, CAMERA)) == 1
