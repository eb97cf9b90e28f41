"""Pictures of the world, with light and shadow, and the arm in them: by OpenGL, or by rays where there is none.

A picture is drawn as if the light were as bright as fits into its values; how bright it is, `level` says, and a
sensor (`common/sim/sensor.py`) exposes it. Values are proportional to light.
"""

from __future__ import annotations

import atexit
import ctypes
import logging
import math
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from common.config import Scenery, Surroundings
from common.messages import JointState, WorldObject
from common.perception.pinhole import Pinhole
from common.robot.model import RobotModel
from common.sim.lighting import CUTOFF, ambient, lamps, tint, white_level
from common.sim.objects import appearance_of
from common.sim.ray_caster import View
from common.sim.rendering import STILL, STILL_POSE, link_poses
from drivers.mujoco.drawn_model import DrawnModel
from drivers.mujoco.gl import SingleThread, gl_context

Array = NDArray[np.float64]

log = logging.getLogger(__name__)
logging.getLogger("OpenGL.acceleratesupport").setLevel(logging.WARNING)  # of no use here, which it tells each time

NEAR, FAR = 0.02, 12.0  # [m] between which there is something to see
FAR_OFF = 3.0  # [m] from its aim at which parallel light begins
SHINE = 0.1  # share of the light that what is smooth reflects as a mirror does
MOST_GEOMS = 4000


class PhysicsRenderer:
    """Draws what one camera sees: see `common.sim.interface.Renderer`."""

    needs_arm = True

    def __init__(
        self, around: Surroundings, scenery: Scenery, robot: RobotModel, camera: Pinhole, *, depth: bool,
        gl: str,
    ) -> None:
        """Draw nothing yet.

        Args:
            around: fixtures and containers.
            scenery: the light.
            robot: whose visual meshes are seen.
            camera: intrinsics and pose.
            depth: whether depth is asked for: else it is inf.
            gl: `egl`, `osmesa`, or empty for rays: see `gl.select_gl`.

        Raises:
            ConfigError: a mesh of the robot is not there.
        """
        self.camera = camera
        self._around, self._robot, self._depth = around, robot, depth
        self._gl = gl
        self._thread = SingleThread("pictures")
        self._canvas: Canvas | None = None
        self._drawn: DrawnModel | None = None
        self._seen: View | None = None
        self._objects: list[WorldObject] = []
        self._joints: Array | None = None
        self.set_light(scenery)

    def set_light(self, scenery: Scenery) -> None:
        """Take the light of the scenery."""
        self._scenery = scenery.model_copy()
        self.level = np.maximum(white_level(scenery), 1e-3)
        self._seen = None

    def move_camera(self, camera: Pinhole) -> None:
        """Take the camera elsewhere; its intrinsics stay."""
        if not np.allclose(camera.T_world_optical, self.camera.T_world_optical, rtol=0, atol=STILL_POSE):
            self.camera, self._seen = camera, None

    def takes_long(self, objects: Sequence[WorldObject]) -> bool:
        """Whether to `render` the objects may take longer than a moment: it always may."""
        return True

    def render(self, objects: Sequence[WorldObject], joints: JointState | None = None) -> View:
        """The view of the objects and of the arm in that state; what is "elsewhere" is not seen."""
        shown = [thing for thing in objects if thing.state != "elsewhere"]
        positions = None if joints is None else np.array(joints.position)
        if self._seen is not None and shown == self._objects and _same(positions, self._joints):
            return self._seen
        self._objects, self._joints = shown, positions
        self._seen = self._thread(self._draw, shown, joints)
        return self._seen

    def _draw(self, objects: list[WorldObject], joints: JointState | None) -> View:
        looks = tuple(appearance_of(thing) for thing in objects)
        if self._drawn is None or self._drawn.looks != looks:
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
        except (ImportError, RuntimeError, AttributeError, ctypes.ArgumentError) as error:  # PyOpenGL has all of them
            log.warning("pictures are drawn by rays, without shadows: OpenGL (%s) does not work: %s", self._gl, error)
            self._gl = ""
            return None


class Canvas:
    """A model in the memory of OpenGL. It belongs to the thread that makes it."""

    def __init__(self, model: mujoco.MjModel, camera: Pinhole, gl: str) -> None:
        """Make a context for pictures of the camera's size.

        Raises:
            ImportError, RuntimeError: OpenGL does not work.
        """
        self._model = model
        self._context = gl_context(gl, camera.width, camera.height)
        atexit.register(self._context.free)  # what is left to the end of the interpreter finds OpenGL gone
        self._context.make_current()
        self._made = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_50.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._made)
        self._made.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        self._scene = mujoco.MjvScene(model, maxgeom=MOST_GEOMS)
        flags, render = self._scene.flags, mujoco.mjtRndFlag
        for off in (render.mjRND_REFLECTION, render.mjRND_HAZE, render.mjRND_SKYBOX):
            flags[off] = 0
        self._option, self._any = mujoco.MjvOption(), mujoco.MjvCamera()

    def close(self) -> None:
        """Give the memory back."""
        self._made.free()
        atexit.unregister(self._context.free)
        self._context.free()

    def draw(self, data: mujoco.MjData, camera: Pinhole, scenery: Scenery, level: Array, *, depth: bool) -> View:
        """The view of the model in that state, in light of which `level` [lx] of blue, green, red is the value 255."""
        scene, size = self._scene, (camera.height, camera.width)
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(self._model, data, self._option, None, self._any, everything, scene)
        for eye in scene.camera:
            aim(eye, camera)
        scene.nlight = light_up(scene.lights, scenery, level)
        for geom in scene.geoms[: scene.ngeom]:
            geom.specular, geom.shininess = 1.0, 0.5
        rect = mujoco.MjrRect(0, 0, camera.width, camera.height)
        self._context.make_current()
        mujoco.mjr_render(rect, scene, self._made)
        rgb = np.empty((*size, 3), np.uint8)
        mujoco.mjr_readPixels(rgb, None, rect, self._made)
        colour = np.ascontiguousarray(rgb[::-1, :, ::-1])
        if not depth:
            return View(colour, np.full(size, np.inf, np.float32))
        # In colours by number nothing is smoothed: depth is that at the centres of pixels.
        by_number = (mujoco.mjtRndFlag.mjRND_SEGMENT, mujoco.mjtRndFlag.mjRND_IDCOLOR)
        for flag in by_number:
            scene.flags[flag] = 1
        mujoco.mjr_render(rect, scene, self._made)
        for flag in by_number:
            scene.flags[flag] = 0
        raw = np.empty(size, np.float32)
        mujoco.mjr_readPixels(None, raw, rect, self._made)
        return View(colour, _distance(raw[::-1]))


def aim(eye: Any, camera: Pinhole) -> None:
    """Let an eye of a scene look as the camera does: pixel (0, 0) is the centre of the upper left one."""
    T = camera.T_world_optical
    eye.pos[:], eye.forward[:], eye.up[:] = T[:3, 3], T[:3, 2], -T[:3, 1]
    left, right = (-0.5 - camera.cx) / camera.fx * NEAR, (camera.width - 0.5 - camera.cx) / camera.fx * NEAR
    eye.frustum_center, eye.frustum_width = (left + right) / 2, (right - left) / 2
    eye.frustum_top = (camera.cy + 0.5) / camera.fy * NEAR
    eye.frustum_bottom = -(camera.height - 0.5 - camera.cy) / camera.fy * NEAR
    eye.frustum_near, eye.frustum_far = NEAR, FAR


def light_up(places: Any, scenery: Scenery, level: Array) -> int:
    """Set lights of a scene: those of the scenery, and one from everywhere; how many they are."""
    everywhere = places[0]
    _unlit(everywhere)
    everywhere.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL.value
    everywhere.dir[:] = (0, 0, -1)
    everywhere.ambient[:] = (ambient(scenery) / level)[::-1]
    shone = lamps(scenery)
    for light, place in zip(shone, places[1:], strict=False):
        _unlit(place)
        way = np.subtract(light.aim, light.position)
        distance = float(np.linalg.norm(way)) or 1.0
        place.dir[:] = way / distance
        share = (light.illuminance * tint(light.temperature) / level)[::-1]
        place.diffuse[:], place.specular[:] = share, SHINE * share
        place.castshadow = light.shadow
        if light.parallel:
            place.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL.value
            place.pos[:] = np.asarray(light.aim) - FAR_OFF * way / distance
        else:
            place.type = mujoco.mjtLightType.mjLIGHT_SPOT.value
            place.pos[:] = light.position
            place.attenuation[:] = (0, 0, 1 / distance**2)  # of the inverse square, 1 at its aim
            place.cutoff, place.exponent = CUTOFF, 0
    return 1 + len(shone)


def _unlit(place: Any) -> None:
    place.pos[:], place.attenuation[:] = (0, 0, FAR_OFF), (1, 0, 0)
    place.ambient[:] = place.diffuse[:] = place.specular[:] = 0
    place.cutoff, place.exponent, place.castshadow, place.headlight, place.range = 180, 0, 0, 0, FAR


def _distance(raw: NDArray[np.float32]) -> NDArray[np.float32]:
    """Depth [m] of a buffer in which 1 is `NEAR` and 0 is `FAR`, and evenly spaced is what is seen of 1/depth."""
    nearness = 1 / FAR + raw.astype(np.float64) * (1 / NEAR - 1 / FAR)
    return np.where(raw > 0, 1 / nearness, np.inf).astype(np.float32)


def _same(a: Array | None, b: Array | None) -> bool:
    if a is None or b is None:
        return a is b
    return a.shape == b.shape and bool(np.all(np.abs(a - b) < STILL))


# Pictures without OpenGL: a ray through the centre of each pixel, and light without shadows.

def ray_view(
    model: mujoco.MjModel, data: mujoco.MjData, camera: Pinhole, scenery: Scenery, level: Array, far: float
) -> View:
    """The view of a model in a state, lit as its surfaces are turned to the light.

    Args:
        model: what there is.
        data: where it is: its kinematics are done.
        camera: intrinsics and pose.
        scenery: the light.
        level: (3,) [lx] of blue, green and red light that is the value 255.
        far: how far rays go [m].
    """
    v, u = np.mgrid[0:camera.height, 0:camera.width]
    rays = camera.directions(np.column_stack([u.ravel(), v.ravel()]))
    count = len(rays)
    geoms, distances, found = np.full(count, -1, np.int32), np.full(count, -1.0), np.zeros(3 * count)
    all_groups, eye = np.ones(mujoco.mjNGROUP, np.uint8), camera.position
    mujoco.mj_multiRay(model, data, eye, rays.ravel(), all_groups, True, -1, geoms, distances, found, count, far)
    hit, normals = geoms >= 0, found.reshape(-1, 3)
    normals *= np.where(np.sum(normals * rays, axis=1) > 0, -1.0, 1.0)[:, None]  # on the side that is seen
    points = camera.position + distances[:, None] * rays
    light = np.broadcast_to(ambient(scenery), (count, 3)).copy()
    for lamp in lamps(scenery):
        way = np.subtract(lamp.aim, lamp.position)
        length = float(np.linalg.norm(way)) or 1.0
        if lamp.parallel:
            towards, strength = np.broadcast_to(-way / length, points.shape), np.ones(count)
        else:
            towards = np.asarray(lamp.position) - points
            away = np.maximum(np.linalg.norm(towards, axis=1), 1e-6)
            towards = towards / away[:, None]
            inside = -(towards @ way) / length >= math.cos(math.radians(CUTOFF))
            strength = inside * (length / away) ** 2
        turned = np.maximum(np.sum(normals * towards, axis=1), 0.0) * strength
        light += turned[:, None] * (lamp.illuminance * tint(lamp.temperature))
    colours = np.zeros((count, 3))
    colours[hit] = np.asarray(model.geom_rgba)[geoms[hit], 2::-1]
    colour = np.where(hit[:, None], np.clip(255 * colours * light / level, 0, 255), 0)
    along = np.asarray(rays @ camera.T_world_optical[:3, 2])
    depth = np.where(hit, distances * along, np.inf)
    shape = (camera.height, camera.width)
    return View(np.rint(colour).astype(np.uint8).reshape(*shape, 3), depth.astype(np.float32).reshape(shape))
