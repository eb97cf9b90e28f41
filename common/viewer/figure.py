"""A robot in the scene: a node for each joint below that of its parent, and in them the links that have a shape."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import viser

from common.viewer.link_poses import LinkPoses
from common.viewer.robot_meshes import Piece
from common.viewer.urdf_visuals import Rgb

_STILL = 1e-7  # [m or of a unit quaternion]


class Figure:
    """The robot as it is, or as a ghost of one colour."""

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
            poses: belongs to this figure from now on.
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

    def move(self, names: Sequence[str], positions: Sequence[float]) -> bool:
        """Move to joint positions [rad or m]; whether anything moved."""
        moved = self.poses.update(names, positions)
        if moved:
            self._place()
        return moved

    def _draw(self) -> None:
        """Send the meshes, once: a browser takes its time over meshes that are hidden, too."""
        for number, piece in enumerate(self._undrawn):
            self._scene.add_mesh_simple(
                f"{self.links[piece.link].name}/{number}", piece.vertices, piece.faces,
                color=self._color or piece.color, opacity=self._opacity, cast_shadow=False, receive_shadow=False,
            )
        self._undrawn.clear()

    def _place(self) -> None:
        """Say only what moved: of a joint that turns just the rotation, which moves everything beyond it."""
        poses = self.poses.in_parents()
        moved = ~(np.abs(poses - self._placed) < _STILL)
        self._placed = poses
        for node, pose, changed in zip(self._joints, poses, moved, strict=True):
            if changed[:3].any():
                node.position = pose[:3]
            if changed[3:].any():
                node.wxyz = pose[3:]
