"""Cameras that sit on the robot: where they are follows from its joints. They look from home."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

import numpy as np
import numpy.typing as npt

from common.config.world import TCP, CameraConfig, Surroundings
from common.errors import ConfigError
from common.perception.pinhole import Pinhole
from common.robot.transforms import matrix_to_rpy, rpy_to_matrix, transform

if TYPE_CHECKING:  # a fixed camera needs none
    from common.robot.model import RobotModel

Array = npt.NDArray[np.float64]
S = TypeVar("S", bound=Surroundings)


def in_mount(camera: CameraConfig) -> Array:
    """(4, 4) pose of the optical frame in the link that it sits on, or in world where it has no mount."""
    return transform(rpy_to_matrix(*camera.rpy), camera.position)


def mount_link(camera: CameraConfig, robot: RobotModel, field: str = "world.camera") -> str:
    """The link that a camera, which stands in a field of the cell, sits on.

    Raises:
        ConfigError: the robot has no such link; with the choices.
    """
    link = robot.config.tcp_link if camera.mount == TCP else camera.mount
    if link not in robot.link_names:
        raise ConfigError(f"{field}.mount", camera.mount, f"is no link of {robot.config.name}; choices: "
                                                          f"{', '.join([TCP, *robot.link_names])}")
    return link


def mount_links(around: Surroundings, robot: RobotModel) -> dict[str, str]:
    """By name of the camera, the link that it sits on; only those that do.

    Raises:
        ConfigError: the robot has no such link; with the choices.
    """
    single = len(around.cameras) == 1
    return {name: mount_link(camera, robot, "world.camera" if single else f"world.cameras.{name}")
            for name, camera in around.cameras.items() if camera.mount}


class Mounted:
    """One camera, fixed in world or on the robot."""

    def __init__(self, camera: CameraConfig, robot: RobotModel | None = None) -> None:
        """Take the camera, and the robot where it has a mount.

        Raises:
            ConfigError: the robot has no such link.
        """
        self.moves = bool(camera.mount)
        self._camera, self._robot = camera, robot
        self._link = mount_link(camera, robot) if self.moves and robot is not None else ""

    def at(self, q: npt.ArrayLike | None = None) -> Pinhole:
        """The camera at joint positions (dof,) [rad]; without them where the robot is at home.

        Raises:
            CameraError: it has a mount, and no robot was given.
        """
        c = self._camera
        if self._robot is None or not self._link:
            return Pinhole.from_config(c)
        T = self._robot.link_poses(self._robot.named("home") if q is None else q)[self._link] @ in_mount(c)
        return Pinhole(c.fx, c.fy, c.cx, c.cy, c.width, c.height, T)


def from_home(world: S, robot: RobotModel) -> S:
    """The world with cameras on the robot fixed where they are while it is at home.

    Raises:
        ConfigError: the robot has no link of that name.
    """
    mount_links(world, robot)

    def fixed(camera: CameraConfig) -> CameraConfig:
        if not camera.mount:
            return camera
        T = Mounted(camera, robot).at().T_world_optical
        x, y, z = T[:3, 3].tolist()
        return camera.model_copy(update={"mount": "", "position": (x, y, z), "rpy": matrix_to_rpy(T[:3, :3])})

    cameras = {name: fixed(camera) for name, camera in world.cameras.items()}
    return world.model_copy(update={"cameras": cameras, "camera": fixed(world.camera)})
