"""Which OpenGL draws pictures without a screen, and the one thread that may do so.

MuJoCo's own choice, which it makes when it is imported, is for a screen: here the two that need none are looked for.
Both are libraries of the system; with Debian's libegl1, libgl1-mesa-dri and libopengl0 EGL needs no graphics card.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import logging
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any, TypeVar

T = TypeVar("T")

log = logging.getLogger(__name__)

VARIABLE = "MUJOCO_GL"
CHOICES = ("egl", "osmesa")
OFF = ("disable", "disabled", "off", "false", "0", "none")
_PLATFORM_DEVICE, _NO_DISPLAY = 0x313F, None
_MOST_DEVICES = 16


@cache
def select_gl() -> str:
    """`egl`, `osmesa`, or empty where there is neither; MUJOCO_GL chooses where it names one of them or `off`."""
    named = os.environ.get(VARIABLE, "").strip().lower()
    if named in OFF:
        log.info("pictures are drawn by rays, without shadows: %s=%s", VARIABLE, named)
        return ""
    if named in CHOICES:
        found, why = named, f"as {VARIABLE} says"
    elif _has_egl():
        found, why = "egl", "found here"
    elif ctypes.util.find_library("OSMesa"):
        found, why = "osmesa", "found here, without EGL"
    else:
        found, why = "", ""
    if found:
        log.info("pictures are drawn by OpenGL (%s, %s)", found, why)
    else:
        log.warning("pictures are drawn by rays, without shadows: there is no EGL here (apt-get install libegl1 "
                    "libgl1-mesa-dri libopengl0) and no OSMesa")
    return found


def _has_egl() -> bool:
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
    devices, count = (pointer * _MOST_DEVICES)(), number(0)
    if not query(_MOST_DEVICES, devices, ctypes.byref(count)):
        return False
    egl.eglInitialize.restype, egl.eglInitialize.argtypes = ctypes.c_uint, [pointer, pointer, pointer]
    for device in devices[: count.value]:
        display = display_of(_PLATFORM_DEVICE, device, None)
        if display != _NO_DISPLAY and egl.eglInitialize(display, None, None):
            return True
    return False


def gl_context(kind: str, width: int, height: int) -> Any:
    """A context for pictures of that size [px], not yet current.

    Raises:
        ImportError, RuntimeError: the library or its binding for Python is not there, or does not work.
    """
    if kind == "osmesa":
        from mujoco.osmesa import GLContext
    else:
        from mujoco.egl import GLContext
    return GLContext(width, height)


class SingleThread:
    """Runs calls on one thread of its own, whoever asks: what belongs to OpenGL belongs to the thread that made it."""

    def __init__(self, name: str) -> None:
        """Start none yet."""
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix=name)

    def __call__(self, call: Callable[..., T], *arguments: Any) -> T:
        """The answer of a call, or what it raised."""
        return self._pool.submit(call, *arguments).result()

    def close(self) -> None:
        """End the thread."""
        self._pool.shutdown(wait=False)
