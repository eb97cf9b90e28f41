"""Coordinate frames as tf tells them, each below the frame that it hangs on."""

from __future__ import annotations

import viser

from common.messages import TFMessage, TransformStamped
from common.viewer.poses import position_of, wxyz_of

_AXIS = 0.08  # length [m]


class Frames:
    """A node with axes and a name for each frame: moving one moves those that hang on it."""

    def __init__(self, scene: viser.SceneApi, root: str) -> None:
        """Start without any, under the node `root`, which is that of world."""
        self._scene = scene
        self._root = root
        self._waiting: dict[str, TransformStamped] = {}  # frames whose parent is not known yet
        self._parents: dict[str, str] = {}
        self._nodes: dict[str, viser.FrameHandle] = {}

    def show(self, m: TFMessage) -> None:
        """Move these frames; others stay."""
        for each in m.transforms:
            self._place(each)

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
            return self._root
        node = self._nodes.get(frame)
        return node.name if node else None

    def _add(self, name: str, parent: str, above: str) -> None:
        if name in self._nodes:  # hangs elsewhere now, and so do those that hang on it
            self._forget(name)
        node = f"{above}/{name.replace('/', '_')}"
        self._nodes[name] = self._scene.add_frame(node, axes_length=_AXIS, axes_radius=0.04 * _AXIS)
        self._scene.add_label(f"{node}/name of {len(self._nodes)}", name, font_screen_scale=0.6)
        self._parents[name] = parent
        for waiting in [w for w in self._waiting.values() if w.header.frame_id == name]:
            if self._waiting.pop(waiting.child_frame_id, None) is not None:
                self._place(waiting)

    def _forget(self, name: str) -> None:
        self._nodes[name].remove()
        below = f"{self._nodes[name].name}/"
        for frame in [frame for frame, node in self._nodes.items() if node.name.startswith(below)] + [name]:
            del self._nodes[frame], self._parents[frame]
