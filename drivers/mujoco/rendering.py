"""Render the physics world with light, shadow and the arm: by OpenGL, or by ray casting without it.

Pixel values are proportional to light and use their full range: `level` is the light of the value 255, and a sensor
(`common/sim/photometry.py`) applies the exposure.
"""

from __future__ import annotations

import ctypes
import logging
import math
from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from common.config import Scenery, Surroundings
from common.messages import JointState, WorldObject
from common.perception.pinhole import Pinhole
from common.robot.model import RobotModel
from common.sim.objects import appearance_of
from common.sim.photometry import CUTOFF, ambient, lamps, tint, white_level
from common.sim.ray_caster import View
from common.sim.rendering import STILL, STILL_POSE, link_poses
from drivers.mujoco.drawn_model import DrawnModel
from drivers.mujoco.gl import FAR, Canvas, SingleThread

Array = NDArray[np.float64]

log = logging.getLogger(__name__)
logging.getLogger("OpenGL.acceleratesupport").setLevel(logging.WARNING)  # irrelevant here, but logged every time


class PhysicsRenderer:
    """Renders one camera: see `common.sim.interface.Renderer`."""

    needs_arm = True

    def __init__(
        self, around: Surroundings, scenery: Scenery, robot: RobotModel, camera: Pinhole, *, depth: bool,
        gl: str,
    ) -> None:
        """Prepare; nothing is rendered yet.

        Args:
            around: fixtures and containers.
            scenery: the light.
            robot: its visual meshes are shown.
            camera: intrinsics and pose.
            depth: compute depth; otherwise it is inf.
            gl: `egl`, `osmesa`, or empty for ray casting: see `gl.select_gl`.

        Raises:
            ConfigError: a mesh of the robot is missing.
        """
        self.camera = camera
        self._around, self._robot, self._depth = around, robot, depth
        self._gl = gl
        self._thread = SingleThread("renderer")
        self._canvas: Canvas | None = None
        self._drawn: DrawnModel | None = None
        self._view: View | None = None
        self._objects: list[WorldObject] = []
        self._joints: Array | None = None
        self.set_light(scenery)

    def set_light(self, scenery: Scenery) -> None:
        """Take the light of the scenery."""
        self._scenery = scenery.model_copy()
        self.level = np.maximum(white_level(scenery), 1e-3)
        self._view = None

    def move_camera(self, camera: Pinhole) -> None:
        """Move the camera; its intrinsics stay."""
        if not np.allclose(camera.T_world_optical, self.camera.T_world_optical, rtol=0, atol=STILL_POSE):
            self.camera, self._view = camera, None

    def takes_long(self, objects: Sequence[WorldObject]) -> bool:
        """Always True: rendering may take long."""
        return True

    def render(self, objects: Sequence[WorldObject], joints: JointState | None = None) -> View:
        """Return the view of the objects and of the arm in that state; objects in state "elsewhere" are not shown."""
        visible = [obj for obj in objects if obj.state != "elsewhere"]
        positions = None if joints is None else np.array(joints.position)
        if self._view is not None and visible == self._objects and _same(positions, self._joints):
            return self._view
        self._objects, self._joints = visible, positions
        self._view = self._thread(self._draw, visible, joints)
        return self._view

    def _draw(self, objects: list[WorldObject], joints: JointState | None) -> View:
        appearances = tuple(appearance_of(obj) for obj in objects)
        if self._drawn is None or self._drawn.appearances != appearances:
            self._drawn = DrawnModel(self._around, self._robot, objects, self.camera)
            if self._canvas is not None:
                self._canvas.close()
            self._canvas = self._new_canvas(self._drawn.model)
        self._drawn.put(objects, None if joints is None else link_poses(self._robot, joints))
        if self._canvas is None:
            return ray_view(self._drawn.model, self._drawn.data, self.camera, self._scenery, self.level, FAR)
        return self._canvas.draw(self._drawn.data, self.camera, self._scenery, self.level, depth=self._depth)

    def _new_canvas(self, model: mujoco.MjModel) -> Canvas | None:
        if not self._gl:
            return None
        try:
            return Canvas(model, self.camera, self._gl)
        except (ImportError, RuntimeError, AttributeError, ctypes.ArgumentError) as error:  # all by PyOpenGL
            log.warning("images are ray-cast, without shadows: OpenGL (%s) fails: %s", self._gl, error)
            self._gl = ""
            return None


def ray_view(
    model: mujoco.MjModel, data: mujoco.MjData, camera: Pinhole, scenery: Scenery, level: Array, far: float
) -> View:
    """Ray-cast view of a model with diffuse lighting and no shadows.

    Args:
        model: the model.
        data: its state, with kinematics computed.
        camera: intrinsics and pose.
        scenery: the light.
        level: (3,) [lx] of blue, green and red light for the value 255.
        far: length of rays [m].
    """
    v, u = np.mgrid[0:camera.height, 0:camera.width]
    rays = camera.directions(np.column_stack([u.ravel(), v.ravel()]))
    count = len(rays)
    geoms, distances, found = np.full(count, -1, np.int32), np.full(count, -1.0), np.zeros(3 * count)
    all_groups, eye = np.ones(mujoco.mjNGROUP, np.uint8), camera.position
    mujoco.mj_multiRay(model, data, eye, rays.ravel(), all_groups, True, -1, geoms, distances, found, count, far)
    hit, normals = geoms >= 0, found.reshape(-1, 3)
    normals *= np.where(np.sum(normals * rays, axis=1) > 0, -1.0, 1.0)[:, None]  # facing the camera
    points = camera.position + distances[:, None] * rays
    light = np.broadcast_to(ambient(scenery), (count, 3)).copy()
    for lamp in lamps(scenery):
        direction = np.subtract(lamp.aim, lamp.position)
        length = float(np.linalg.norm(direction)) or 1.0
        if lamp.parallel:
            towards, strength = np.broadcast_to(-direction / length, points.shape), np.ones(count)
        else:
            towards = np.asarray(lamp.position) - points
            distance = np.maximum(np.linalg.norm(towards, axis=1), 1e-6)
            towards = towards / distance[:, None]
            inside = -(towards @ direction) / length >= math.cos(math.radians(CUTOFF))
            strength = inside * (length / distance) ** 2
        facing = np.maximum(np.sum(normals * towards, axis=1), 0.0) * strength
        light += facing[:, None] * (lamp.illuminance * tint(lamp.temperature))
    colours = np.zeros((count, 3))
    colours[hit] = np.asarray(model.geom_rgba)[geoms[hit], 2::-1]
    colour = np.where(hit[:, None], np.clip(255 * colours * light / level, 0, 255), 0)
    along = np.asarray(rays @ camera.T_world_optical[:3, 2])
    depth = np.where(hit, distances * along, np.inf)
    shape = (camera.height, camera.width)
    return View(np.rint(colour).astype(np.uint8).reshape(*shape, 3), depth.astype(np.float32).reshape(shape))


def _same(a: Array | None, b: Array | None) -> bool:
    if a is None or b is None:
        return a is b
    return a.shape == b.shape and bool(np.all(np.abs(a - b) < STILL))
