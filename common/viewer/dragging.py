"""Pulling a node about on a horizontal plane with the mouse."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import viser
from numpy.typing import ArrayLike

_LEAST_SLOPE = 1e-3  # of a line of sight that meets the plane anywhere near


def on_plane(eye: ArrayLike, through: ArrayLike, z: float) -> tuple[float, float] | None:
    """Where the line of sight from the eye through a point meets the plane at height z [m]; None: behind or never."""
    start, point = np.asarray(eye, dtype=float), np.asarray(through, dtype=float)
    way = point - start
    if abs(way[2]) < _LEAST_SLOPE * float(np.linalg.norm(way)):
        return None
    t = (z - start[2]) / way[2]
    if t <= 0:
        return None
    x, y = start[:2] + t * way[:2]
    return float(x), float(y)


class Drag:
    """Lets a node be dragged at its own height until `stop`; it goes back to where it was when it is dropped."""

    def __init__(self, node: Any, dropped: Callable[[float, float], None]) -> None:
        """Listen to the node. `dropped` is called with where it was let go, x, y [m]."""
        self._node = node
        self._dropped = dropped
        self._home = np.zeros(3)
        self._grip = np.zeros(2)
        self._held = False
        node.on_drag(self._on_drag)

    @property
    def held(self) -> bool:
        """Whether somebody drags it now."""
        return self._held

    def stop(self) -> None:
        """Listen no longer; what is held just now goes back to where it was."""
        if self._held:
            self._held = False
            self._node.position = self._home
        self._node.remove_drag_callback(self._on_drag)

    async def _on_drag(self, event: viser.SceneNodeDragEvent[Any]) -> None:
        """Follow the pointer: viser keeps the order of the phases for coroutines only."""
        eye = event.client.camera.position
        if event.phase == "start":
            self._home = self._node.position.copy()
            grip = on_plane(eye, event.start_position, float(self._home[2]))
            self._held = grip is not None
            self._grip = np.array(grip or (0.0, 0.0)) - self._home[:2]
            return
        if not self._held:
            return
        at = on_plane(eye, event.end_position, float(self._home[2]))
        place = self._node.position[:2].copy() if at is None else np.array(at) - self._grip
        if event.phase == "update":
            self._node.position = (*place, self._home[2])
            return
        self._held = False
        self._node.position = self._home
        self._dropped(float(place[0]), float(place[1]))
