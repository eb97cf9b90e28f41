"""Where things hang in space, as tf tells it: cameras with their pictures, frames with their names; and a grid."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import viser

from common import topics
from common.messages import CameraInfo, TransformStamped
from common.topics import Topic
from common.viewer.labels import Labels
from common.viewer.layers import Layer
from common.viewer.nodes import FLAT, matrix_wxyz, position_of, wxyz_of
from common.viewer.pictures import Picture

_AXIS = 0.08  # length [m]
_WIDTH = 0.14  # of the picture in the scene [m]
_PIXELS = 320  # at most so many across: it is small on the page
_PICTURES = 0.5  # [s] between pictures
_MOVES = 0.1  # [s] between places of a camera that moves
_COLOR = (120, 170, 255)


class Camera(Layer):
    """A frustum where a camera is, with what it sees."""

    LABEL = "Camera"
    LEGEND = (("camera", _COLOR),)
    TOPICS = (topics.CAMERA_INFO, topics.DEPTH_CAMERA_INFO, topics.TF_STATIC, topics.TF)

    def build(self) -> None:
        """Start without one."""
        self.nodes: dict[str, viser.CameraFrustumHandle] = {}  # by the beginning of the camera's keys
        self._infos: dict[str, CameraInfo] = {}
        self._last: dict[str, float] = {}
        self._moved = -math.inf

    def show(self, topic: Topic[Any], message: Any) -> None:
        """Show a camera where its frame is; one on the hand ten times a second at most."""
        if isinstance(message, CameraInfo):
            self._show(topic.key.rpartition("/")[0], message)
        elif topic.key == topics.TF.key:
            if self.stage.clock() - self._moved < _MOVES:
                return
            self._moved = self.stage.clock()
        for name, info in self._infos.items():
            T = self.stage.transforms.pose(info.header.frame_id)
            node, position, turn = self.nodes[name], T[:3, 3], matrix_wxyz(T)
            if not (np.array_equal(node.position, position) and np.array_equal(node.wxyz, turn)):
                node.position, node.wxyz = position, turn

    def _show(self, name: str, m: CameraInfo) -> None:
        known = self._infos.get(name)
        self._infos[name] = m
        if known is not None and (m.k, m.width, m.height) == (known.k, known.width, known.height):
            return
        node = self.nodes[name] = self.scene.add_camera_frustum(
            f"{self.root}/{name.replace('/', '_')}", 2 * math.atan2(m.height / 2, m.k[4]),
            (m.width / m.k[0]) / (m.height / m.k[4]), color=_COLOR, thickness=1.5, thickness_units="screen",
            format="jpeg", jpeg_quality=70, **FLAT,
        )
        node.scale = _WIDTH * m.k[0] / m.width / node.compute_canonical_frustum_size()[2]
        self._last[name] = -math.inf

    def picture(self, topic: Topic[Any], rgb: Picture) -> None:
        """Show a picture in its camera, unless the last one is younger than half a second."""
        name, now = topic.key.rpartition("/")[0], self.stage.clock()
        if name in self.nodes and now - self._last[name] >= _PICTURES:
            self._last[name] = now
            step = max(1, math.ceil(rgb.shape[1] / _PIXELS))
            self.nodes[name].image = np.ascontiguousarray(rgb[::step, ::step])


class Frames(Layer):
    """Axes and a name for each frame, below the frame that it hangs on: moving one moves what hangs on it."""

    LABEL = "Frames"
    LEGEND = (("x of a frame", (255, 0, 0)), ("y", (0, 255, 0)), ("z", (0, 0, 255)))
    ON = False
    TOPICS = (topics.TF_STATIC, topics.TF)
    PERIOD = 0.1

    def build(self) -> None:
        """Start without any."""
        self._waiting: dict[str, TransformStamped] = {}  # frames whose parent is not known yet
        self._parents: dict[str, str] = {}
        self._nodes: dict[str, viser.FrameHandle] = {}
        self.labels = Labels(self.scene, self.root, scale=0.6)

    def show(self, topic: Topic[Any], message: Any) -> None:
        """Move all frames to where they are now, also those that hang on what moved."""
        for each in self.stage.transforms.newest.values():
            self._place(each)
        self.labels.show({name: (name, self.stage.transforms.pose(name)[:3, 3]) for name in self._nodes},
                         self.stage.view())

    def node(self, frame: str) -> viser.FrameHandle | None:
        """The node of a frame."""
        return self._nodes.get(frame)

    def _place(self, each: TransformStamped) -> None:
        name, parent = each.child_frame_id, each.header.frame_id
        if self._parents.get(name) != parent:
            above = self._name_of(parent)
            if above is None:
                self._waiting[name] = each
                return
            self._add(name, parent, above)
        node = self._nodes[name]
        node.position, node.wxyz = position_of(each.transform), wxyz_of(each.transform)

    def _name_of(self, frame: str) -> str | None:
        if frame in ("", "world"):
            return self.root
        node = self._nodes.get(frame)
        return node.name if node else None

    def _add(self, name: str, parent: str, above: str) -> None:
        if name in self._nodes:  # hangs elsewhere now, and so do those that hang on it
            self._forget(name)
        node = f"{above}/{name.replace('/', '_')}"
        self._nodes[name] = self.scene.add_frame(node, axes_length=_AXIS, axes_radius=0.04 * _AXIS)
        self._parents[name] = parent
        for waiting in [w for w in self._waiting.values() if w.header.frame_id == name]:
            if self._waiting.pop(waiting.child_frame_id, None) is not None:
                self._place(waiting)

    def _forget(self, name: str) -> None:
        self._nodes[name].remove()
        below = f"{self._nodes[name].name}/"
        for frame in [frame for frame, node in self._nodes.items() if node.name.startswith(below)] + [name]:
            del self._nodes[frame], self._parents[frame]


class Grid(Layer):
    """A grid at the height of the world's origin."""

    LABEL = "Grid"

    def build(self) -> None:
        """Add it, a little lower: a table there lies above it."""
        self.scene.add_grid(
            f"{self.root}/floor", 4.0, 4.0, cell_size=0.1, section_size=0.5, cell_color=(90, 95, 105),
            section_color=(130, 135, 145), position=(0.0, 0.0, -0.002), shadow_opacity=0.0,
        )
