"""Balls are found in any light: bright and dim, warm and cold, with one side in shadow, in noise."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
import pytest

from applications.pick_place.detector import Detector
from common.config import CameraConfig, Light, Scenery, Surroundings, load_cell
from common.messages import Color, Header, JointState, Pose, Vector3, WorldObject, WorldObjects
from common.perception.pinhole import Pinhole
from common.perception.sphere import silhouettes
from common.robot.model import RobotModel
from common.sim.camera import CameraParameters, SimulatedCamera
from common.sim.photometry import tint
from common.sim.rendering import Renderer

CELL = load_cell("panda")
AROUND = CELL.section(Surroundings)
assert isinstance(AROUND, Surroundings)
CAMERA = Pinhole.from_config(AROUND.camera)
SIDE = CameraConfig(position=(1.15, 0.0, 0.85), rpy=(-2.4, 0.0, math.pi / 2))
PLACES = [(0.40, -0.30, 0.03), (0.60, -0.10, 0.03), (0.25, 0.20, 0.03), (0.15, -0.15, 0.03), (0.62, 0.02, 0.03)]


def balls(places: Sequence[tuple[float, float, float]] = PLACES) -> list[WorldObject]:
    return [WorldObject(id=f"ball_{k}", shape="sphere", pose=Pose(position=Vector3(x=x, y=y, z=z)),
                        size=Vector3(x=0.06, y=0.06, z=0.06), color=Color(r=1.0, g=0.15, b=0.1))
            for k, (x, y, z) in enumerate(places)]


def errors(picture: np.ndarray, camera: Pinhole = CAMERA) -> list[float]:
    found = Detector(AROUND).detect(picture, camera)
    assert len(found) == len(PLACES), found
    return [min(math.dist(place[:2], one.position[:2]) for one in found) for place in PLACES]


@pytest.fixture(scope="module")
def scene() -> np.ndarray:
    return Renderer(AROUND, RobotModel.load(CELL.robot), camera=CAMERA).render(balls()).colour


@pytest.mark.parametrize("kelvin", [2700, 4000, 6500, 10_000])
@pytest.mark.parametrize(("bright", "shade"), [(1.0, 0.1), (0.5, 0.3), (0.15, 1.0)])
def test_balls_are_found_within_3_mm_without_false_detections(
    scene: np.ndarray, kelvin: float, bright: float, shade: float
) -> None:
    rng = np.random.default_rng(1)
    fall = np.linspace(1.0, 0.7, 640)[None, :, None] * np.where(np.arange(480) < 245, 1.0, shade)[:, None, None]
    values = scene * tint(kelvin) * bright * fall  # a shadow across it, and light that fades along it
    noisy = values + np.sqrt(0.02 * values + 0.3) * rng.standard_normal(values.shape)
    assert max(errors(np.clip(np.rint(noisy), 0, 255).astype(np.uint8))) < 0.003


@pytest.mark.parametrize("bright", [1.0, 0.5])
@pytest.mark.parametrize("kelvin", [2700, 3000, 3500])
def test_floor_next_to_the_table_does_not_affect_the_light_estimate(kelvin: float, bright: float) -> None:
    camera = Pinhole.from_config(SIDE)
    picture = Renderer(AROUND, camera=camera).render(balls()).colour
    warm = np.clip(np.rint(picture * tint(kelvin) * bright), 0, 255).astype(np.uint8)
    assert max(errors(warm, camera)) < 0.003


@pytest.mark.slow
@pytest.mark.parametrize("number", range(4))
def test_balls_are_found_in_rendered_light_and_shadow(number: int) -> None:
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
    eye = SimulatedCamera(AROUND, lit, CELL.robot, sensor, rng, plain=True)
    assert max(errors(eye.capture(WorldObjects(objects=balls()), joints, 0).colour)) < 0.003


@pytest.mark.parametrize(("color", "count"), [
    ((0, 85, 255), 0), ((14, 85, 255), 1), ((0, 40, 170), 1),  # the floor's; a ball's as bright; one in the shadow
])
def test_overexposed_orange_container_floor_is_no_ball(color: tuple[int, int, int], count: int) -> None:
    box = AROUND.container
    picture = np.full((CAMERA.height, CAMERA.width, 3), 128, np.uint8)
    for place in ((box.x, box.y, 0.035), PLACES[0]):
        outline = silhouettes(CAMERA, np.array([place]), AROUND.ball_radius, 32)[0]
        cv2.fillConvexPoly(picture, np.rint(outline).astype(np.int32), color)
    found = Detector(AROUND).detect(picture, CAMERA)
    inside = [one for one in found if math.dist(one.position[:2], (box.x, box.y)) < box.half_side]
    assert len(inside) == count and len(found) == count + 1, "elsewhere it is what it looks like"


@pytest.mark.parametrize(("color", "light"), [
    ((1.0, 0.6, 0.0), 1700), ((1.0, 0.6, 0.0), 2000), ((1.0, 0.6, 0.0), 2200), ((1.0, 0.6, 0.0), 2700),
    ((0.0, 0.0, 0.0), 2000), ((0.0, 0.8, 0.0), 2000), ((1.0, 0.9, 0.0), 2000), ((0.0, 0.0, 0.0), 2700),
])
def test_balls_in_a_container_are_found_however_warm_and_bright_the_light_is(
    color: tuple[float, float, float], light: int,
) -> None:
    box = AROUND.container.model_copy(update={"color": color})
    around = AROUND.model_copy(update={"container": box, "containers": {"box": box}})
    inside = balls([(box.x - 0.04, box.y - 0.04, 0.035), (box.x + 0.04, box.y + 0.04, 0.035)])
    picture = Renderer(around, camera=CAMERA).render(inside).colour
    warm = np.clip(np.rint(picture * tint(light) * 3.0), 0, 255).astype(np.uint8)
    assert len(Detector(around).detect(warm, CAMERA)) == 2


@pytest.mark.parametrize("color", [(1.0, 0.0, 0.1), (1.0, 0.01, 0.1), (0.8, 0.0, 0.2), (1.0, 0.15, 0.1)])
def test_balls_in_the_container_are_found_for_any_configured_color(color: tuple[float, float, float]) -> None:
    around, box = AROUND.model_copy(update={"ball_color": color}), AROUND.container
    picture = Renderer(AROUND, camera=CAMERA).render(balls([(box.x, box.y, 0.035)])).colour
    bright = np.clip(np.rint(picture * 2.0), 0, 255).astype(np.uint8)
    assert len(Detector(around).detect(bright, CAMERA)) == 1
