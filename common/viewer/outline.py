"""The contours that may be chosen, and the outline of the one that was."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import viser
from numpy.typing import NDArray

from common.applications.outlining.messages import Contour, Contours, OutlinePoints
from common.config import Fixture, Surroundings
from common.messages import CollisionObject, PlanningScene
from common.perception.pinhole import Pinhole
from common.viewer.poses import position_of, rgb_of

Array = NDArray[np.float64]

OUTLINE = (255, 140, 40)
CHOSEN = (255, 255, 255)
_LIFTED = 0.002  # [m] lines lie this far above the faces, so as to be seen
_POINTS = 200  # of a contour
_PIN = 0.006  # radius of what is clicked [m]


class Outline:
    """The outline as a closed line."""

    def __init__(self, scene: viser.SceneApi, root: str) -> None:
        """Start without one."""
        self._scene = scene
        self._name = f"{root}/line"
        self._node: viser.LineSegmentsHandle | None = None
        self._points: Array = np.empty((0, 3))

    def show(self, m: OutlinePoints) -> None:
        """Show this outline; one without points clears it."""
        points = np.array([position_of(pose) for pose in m.poses]).reshape(-1, 3)
        if np.array_equal(points, self._points):
            return
        self._points = points
        if self._node is not None:
            self._node.remove()
            self._node = None
        if len(points) > 1:
            line = closed_line(points + np.array([0.0, 0.0, 2 * _LIFTED]))  # above the line of its contour
            self._node = self._scene.add_line_segments(
                self._name, line, OUTLINE, thickness=4.0, thickness_units="screen"
            )


def closed_line(points: Array) -> Array:
    """Segments (n, 2, 3) from each point to the next, and from the last to the first."""
    return np.stack([points, np.roll(points, -1, axis=0)], axis=1)


class ContourChoice:
    """The contours of the picture, laid on what they are the contours of, each with a pin to click and its label."""

    def __init__(
        self, scene: viser.SceneApi, root: str, around: Surroundings, select: Callable[[int], None]
    ) -> None:
        """Start without any. `select` is called with the index of the contour whose pin was clicked."""
        self._scene = scene
        self._root = root
        self._around = around
        self._select = select
        self._shown: object = None
        self._nodes: list[viser.LineSegmentsHandle | viser.LabelHandle | viser.IcosphereHandle] = []

    def show(self, m: Contours, camera: Pinhole, scene: PlanningScene | None) -> None:
        """Show these contours, as a camera sees them, on the objects of a planning scene that have their labels."""
        tops = {thing.id: _top(thing) for thing in scene.objects} if scene else {}
        heights = [tops.get(c.label) or self._support(c, camera) for c in m.contours]
        what = (m.contours, m.selected, m.width, heights, camera.T_world_optical.tolist(), camera.fx, camera.cx)
        if what == self._shown:
            return
        self._shown = what
        for node in self._nodes:
            node.remove()
        self._nodes = []
        for contour, height in zip(m.contours, heights, strict=True):
            self._add(contour, height + _LIFTED, camera, chosen=contour.index == m.selected)

    def _add(self, contour: Contour, height: float, camera: Pinhole, *, chosen: bool) -> None:
        pixels = np.array(contour.pixels)
        some = pixels[np.unique(np.linspace(0, len(pixels) - 1, _POINTS).round().astype(int))]
        at = camera.on_plane(some, height)
        points = np.column_stack([at, np.full(len(at), height)])
        if not np.isfinite(points).all():  # the camera does not look down at it
            return
        name, color = f"{self._root}/{contour.index}", rgb_of(contour.color)
        self._nodes.append(self._scene.add_line_segments(
            f"{name}_line", closed_line(points), CHOSEN if chosen else color, thickness=2.0,
            thickness_units="screen",
        ))
        x, y = (points[:, :2].min(axis=0) + points[:, :2].max(axis=0)) / 2
        pin = self._scene.add_icosphere(
            f"{name}_pin", _PIN, CHOSEN if chosen else color, position=(x, y, height + 2 * _PIN), cast_shadow=False,
            receive_shadow=False,
        )
        index = contour.index

        @pin.on_click
        def _(_event: object) -> None:
            self._select(index)

        label = self._scene.add_label(
            f"{name}_label", f"{index}: {contour.label}", position=(x, y, height + 4 * _PIN), anchor="bottom-center",
            font_screen_scale=0.8,
        )
        self._nodes += [pin, label]

    def _support(self, contour: Contour, camera: Pinhole) -> float:
        """Height [m] of the highest flat fixture that the contour lies on, else of the table."""
        middle = np.array(contour.pixels).mean(axis=0)
        tops = sorted(((fixture_top(f), f) for f in self._around.fixtures), key=lambda pair: -pair[0])
        for height, fixture in tops:
            x, y = camera.on_plane(middle, height)
            if _carries(fixture, float(x), float(y)):
                return height
        return self._around.table_height


def fixture_top(fixture: Fixture) -> float:
    """Height [m] of the top of an upright fixture."""
    sizes = fixture.dimensions
    half = {"box": sizes[-1] / 2, "cylinder": sizes[-1] / 2, "sphere": sizes[0]}[fixture.shape]
    return fixture.position[2] + half


def _carries(fixture: Fixture, x: float, y: float) -> bool:
    if fixture.shape == "sphere" or any(fixture.rpy[:2]):
        return False
    dx, dy = x - fixture.position[0], y - fixture.position[1]
    if fixture.shape == "cylinder":
        return bool(np.hypot(dx, dy) <= fixture.dimensions[0])
    c, s = np.cos(fixture.rpy[2]), np.sin(fixture.rpy[2])
    return bool(abs(c * dx + s * dy) <= fixture.dimensions[0] / 2 and abs(c * dy - s * dx) <= fixture.dimensions[1] / 2)


def _top(thing: CollisionObject) -> float:
    """Height [m] of the top of an upright object."""
    sizes = thing.dimensions
    return thing.pose.position.z + (sizes[0] if thing.shape == "sphere" else sizes[-1] / 2)
