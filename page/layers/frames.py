"""Where things hang in space, as tf tells it: cameras with their pictures, frames with their names; and a grid."""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from common import topics
from common.messages import CameraInfo, TransformStamped
from common.robot.transforms import pose_to_matrix
from common.topics import Topic
from page.labels import Labels
from page.layers import Layer
from page.nodes import FLAT, matrix_wxyz, position_of, wxyz_of
from page.pictures import Picture

_AXIS = 0.08  # length [m]
_WIDTH = 0.14  # of the picture in the scene [m]
_PIXELS = 320  # at most so many across: it is small on the page
_PICTURES = 0.5  # [s] between pictures
_MOVES = 0.1  # [s] between places of a camera that moves
_COLOR = (120, 170, 255)
_MOST, _DEEPEST = 500, 50  # frames that are shown, and how many one may hang on: tf may tell of any number
_ROOTS = ("", "world")


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
        self._parents: dict[str, str] = {}
        self._nodes: dict[str, viser.FrameHandle] = {}
        self.labels = Labels(self.scene, self.root, scale=0.6)

    def show(self, topic: Topic[Any], message: Any) -> None:
        """Move all frames to where they are now, also those that hang on what moved; what hangs on nothing is left out.

        Of each frame first the one that it hangs on is looked at.
        """
        below: dict[str, list[TransformStamped]] = {}
        for each in self.stage.transforms.newest.values():
            below.setdefault(each.header.frame_id, []).append(each)
        places: dict[str, NDArray[np.float64]] = {}
        waiting = deque((root, self.root, np.eye(4), 0) for root in _ROOTS)
        while waiting:
            parent, above, T_world_parent, depth = waiting.popleft()
            for each in below.get(parent, ()):
                name = each.child_frame_id
                if name not in _ROOTS and depth < _DEEPEST and len(places) < _MOST:
                    places[name] = T_world_parent @ pose_to_matrix(each.transform)
                    waiting.append((name, self._placed(each, above).name, places[name], depth + 1))
        for name in [name for name in self._nodes if name not in places]:
            self._forget(name)
        self.labels.show({name: (name, places[name][:3, 3]) for name in self._nodes}, self.stage.view())

    def node(self, frame: str) -> viser.FrameHandle | None:
        """The node of a frame."""
        return self._nodes.get(frame)

    def _placed(self, each: TransformStamped, above: str) -> viser.FrameHandle:
        """The node of a frame, where it is now in the one that it hangs on."""
        name, parent = each.child_frame_id, each.header.frame_id
        if self._parents.get(name) != parent:
            self._forget(name)  # hangs elsewhere now, and so do those that hang on it
            path = f"{above}/{name.replace('/', '_').replace(' ', '_')}"
            while self.scene.get_handle_by_name(path) is not None:  # that of another frame
                path += "_"
            self._nodes[name] = self.scene.add_frame(path, axes_length=_AXIS, axes_radius=0.04 * _AXIS)
            self._parents[name] = parent
        node = self._nodes[name]
        node.position, node.wxyz = position_of(each.transform), wxyz_of(each.transform)
        return node

    def _forget(self, name: str) -> None:
        """Leave out a frame, and those that hang on it; nothing where it is not shown."""
        if (node := self._nodes.get(name)) is None:
            return
        node.remove()
        for frame in [frame for frame, each in self._nodes.items() if each.name.startswith(f"{node.name}/")] + [name]:
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
