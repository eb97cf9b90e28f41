"""Rendered images of red objects for tests of detection, seen from above or from the side."""

import math

import numpy as np

from common.config import CameraConfig, Surroundings, load_cell
from common.messages import Color, Vector3, WorldObject
from common.perception.pinhole import Pinhole
from common.robot.transforms import matrix_to_pose, rpy_to_matrix, transform
from common.sim.ray_caster import View
from common.sim.rendering import Renderer

CELL = load_cell("panda")
AROUND = CELL.section(Surroundings)
CAMERA = Pinhole.from_config(AROUND.camera)
SIDE = AROUND.model_copy(update={"camera": CameraConfig(position=(1.15, 0.0, 0.85), rpy=(-2.4, 0.0, math.pi / 2))})
R = AROUND.ball_radius


def camera_of(around: Surroundings) -> Pinhole:
    return Pinhole.from_config(around.camera)


def red(shape: str, at: tuple[float, float, float], size: tuple[float, float, float], yaw: float = 0.4,
        roll: float = 0.0) -> WorldObject:
    return WorldObject(id=f"{shape} {at}", shape=shape, color=Color(r=1.0, g=0.15, b=0.1),
                       pose=matrix_to_pose(transform(rpy_to_matrix(roll, 0, yaw), at)),
                       size=Vector3(x=size[0], y=size[1], z=size[2]))


def ball(x: float, y: float, z: float = R) -> WorldObject:
    return red("sphere", (x, y, z), (2 * R, 2 * R, 2 * R))


def rendered(things: list[WorldObject], around: Surroundings = AROUND) -> View:
    return Renderer(around, camera=camera_of(around)).render(things)


def picture(things: list[WorldObject], around: Surroundings = AROUND) -> np.ndarray:
    return rendered(things, around).colour


def in_light(image: np.ndarray, light: np.ndarray | float) -> np.ndarray:
    """The image [bgr8] under another light (a factor for each value)."""
    return np.clip(np.rint(image * light), 0, 255).astype(np.uint8)
