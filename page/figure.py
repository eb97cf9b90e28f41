"""Poses of links and frames, and a robot as nodes of the scene."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import pinocchio as pin
import viser
from numpy.typing import NDArray

from common.config import CameraConfig
from common.messages import TFMessage, TransformStamped
from common.robot.link_shapes import Rgb
from common.robot.model import RobotModel
from common.robot.transform_tree import MAX_FRAMES
from common.robot.transforms import pose_to_matrix, rpy_to_matrix, transform
from common.robot.visual_meshes import Piece
from page.nodes import brightened

Array = NDArray[np.float64]

_JOINT_TOLERANCE = 1e-6  # [rad or m] smaller changes are ignored: 1 micrometer at 1 m
_POSE_TOLERANCE = 1e-7  # [m or of a unit quaternion]


class LinkPoses:
    """Forward kinematics of all joints, in world, for any subset of joints in any order. Has its own working data."""

    def __init__(self, robot: RobotModel) -> None:
        """Start with the planning group at its home pose and other joints at the values of the robot file."""
        self._model = robot.full_model
        self._data = self._model.createData()
        self._q = robot.full_reference.copy()
        self._index = {name: self._model.joints[i].idx_q for i, name in enumerate(self._model.names) if i}
        self._frames = {f.name: i for i, f in enumerate(self._model.frames) if f.type == pin.FrameType.BODY}
        self.moves = 0  # number of updates that moved a joint
        self._names: tuple[str, ...] = ()
        self._known: list[int] = []
        self._slots: list[int] = []
        self.update(robot.joint_names, [float(value) for value in robot.named("home")])
        self._compute()

    def knows(self, link: str) -> bool:
        """Return whether the robot has that link."""
        return link in self._frames

    def update(self, names: Sequence[str], positions: Sequence[float]) -> bool:
        """Set joint positions [rad or m]; return whether any has changed. Unknown joints are ignored."""
        if tuple(names) != self._names:
            self._names = tuple(names)
            self._known = [i for i, name in enumerate(names) if name in self._index]
            self._slots = [self._index[names[i]] for i in self._known]
        values = np.asarray(positions, dtype=float)[self._known]
        if (np.abs(values - self._q[self._slots]) < _JOINT_TOLERANCE).all():
            return False
        self._q[self._slots] = values
        self._compute()
        self.moves += 1
        return True

    def has_joint(self, name: str) -> bool:
        """Return whether the robot has that joint."""
        return name in self._index

    def joint_positions(self, names: Sequence[str]) -> Array:
        """Return positions [rad or m] of joints of the robot."""
        return np.asarray(self._q[[self._index[name] for name in names]])

    def pose(self, link: str) -> tuple[Array, Array]:
        """Return position (3,) [m] and quaternion w, x, y, z (4,) of a link in world."""
        x = pin.SE3ToXYZQUAT(self._data.oMf[self._frames[link]])
        return x[:3], x[[6, 3, 4, 5]]

    @property
    def joints(self) -> list[tuple[str, int, int]]:
        """Name, index and parent index of each joint, parents first; 0 is the world."""
        return [(str(name), i, int(self._model.parents[i])) for i, name in enumerate(self._model.names) if i]

    def parent_joint(self, link: str) -> tuple[int, Array, Array]:
        """Return the joint that moves a link, and the link's position (3,) [m] and quaternion w, x, y, z (4,) in it."""
        frame = self._model.frames[self._frames[link]]
        x = pin.SE3ToXYZQUAT(frame.placement)
        return int(frame.parentJoint), x[:3], x[[6, 3, 4, 5]]

    def in_parents(self) -> Array:
        """Return (n, 7) position [m] and quaternion w, x, y, z of each of `joints` in the frame of its parent."""
        x = np.array([pin.SE3ToXYZQUAT(self._data.liMi[i]) for i in range(1, self._model.njoints)])
        return np.asarray(x[:, [0, 1, 2, 6, 3, 4, 5]])

    def _compute(self) -> None:
        pin.framesForwardKinematics(self._model, self._data, self._q)


class Transforms:
    """The newest transform of each frame, from tf and tf_static."""

    def __init__(self, cameras: Iterable[CameraConfig]) -> None:
        """Start with the configured camera poses; the first one is the default for unknown frames."""
        self._fixed = {camera.frame: transform(rpy_to_matrix(*camera.rpy), camera.position) for camera in cameras
                       if not camera.mount}
        self.newest: dict[str, TransformStamped] = {}  # by frame

    def update(self, m: TFMessage) -> None:
        """Store transforms; beyond the maximum number of frames, those not updated for longest are removed."""
        for each in m.transforms:
            self.newest.pop(each.child_frame_id, None)
            self.newest[each.child_frame_id] = each
        for name in [*self.newest][: max(0, len(self.newest) - MAX_FRAMES)]:
            del self.newest[name]

    def pose(self, frame: str) -> Array:
        """Return (4, 4) T_world_frame; the configured camera pose if no chain of transforms leads to world."""
        T, seen = np.eye(4), set()
        while frame not in ("", "world"):
            each = self.newest.get(frame)
            if each is None or frame in seen:
                return self._fixed.get(frame, next(iter(self._fixed.values()), np.eye(4)))
            seen.add(frame)
            T = pose_to_matrix(each.transform) @ T
            frame = each.header.frame_id
        return T


class Figure:
    """A robot in the scene: a node for each joint as child of its parent joint, with the links that have a shape."""

    def __init__(
        self, scene: viser.SceneApi, root: str, pieces: Iterable[Piece], poses: LinkPoses, *,
        color: Rgb | None = None, opacity: float | None = None, visible: bool = True,
    ) -> None:
        """Add the nodes under `root`; the meshes are sent when the robot is shown first.

        Args:
            scene: to which the nodes are added.
            root: name of the parent node.
            pieces: meshes of the links.
            poses: of the links, now and at each `follow`.
            color: replaces the colors of the meshes.
            opacity: 0 to 1; None: opaque.
            visible: whether it is shown.
        """
        self.poses = poses
        self.root = scene.add_frame(root, show_axes=False, visible=visible)
        paths, self._joints = {0: root}, []
        for name, index, parent in poses.joints:
            paths[index] = f"{paths[parent]}/{name}"
            self._joints.append(scene.add_frame(paths[index], show_axes=False))
        self._shown_poses = np.full((len(self._joints), 7), np.nan)
        self.links: dict[str, viser.FrameHandle] = {}
        self._scene, self._color, self._opacity = scene, color, opacity
        self._pending = list(pieces)
        for piece in self._pending:
            joint, position, wxyz = poses.parent_joint(piece.link)
            if piece.link not in self.links:
                self.links[piece.link] = scene.add_frame(
                    f"{paths[joint]}/{piece.link}", show_axes=False, position=position, wxyz=wxyz)
        if visible:
            self._send_meshes()
        self._place()

    @property
    def visible(self) -> bool:
        """Whether it is shown."""
        return self.root.visible

    @visible.setter
    def visible(self, on: bool) -> None:
        if on:
            self._send_meshes()
        self.root.visible = on

    def move(self, names: Sequence[str], positions: Sequence[float]) -> None:
        """Move to joint positions [rad or m]."""
        self.poses.update(names, positions)
        self.follow()

    def follow(self) -> None:
        """Update the nodes from `poses`."""
        if self.poses.moves != self._moves:
            self._place()

    def _send_meshes(self) -> None:
        """Send the meshes once they are needed: a browser spends time on hidden meshes too."""
        opaque = self._opacity is None
        for number, piece in enumerate(self._pending):
            self._scene.add_mesh_simple(
                f"{self.links[piece.link].name}/{number}", piece.vertices, piece.faces,
                color=self._color or brightened(piece.color), opacity=self._opacity, cast_shadow=opaque,
                receive_shadow=opaque,
            )
        self._pending.clear()

    def _place(self) -> None:
        """Send changes only: of a revolute joint just its rotation, which moves all its children."""
        self._moves = self.poses.moves
        poses = self.poses.in_parents()
        moved = ~(np.abs(poses - self._shown_poses) < _POSE_TOLERANCE)
        self._shown_poses = poses
        for node, pose, changed in zip(self._joints, poses, moved, strict=True):
            if changed[:3].any():
                node.position = pose[:3]
            if changed[3:].any():
                node.wxyz = pose[3:]
