"""Where links and frames are, as joint states and transforms come, and a robot in the scene that is moved there."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import pinocchio as pin
import viser
from numpy.typing import NDArray

from common.config import CameraConfig
from common.messages import TFMessage, TransformStamped
from common.robot.model import RobotModel
from common.robot.transform_tree import MAX_FRAMES
from common.robot.transforms import pose_to_matrix, rpy_to_matrix, transform
from common.robot.visual_meshes import Piece, Rgb
from page.nodes import brightened

Array = NDArray[np.float64]

_JOINT_STILL = 1e-6  # [rad or m] a joint that moves by less has not moved: 1 micrometre at 1 m
_STILL = 1e-7  # [m or of a unit quaternion]


class LinkPoses:
    """Forward kinematics of all joints, in world: of any joints, in any order. Has working data of its own."""

    def __init__(self, robot: RobotModel) -> None:
        """Start with the group at home and other joints where the robot file locks them."""
        self._model = robot.full_model
        self._data = self._model.createData()
        self._q = robot.full_reference.copy()
        self._index = {name: self._model.joints[i].idx_q for i, name in enumerate(self._model.names) if i}
        self._frames = {f.name: i for i, f in enumerate(self._model.frames) if f.type == pin.FrameType.BODY}
        self.moves = 0  # how often any joint has moved
        self._names: tuple[str, ...] = ()
        self._picked: list[int] = []
        self._slots: list[int] = []
        self.update(robot.joint_names, [float(value) for value in robot.named("home")])
        self._compute()

    def knows(self, link: str) -> bool:
        """Whether the robot has that link."""
        return link in self._frames

    def update(self, names: Sequence[str], positions: Sequence[float]) -> bool:
        """Take over joint positions [rad or m]; whether any has changed. Joints that the robot lacks are left out."""
        if tuple(names) != self._names:
            self._names = tuple(names)
            self._picked = [i for i, name in enumerate(names) if name in self._index]
            self._slots = [self._index[names[i]] for i in self._picked]
        values = np.asarray(positions, dtype=float)[self._picked]
        if (np.abs(values - self._q[self._slots]) < _JOINT_STILL).all():
            return False
        self._q[self._slots] = values
        self._compute()
        self.moves += 1
        return True

    def has_joint(self, name: str) -> bool:
        """Whether the robot has that joint."""
        return name in self._index

    def joint_positions(self, names: Sequence[str]) -> Array:
        """Positions [rad or m] of joints of the robot."""
        return np.asarray(self._q[[self._index[name] for name in names]])

    def pose(self, link: str) -> tuple[Array, Array]:
        """Position (3,) [m] and quaternion w, x, y, z (4,) of a link in world."""
        x = pin.SE3ToXYZQUAT(self._data.oMf[self._frames[link]])
        return x[:3], x[[6, 3, 4, 5]]

    @property
    def joints(self) -> list[tuple[str, int, int]]:
        """Name, index and index of the parent of each joint, parents first; 0 is the world."""
        return [(str(name), i, int(self._model.parents[i])) for i, name in enumerate(self._model.names) if i]

    def carrier(self, link: str) -> tuple[int, Array, Array]:
        """The joint that carries a link, and the link's position (3,) [m] and quaternion w, x, y, z (4,) in it."""
        frame = self._model.frames[self._frames[link]]
        x = pin.SE3ToXYZQUAT(frame.placement)
        return int(frame.parentJoint), x[:3], x[[6, 3, 4, 5]]

    def in_parents(self) -> Array:
        """(n, 7) position [m] and quaternion w, x, y, z of each of `joints` in the frame of its parent."""
        x = np.array([pin.SE3ToXYZQUAT(self._data.liMi[i]) for i in range(1, self._model.njoints)])
        return np.asarray(x[:, [0, 1, 2, 6, 3, 4, 5]])

    def _compute(self) -> None:
        pin.framesForwardKinematics(self._model, self._data, self._q)


class Transforms:
    """The newest transform of each frame, of tf and tf_static together."""

    def __init__(self, cameras: Iterable[CameraConfig]) -> None:
        """Know only what the surroundings say: the poses of cameras, of which the first stands for unknown frames."""
        self._fixed = {camera.frame: transform(rpy_to_matrix(*camera.rpy), camera.position) for camera in cameras
                       if not camera.mount}
        self.newest: dict[str, TransformStamped] = {}  # by frame

    def update(self, m: TFMessage) -> None:
        """Take over transforms; of too many frames those are forgotten that were told of longest ago."""
        for each in m.transforms:
            self.newest.pop(each.child_frame_id, None)
            self.newest[each.child_frame_id] = each
        for name in [*self.newest][: max(0, len(self.newest) - MAX_FRAMES)]:
            del self.newest[name]

    def pose(self, frame: str) -> Array:
        """(4, 4) T_world_frame, or what the surroundings say when transforms do not lead to world."""
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
    """A node for each joint below that of its parent, and in them the links that have a shape."""

    def __init__(
        self,
        scene: viser.SceneApi,
        root: str,
        pieces: Iterable[Piece],
        poses: LinkPoses,
        *,
        color: Rgb | None = None,
        opacity: float | None = None,
        visible: bool = True,
    ) -> None:
        """Add the links to the scene under `root`, where `poses` says, and their meshes once it is shown.

        Args:
            scene: to which they are added.
            root: name of the node above all links.
            pieces: meshes of the links.
            poses: where its links are, now and at each `follow`.
            color: replaces the colours of the pieces.
            opacity: 0 to 1; None: opaque.
            visible: whether it is shown.
        """
        self.poses = poses
        self.root = scene.add_frame(root, show_axes=False, visible=visible)
        paths, self._joints = {0: root}, []
        for name, index, parent in poses.joints:
            paths[index] = f"{paths[parent]}/{name}"
            self._joints.append(scene.add_frame(paths[index], show_axes=False))
        self._placed = np.full((len(self._joints), 7), np.nan)
        self.links: dict[str, viser.FrameHandle] = {}
        self._scene, self._color, self._opacity = scene, color, opacity
        self._undrawn = list(pieces)
        for piece in self._undrawn:
            joint, position, wxyz = poses.carrier(piece.link)
            if piece.link not in self.links:
                self.links[piece.link] = scene.add_frame(
                    f"{paths[joint]}/{piece.link}", show_axes=False, position=position, wxyz=wxyz)
        if visible:
            self._draw()
        self._place()

    @property
    def visible(self) -> bool:
        """Whether it is shown."""
        return self.root.visible

    @visible.setter
    def visible(self, on: bool) -> None:
        if on:
            self._draw()
        self.root.visible = on

    def move(self, names: Sequence[str], positions: Sequence[float]) -> None:
        """Move to joint positions [rad or m]."""
        self.poses.update(names, positions)
        self.follow()

    def follow(self) -> None:
        """Be where `poses` is by now."""
        if self.poses.moves != self._moves:
            self._place()

    def _draw(self) -> None:
        """Send the meshes, once: a browser takes its time over meshes that are hidden, too."""
        for number, piece in enumerate(self._undrawn):
            self._scene.add_mesh_simple(
                f"{self.links[piece.link].name}/{number}", piece.vertices, piece.faces,
                color=self._color or brightened(piece.color), opacity=self._opacity, cast_shadow=self._opacity is None,
                receive_shadow=self._opacity is None,
            )
        self._undrawn.clear()

    def _place(self) -> None:
        """Say only what moved: of a joint that turns just the rotation, which moves everything beyond it."""
        self._moves = self.poses.moves
        poses = self.poses.in_parents()
        moved = ~(np.abs(poses - self._placed) < _STILL)
        self._placed = poses
        for node, pose, changed in zip(self._joints, poses, moved, strict=True):
            if changed[:3].any():
                node.position = pose[:3]
            if changed[3:].any():
                node.wxyz = pose[3:]
