"""What never moves in a model: fixtures, containers, the floor; and the cameras."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from common.config import CameraConfig, Container, Fixture, Surroundings
from common.config.objects import TCP
from common.robot.model import RobotModel
from common.robot.transforms import rpy_to_matrix
from common.sim.resting import FLOOR_BELOW_TABLE
from drivers.mujoco.contact import FIXED, touches
from drivers.mujoco.robot import wxyz

STANDS = 0.3  # [m] a fixture whose bottom is so far below the highest top stands on the floor
FLOOR_COLOR = (0.62, 0.62, 0.60, 1.0)
_OPTICAL_TO_GL = np.diag([1.0, -1.0, -1.0])  # an optical frame looks along z with y down, MuJoCo's along -z with y up


def add_surroundings(spec: mujoco.MjSpec, world: Surroundings) -> None:
    """Put what is fixed into a model: a body `fixture:ID` or `container:ID` for each, and the floor."""
    kinds = {"box": mujoco.mjtGeom.mjGEOM_BOX, "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
             "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER}
    for fixture in world.fixtures:
        body = spec.worldbody.add_body(name=f"fixture:{fixture.id}", pos=fixture.position,
                                       quat=wxyz(rpy_to_matrix(*fixture.rpy)))
        d = fixture.dimensions
        size = {"box": [side / 2 for side in d], "sphere": [d[0], 0.0, 0.0],
                "cylinder": [d[0], d[-1] / 2, 0.0]}[fixture.shape]
        geom = body.add_geom(name=f"fixture:{fixture.id}", type=kinds[fixture.shape], size=size,
                             rgba=[*fixture.color, 1.0])
        touches(geom, FIXED)
    for container in world.containers.values():
        _add_container(spec, container, world.table_height)
    floor = spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[5.0, 5.0, 0.1],
                                    pos=[0.0, 0.0, floor_height(world)], rgba=FLOOR_COLOR)
    touches(floor, FIXED)


def floor_height(world: Surroundings) -> float:
    """z of the floor [m]: where fixtures stand, or below the table."""
    extents = [_extent(fixture) for fixture in world.fixtures]
    top, bottom = max((high for _, high in extents), default=0.0), min((low for low, _ in extents), default=0.0)
    return bottom if top - bottom > STANDS else min(bottom, world.table_height) - FLOOR_BELOW_TABLE


def _extent(fixture: Fixture) -> tuple[float, float]:
    """Heights [m] between which it certainly lies."""
    d, up = fixture.dimensions, np.abs(rpy_to_matrix(*fixture.rpy)[2])
    half = {"box": float(up @ np.resize(d, 3)) / 2, "sphere": d[0],
            "cylinder": float(up[2] * d[-1] / 2 + math.hypot(up[0], up[1]) * d[0])}[fixture.shape]
    return fixture.position[2] - half, fixture.position[2] + half


def _add_container(spec: mujoco.MjSpec, c: Container, table: float) -> None:
    """Five panels: a floor, and walls from the table up."""
    body = spec.worldbody.add_body(name=f"container:{c.id}", pos=[c.x, c.y, table])
    half, thick, middle = c.half_side, c.wall_thickness / 2, c.wall_height / 2
    off = half - thick
    panels = [((0.0, 0.0, c.floor_thickness / 2), (half, half, c.floor_thickness / 2))]
    panels += [((sign * off, 0.0, middle), (thick, half, middle)) for sign in (-1, 1)]
    panels += [((0.0, sign * off, middle), (half - 2 * thick, thick, middle)) for sign in (-1, 1)]
    for number, (at, size) in enumerate(panels):
        geom = body.add_geom(name=f"container:{c.id}.{number}", type=mujoco.mjtGeom.mjGEOM_BOX, pos=at, size=size,
                             rgba=[*c.color, 1.0])
        touches(geom, FIXED)


def add_cameras(spec: mujoco.MjSpec, world: Surroundings, robot: RobotModel | None) -> None:
    """Put the cameras of the world into a model, by their names, on their mounts."""
    for name, camera in world.cameras.items():
        body: Any = spec.worldbody
        if camera.mount and robot is not None:
            body = spec.body(robot.config.tcp_link if camera.mount == TCP else camera.mount)
        body.add_camera(name=name, pos=camera.position, quat=camera_quaternion(rpy_to_matrix(*camera.rpy)),
                        fovy=field_of_view(camera), resolution=[camera.width, camera.height])


def camera_quaternion(rotation: NDArray[np.float64]) -> list[float]:
    """w, x, y, z of a MuJoCo camera whose optical frame has this (3, 3) rotation."""
    return wxyz(rotation @ _OPTICAL_TO_GL)


def field_of_view(camera: CameraConfig) -> float:
    """Vertical [deg]; whose principal point is off the middle, or whose pixels are not square, is not in it."""
    return math.degrees(2 * math.atan(camera.height / (2 * camera.fy)))
