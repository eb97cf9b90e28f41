"""OpenGL rendering without a screen: choose a backend, its thread, and draw a model.

MuJoCo's own choice, made at import, is for a screen. The two offscreen backends are libraries of the system; with
Debian's libegl1, libgl1-mesa-dri and libopengl0, EGL needs no graphics card.
"""

from __future__ import annotations

import atexit
import ctypes
import ctypes.util
import logging
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any, TypeVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from common.config import Scenery
from common.perception.pinhole import Pinhole
from common.sim.ray_caster import View
from common.sim.sensors import CUTOFF, ambient, lamps, tint

Array = NDArray[np.float64]
T = TypeVar("T")

log = logging.getLogger(__name__)

VARIABLE = "MUJOCO_GL"
CHOICES = ("egl", "osmesa")
OFF = ("disable", "disabled", "off", "false", "0", "none")
_PLATFORM_DEVICE, _NO_DISPLAY = 0x313F, None
_MAX_DEVICES = 16


NEAR, FAR = 0.02, 12.0  # [m] clipping planes
FAR_OFF = 3.0  # [m] distance of the origin of parallel light from its aim
SHINE = 0.1  # fraction of light that smooth surfaces reflect specularly
MAX_GEOMS = 4000


@cache
def select_gl() -> str:
    """Return `egl`, `osmesa`, or empty if neither is available; MUJOCO_GL overrides with one of them or `off`."""
    named = os.environ.get(VARIABLE, "").strip().lower()
    if named in OFF:
        log.info("images are ray-cast, without shadows: %s=%s", VARIABLE, named)
        return ""
    if named in CHOICES:
        found, why = named, f"set by {VARIABLE}"
    elif has_egl():
        found, why = "egl", "detected"
    elif ctypes.util.find_library("OSMesa"):
        found, why = "osmesa", "detected, no EGL"
    else:
        found, why = "", ""
    if found:
        log.info("images are rendered by OpenGL (%s, %s)", found, why)
    else:
        log.warning("images are ray-cast, without shadows: neither EGL (apt-get install libegl1 "
                    "libgl1-mesa-dri libopengl0) nor OSMesa is available")
    return found


def has_egl() -> bool:
    """Whether EGL opens a device without a screen."""
    try:
        egl = ctypes.CDLL(ctypes.util.find_library("EGL") or "libEGL.so.1")
        find = egl.eglGetProcAddress
    except (OSError, AttributeError):
        return False
    find.restype, find.argtypes = ctypes.c_void_p, [ctypes.c_char_p]
    devices_at, display_at = find(b"eglQueryDevicesEXT"), find(b"eglGetPlatformDisplayEXT")
    if not devices_at or not display_at:
        return False
    pointer, number = ctypes.c_void_p, ctypes.c_int
    query = ctypes.CFUNCTYPE(ctypes.c_uint, number, ctypes.POINTER(pointer), ctypes.POINTER(number))(devices_at)
    display_of = ctypes.CFUNCTYPE(pointer, ctypes.c_uint, pointer, ctypes.POINTER(number))(display_at)
    devices, count = (pointer * _MAX_DEVICES)(), number(0)
    if not query(_MAX_DEVICES, devices, ctypes.byref(count)):
        return False
    egl.eglInitialize.restype, egl.eglInitialize.argtypes = ctypes.c_uint, [pointer, pointer, pointer]
    for device in devices[: count.value]:
        display = display_of(_PLATFORM_DEVICE, device, None)
        if display != _NO_DISPLAY and egl.eglInitialize(display, None, None):
            return True
    return False


def gl_context(kind: str, width: int, height: int) -> Any:
    """Create an OpenGL context of a size [px], not yet current.

    Raises:
        ImportError, RuntimeError: the library or its Python binding is missing or fails.
    """
    if kind == "osmesa":
        from mujoco.osmesa import GLContext
    else:
        from mujoco.egl import GLContext
    return GLContext(width, height)


class SingleThread:
    """Runs calls on one dedicated thread: OpenGL objects belong to the thread that created them."""

    def __init__(self, name: str) -> None:
        """Prepare; the thread starts with the first call."""
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix=name)

    def __call__(self, call: Callable[..., T], *arguments: Any) -> T:
        """Run a call; return its result or raise its exception."""
        return self._pool.submit(call, *arguments).result()

    def close(self) -> None:
        """Stop the thread."""
        self._pool.shutdown(wait=False)


class Canvas:
    """A model in OpenGL memory. It belongs to the thread that created it."""

    def __init__(self, model: mujoco.MjModel, camera: Pinhole, gl: str) -> None:
        """Create a context for images of the camera's size.

        Raises:
            ImportError, RuntimeError: OpenGL does not work.
        """
        self._model = model
        self._context = gl_context(gl, camera.width, camera.height)
        atexit.register(self._context.free)  # at interpreter exit OpenGL would be unloaded already
        self._context.make_current()
        self._mjr = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_50.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._mjr)
        self._mjr.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        self._scene = mujoco.MjvScene(model, maxgeom=MAX_GEOMS)
        flags, render = self._scene.flags, mujoco.mjtRndFlag
        for off in (render.mjRND_REFLECTION, render.mjRND_HAZE, render.mjRND_SKYBOX):
            flags[off] = 0
        self._option, self._any = mujoco.MjvOption(), mujoco.MjvCamera()

    def close(self) -> None:
        """Free the memory."""
        self._mjr.free()
        atexit.unregister(self._context.free)
        self._context.free()

    def draw(self, data: mujoco.MjData, camera: Pinhole, scenery: Scenery, level: Array, *, depth: bool) -> View:
        """Render the model; `level` [lx] of blue, green and red light maps to the value 255."""
        scene, size = self._scene, (camera.height, camera.width)
        all_categories = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(self._model, data, self._option, None, self._any, all_categories, scene)
        for view_camera in scene.camera:
            aim(view_camera, camera)
        scene.nlight = light_up(scene.lights, scenery, level)
        for geom in scene.geoms[: scene.ngeom]:
            geom.specular, geom.shininess = 1.0, 0.5
        rect = mujoco.MjrRect(0, 0, camera.width, camera.height)
        self._context.make_current()
        mujoco.mjr_render(rect, scene, self._mjr)
        rgb = np.empty((*size, 3), np.uint8)
        mujoco.mjr_readPixels(rgb, None, rect, self._mjr)
        colour = np.ascontiguousarray(rgb[::-1, :, ::-1])
        if not depth:
            return View(colour, np.full(size, np.inf, np.float32))
        # Segmentation colors are not antialiased: depth is sampled at pixel centers.
        segmentation = (mujoco.mjtRndFlag.mjRND_SEGMENT, mujoco.mjtRndFlag.mjRND_IDCOLOR)
        for flag in segmentation:
            scene.flags[flag] = 1
        mujoco.mjr_render(rect, scene, self._mjr)
        for flag in segmentation:
            scene.flags[flag] = 0
        raw = np.empty(size, np.float32)
        mujoco.mjr_readPixels(None, raw, rect, self._mjr)
        return View(colour, _distance(raw[::-1]))


def aim(view_camera: Any, camera: Pinhole) -> None:
    """Set the pose and frustum of a scene camera: pixel (0, 0) is the center of the upper left one."""
    T = camera.T_world_optical
    view_camera.pos[:], view_camera.forward[:], view_camera.up[:] = T[:3, 3], T[:3, 2], -T[:3, 1]
    left, right = (-0.5 - camera.cx) / camera.fx * NEAR, (camera.width - 0.5 - camera.cx) / camera.fx * NEAR
    view_camera.frustum_center, view_camera.frustum_width = (left + right) / 2, (right - left) / 2
    view_camera.frustum_top = (camera.cy + 0.5) / camera.fy * NEAR
    view_camera.frustum_bottom = -(camera.height - 0.5 - camera.cy) / camera.fy * NEAR
    view_camera.frustum_near, view_camera.frustum_far = NEAR, FAR


def light_up(places: Any, scenery: Scenery, level: Array) -> int:
    """Set the lights of a scene: those of the scenery and an ambient one; return their number."""
    ambient_light = places[0]
    _unlit(ambient_light)
    ambient_light.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL.value
    ambient_light.dir[:] = (0, 0, -1)
    ambient_light.ambient[:] = (ambient(scenery) / level)[::-1]
    sources = lamps(scenery)
    for light, place in zip(sources, places[1:], strict=False):
        _unlit(place)
        direction = np.subtract(light.aim, light.position)
        distance = float(np.linalg.norm(direction)) or 1.0
        place.dir[:] = direction / distance
        radiance = (light.illuminance * tint(light.temperature) / level)[::-1]
        place.diffuse[:], place.specular[:] = radiance, SHINE * radiance
        place.castshadow = light.shadow
        if light.parallel:
            place.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL.value
            place.pos[:] = np.asarray(light.aim) - FAR_OFF * direction / distance
        else:
            place.type = mujoco.mjtLightType.mjLIGHT_SPOT.value
            place.pos[:] = light.position
            place.attenuation[:] = (0, 0, 1 / distance**2)  # inverse square law, 1 at its aim
            place.cutoff, place.exponent = CUTOFF, 0
    return 1 + len(sources)


def _unlit(place: Any) -> None:
    place.pos[:], place.attenuation[:] = (0, 0, FAR_OFF), (1, 0, 0)
    place.ambient[:] = place.diffuse[:] = place.specular[:] = 0
    place.cutoff, place.exponent, place.castshadow, place.headlight, place.range = 180, 0, 0, 0, FAR


def _distance(raw: NDArray[np.float32]) -> NDArray[np.float32]:
    """Depth [m] of a buffer that is linear in 1/depth, with 1 at `NEAR` and 0 at `FAR`."""
    nearness = 1 / FAR + raw.astype(np.float64) * (1 / NEAR - 1 / FAR)
    return np.where(raw > 0, 1 / nearness, np.inf).astype(np.float32)
