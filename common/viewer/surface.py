"""How the scene looks before any message: light, where one looks from, no axes in the middle."""

from __future__ import annotations

import numpy as np
import viser

from common.config import Surroundings
from common.robot.model import RobotModel

_EYE = np.array([1.05, -1.25, 0.75])  # from what is looked at [m]: in front of the robot, to its right, from above


def furnish(server: viser.ViserServer, around: Surroundings, robot: RobotModel) -> None:
    """Set light and view; a browser that comes later begins with them, and goes back to them with `Reset view`."""
    scene, view = server.scene, server.initial_camera
    scene.set_up_direction("+z")
    scene.configure_default_lights(cast_shadow=False)
    scene.configure_environment_map(hdri=None)  # a browser without a graphics card needs seconds to prepare one
    scene.add_light_hemisphere("/sky", sky_color=(255, 255, 255), ground_color=(120, 115, 110), intensity=2.0)
    scene.world_axes.visible = False
    base = robot.config.base_position
    at = np.array([(base[0] + around.camera.position[0]) / 2, base[1], base[2] + 0.25])
    view.up = (0.0, 0.0, 1.0)
    view.look_at = (float(at[0]), float(at[1]), float(at[2]))
    eye = at + _EYE
    view.position = (float(eye[0]), float(eye[1]), float(eye[2]))
    view.fov = 0.9
