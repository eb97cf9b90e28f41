"""Sensors and frames at their poses of tf: point clouds, cameras with their images, frames; and a grid."""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from common import topics
from common.messages import CameraInfo, PointCloud2, TransformStamped
from common.robot.transforms import pose_to_matrix
from common.topics import Topic
from page.camera_panel import RgbImage
from page.layers import Layer
from page.nodes import FLAT, Labels, matrix_wxyz, position_of, wxyz_of

MAX_POINTS = 20_000  # of a cloud: a browser without a GPU draws them several times a second
_POINT_SIZE = 0.003  # [m]
_CAMERA_COLOR = (120, 170, 255)
_IMAGE_WIDTH = 0.14  # in the scene [m]
_MIN_ANGLE, _MAX_ASPECT = 1e-3, 1e3  # vertical angle of view [rad]; ratio of the sides of the view
_IMAGE_PIXELS = 320  # maximum width
_IMAGE_PERIOD = 0.5  # [s]
_CAMERA_PERIOD = 0.1  # [s] between two poses of a moving camera
_AXIS_LENGTH = 0.08  # [m]
_MAX_FRAMES, _MAX_DEPTH = 500, 50  # tf may contain any number of frames
_ROOTS = ("", "world")


class Points(Layer):
    """The newest point cloud of each depth camera, thinned out, in its colors; requested only while visible."""

    LABEL = "Point cloud"
    ON = False
    TOPICS = (topics.DEPTH_CAMERA_POINTS,)
    PERIOD = 0.5

    def build(self) -> None:
        """Start empty."""
        self.nodes: dict[str, viser.PointCloudHandle] = {}  # by topic key

    def show(self, topic: Topic[Any], message: Any) -> None:
        """Replace the cloud of a camera; a malformed one is left out."""
        found = thin_out(message)
        if found is None:
            return
        points, colors = found
        T = self.stage.transforms.pose(message.header.frame_id)
        self.nodes[topic.key] = self.scene.add_point_cloud(
            f"{self.root}/{topic.key.replace('/', '_')}", points, colors, point_size=_POINT_SIZE,
            point_shape="square", point_shading="flat", precision="float32", position=T[:3, 3], wxyz=matrix_wxyz(T))


def thin_out(cloud: PointCloud2, limit: int = MAX_POINTS) -> tuple[NDArray[np.float32], NDArray[np.uint8]] | None:
    """Return a regular subset of points (n, 3) [m] in the frame of the cloud and their RGB colors (n, 3).

    Returns None for a cloud whose fields and bytes are inconsistent, or that has no valid point.
    """
    step, row = cloud.point_step, cloud.width * cloud.point_step
    if not {"x", "y", "z"} <= set(cloud.fields) or step % 4 or 4 * len(cloud.fields) > step or cloud.row_step < row:
        return None
    if len(cloud.data) < cloud.row_step * (cloud.height - 1) + row:
        return None
    stride = max(1, int(np.ceil(np.sqrt(cloud.width * cloud.height / limit))))  # of rows, and of points in a row
    rows = np.lib.stride_tricks.as_strided(np.frombuffer(cloud.data, np.uint8), (cloud.height, row),
                                           (cloud.row_step, 1), writeable=False)[::stride]
    values = np.ascontiguousarray(rows).view("<f4").reshape(len(rows), cloud.width, step // 4)[:, ::stride]
    values = values.reshape(-1, step // 4)
    points = values[:, [cloud.fields.index(name) for name in ("x", "y", "z")]]
    valid = np.isfinite(points).all(axis=1)
    if not valid.any():
        return None
    colors = np.full((int(valid.sum()), 3), 200, np.uint8)
    if "rgb" in cloud.fields:
        packed = np.ascontiguousarray(values[valid, cloud.fields.index("rgb")]).view("<u4")
        colors = np.stack([packed >> 16 & 255, packed >> 8 & 255, packed & 255], axis=1).astype(np.uint8)
    return points[valid], colors


class Camera(Layer):
    """A frustum for each camera, with its image."""

    LABEL = "Cameras"
    LEGEND = (("camera", _CAMERA_COLOR),)
    TOPICS = (topics.CAMERA_INFO, topics.DEPTH_CAMERA_INFO, topics.TF_STATIC, topics.TF)

    def build(self) -> None:
        """Start empty."""
        self.nodes: dict[str, viser.CameraFrustumHandle] = {}  # by the prefix of the camera's keys
        self._infos: dict[str, CameraInfo] = {}
        self._last_image: dict[str, float] = {}
        self._last_move = -math.inf

    def show(self, topic: Topic[Any], message: Any) -> None:
        """Display a camera at its frame; moving cameras are updated ten times a second at most."""
        if isinstance(message, CameraInfo):
            self._show(topic.key.rpartition("/")[0], message)
        elif topic.key == topics.TF.key:
            if self.stage.clock() - self._last_move < _CAMERA_PERIOD:
                return
            self._last_move = self.stage.clock()
        for name, info in self._infos.items():
            T = self.stage.transforms.pose(info.header.frame_id)
            node, position, wxyz = self.nodes[name], T[:3, 3], matrix_wxyz(T)
            if not (np.array_equal(node.position, position) and np.array_equal(node.wxyz, wxyz)):
                node.position, node.wxyz = position, wxyz

    def _show(self, name: str, m: CameraInfo) -> None:
        known = self._infos.get(name)
        angle, aspect = 2 * math.atan2(m.height / 2, m.k[4]), (m.width / m.k[0]) / (m.height / m.k[4])
        if not (_MIN_ANGLE < angle < math.pi - _MIN_ANGLE and 1 / _MAX_ASPECT < aspect < _MAX_ASPECT):
            return  # no camera has such a view
        self._infos[name] = m
        if known is not None and (m.k, m.width, m.height) == (known.k, known.width, known.height):
            return
        node = self.nodes[name] = self.scene.add_camera_frustum(
            f"{self.root}/{name.replace('/', '_')}", angle, aspect, color=_CAMERA_COLOR, thickness=1.5,
            thickness_units="screen", format="jpeg", jpeg_quality=70, **FLAT,
        )
        node.scale = _IMAGE_WIDTH * m.k[0] / m.width / node.compute_canonical_frustum_size()[2]
        self._last_image[name] = -math.inf

    def show_image(self, topic: Topic[Any], rgb: RgbImage) -> None:
        """Display an image in its frustum, at most every half second."""
        name, now = topic.key.rpartition("/")[0], self.stage.clock()
        if name in self.nodes and now - self._last_image[name] >= _IMAGE_PERIOD:
            self._last_image[name] = now
            step = max(1, math.ceil(rgb.shape[1] / _IMAGE_PIXELS))
            self.nodes[name].image = np.ascontiguousarray(rgb[::step, ::step])


class Frames(Layer):
    """Axes and a name for each frame, as children of the parent frame's node."""

    LABEL = "Frames (TF)"
    LEGEND = (("x axis of a frame", (255, 0, 0)), ("y axis", (0, 255, 0)), ("z axis", (0, 0, 255)))
    ON = False
    TOPICS = (topics.TF_STATIC, topics.TF)
    PERIOD = 0.1

    def build(self) -> None:
        """Start empty."""
        self._parents: dict[str, str] = {}
        self._nodes: dict[str, viser.FrameHandle] = {}
        self.labels = Labels(self.scene, self.root, scale=0.6)

    def show(self, topic: Topic[Any], message: Any) -> None:
        """Update all frames that are connected to world, parents first."""
        children: dict[str, list[TransformStamped]] = {}
        for each in self.stage.transforms.newest.values():
            children.setdefault(each.header.frame_id, []).append(each)
        poses: dict[str, NDArray[np.float64]] = {}
        pending = deque((root, self.root, np.eye(4), 0) for root in _ROOTS)
        while pending:
            parent, path, T_world_parent, depth = pending.popleft()
            for each in children.get(parent, ()):
                name = each.child_frame_id
                if name not in _ROOTS and depth < _MAX_DEPTH and len(poses) < _MAX_FRAMES:
                    poses[name] = T_world_parent @ pose_to_matrix(each.transform)
                    pending.append((name, self._place(each, path).name, poses[name], depth + 1))
        for name in [name for name in self._nodes if name not in poses]:
            self._remove(name)
        self.labels.show({name: (name, poses[name][:3, 3]) for name in self._nodes}, self.stage.projection())

    def node(self, frame: str) -> viser.FrameHandle | None:
        """Return the node of a frame."""
        return self._nodes.get(frame)

    def _place(self, each: TransformStamped, parent_path: str) -> viser.FrameHandle:
        """Return the node of a frame, moved to its pose in its parent."""
        name, parent = each.child_frame_id, each.header.frame_id
        if self._parents.get(name) != parent:
            self._remove(name)  # it has another parent now, and so have its children
            path = f"{parent_path}/{name.replace('/', '_').replace(' ', '_')}"
            while self.scene.get_handle_by_name(path) is not None:  # the node of another frame
                path += "_"
            self._nodes[name] = self.scene.add_frame(path, axes_length=_AXIS_LENGTH, axes_radius=0.04 * _AXIS_LENGTH)
            self._parents[name] = parent
        node = self._nodes[name]
        node.position, node.wxyz = position_of(each.transform), wxyz_of(each.transform)
        return node

    def _remove(self, name: str) -> None:
        """Remove a frame and its children, if it is displayed."""
        if (node := self._nodes.get(name)) is None:
            return
        node.remove()
        for frame in [frame for frame, each in self._nodes.items() if each.name.startswith(f"{node.name}/")] + [name]:
            del self._nodes[frame], self._parents[frame]


class Grid(Layer):
    """A grid at the origin of the world."""

    LABEL = "Grid"

    def build(self) -> None:
        """Add it slightly below the origin, so that a table at that height covers it."""
        self.scene.add_grid(
            f"{self.root}/floor", 4.0, 4.0, cell_size=0.1, section_size=0.5, cell_color=(90, 95, 105),
            section_color=(130, 135, 145), position=(0.0, 0.0, -0.002), shadow_opacity=0.0,
        )
