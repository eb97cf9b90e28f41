"""A robot in the scene: a node for each link that has a shape, moved by joint positions."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import viser

from common.viewer.link_poses import LinkPoses
from common.viewer.robot_meshes import Piece, Rgb


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
        """Add the meshes to the scene under `root`, where `poses` says.

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
        self.links: dict[str, viser.FrameHandle] = {}
        for number, piece in enumerate(pieces):
            if piece.link not in self.links:
                self.links[piece.link] = scene.add_frame(f"{root}/{piece.link}", show_axes=False)
            scene.add_mesh_simple(
                f"{root}/{piece.link}/{number}", piece.vertices, piece.faces, color=color or piece.color,
                opacity=opacity, cast_shadow=False, receive_shadow=False,
            )
        self._place()

    def move(self, names: Sequence[str], positions: Sequence[float]) -> bool:
        """Move to joint positions [rad or m]; whether anything moved."""
        moved = self.poses.update(names, positions)
        if moved:
            self._place()
        return moved

    def _place(self) -> None:
        for link, node in self.links.items():
            node.position, node.wxyz = self.poses.pose(link)
