"""The camera as a frustum, with its picture in it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import numpy as np
import viser
from numpy.typing import NDArray

from common.messages import CameraInfo
from common.viewer.poses import matrix_wxyz

Picture = NDArray[np.uint8]  # (height, width, 3) RGB

_WIDTH = 0.14  # of the picture in the scene [m]
_PIXELS = 320  # at most so many across: it is small on the page
_PERIOD = 0.5  # [s] between pictures
_COLOR = (120, 170, 255)


class Camera:
    """A frustum where the camera is."""

    def __init__(self, scene: viser.SceneApi, root: str, clock: Callable[[], float] = time.monotonic) -> None:
        """Start without one."""
        self._scene = scene
        self._name = f"{root}/frustum"
        self._clock = clock
        self._node: viser.CameraFrustumHandle | None = None
        self._info: CameraInfo | None = None
        self._last = -math.inf

    def show(self, m: CameraInfo, T_world_optical: NDArray[np.float64]) -> None:
        """Show this camera at that pose (4, 4)."""
        if self._node is None or self._info is None or (m.k, m.width, m.height) != (
            self._info.k, self._info.width, self._info.height
        ):
            self._node = self._scene.add_camera_frustum(
                self._name, 2 * math.atan2(m.height / 2, m.k[4]), (m.width / m.k[0]) / (m.height / m.k[4]),
                color=_COLOR, thickness=1.5, thickness_units="screen", cast_shadow=False, receive_shadow=False,
                format="jpeg", jpeg_quality=70,
            )
            depth = _WIDTH * m.k[0] / m.width  # of the picture from the optical centre
            self._node.scale = depth / self._node.compute_canonical_frustum_size()[2]
            self._last = -math.inf
        self._info = m
        self._node.position, self._node.wxyz = T_world_optical[:3, 3], matrix_wxyz(T_world_optical)

    def picture(self, rgb: Picture) -> None:
        """Show a picture in it, unless the last one is younger than half a second."""
        now = self._clock()
        if self._node is None or now - self._last < _PERIOD:
            return
        self._last = now
        step = max(1, math.ceil(rgb.shape[1] / _PIXELS))
        self._node.image = np.ascontiguousarray(rgb[::step, ::step])
