"""Words in the scene that do not lie over one another: those that would are lines of one label."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from common.terminal import printable

Array = NDArray[np.float64]
View = Callable[[Array], Array]  # points (n, 3) [m] in world to where they are seen (n, 2) [px]; NaN: they are not

LETTER, LINE = 8.0, 19.0  # [px] of a letter at scale 1, and of a line of them
_NEAR = 0.03  # [m] at which labels become one where nobody says how the scene is seen


@dataclass(eq=False)
class _Group:
    at: Array  # [m]
    corner: Array  # [px] lower left
    words: list[str] = field(default_factory=list)

    def size(self, scale: float) -> Array:
        """Width and height [px]."""
        return scale * np.array([LETTER * max(map(len, self.words)), LINE * len(self.words)])


class Labels:
    """The labels of a layer, each with a name by which it is known."""

    def __init__(self, scene: viser.SceneApi, root: str, *, scale: float) -> None:
        """Start without any.

        Args:
            scene: to which they are added.
            root: name of the node above, which stands at the origin of world.
            scale: of the letters.
        """
        self._scene, self._root, self._scale = scene, root, scale
        self._nodes: list[Any] = []

    @property
    def texts(self) -> list[str]:
        """What is written, label by label."""
        return [node.text for node in self._nodes]

    def show(self, wanted: Mapping[str, tuple[str, Array]], view: View | None = None) -> None:
        """Show these and no others.

        Args:
            wanted: text and place (3,) [m] in world of each.
            view: how the scene is seen by who looks.
        """
        groups = grouped([(printable(text), at) for text, at in wanted.values()], self._scale, view)
        while len(self._nodes) > len(groups):
            self._nodes.pop().remove()
        for number, group in enumerate(groups):
            text = "\n".join(group.words)
            if number == len(self._nodes):
                self._nodes.append(self._scene.add_label(
                    f"{self._root}/words {number}", text, position=group.at, anchor="bottom-left",
                    font_screen_scale=self._scale))
            node = self._nodes[number]
            if node.text != text:
                node.text = text
            if np.abs(node.position - group.at).max() > 1e-3:
                node.position = group.at


def grouped(labels: list[tuple[str, Array]], scale: float, view: View | None) -> list[_Group]:
    """Labels that would overlap put together, in their order, each group where its first is."""
    if not labels:
        return []
    places = np.array([at for _, at in labels], dtype=float)
    corners = view(places) if view is not None else np.full((len(labels), 2), np.nan)
    groups = [_Group(at, corner, [text]) for (text, _), at, corner in zip(labels, places, corners, strict=True)]
    merged = True
    while merged:  # a label with more lines may reach what it did not before
        merged = False
        for i, one in enumerate(groups):
            for other in groups[i + 1:]:
                if _meet(one, other, scale):
                    one.words += other.words
                    groups.remove(other)
                    merged = True
                    break
            if merged:
                break
    return groups


def _meet(one: _Group, other: _Group, scale: float) -> bool:
    if not (np.isfinite(one.corner).all() and np.isfinite(other.corner).all()):
        return bool(np.linalg.norm(one.at - other.at) < _NEAR)
    (left, low), (width, height) = one.corner, one.size(scale)
    (left2, low2), (width2, height2) = other.corner, other.size(scale)  # pixels count downwards
    return bool(left < left2 + width2 and left2 < left + width and low - height < low2 and low2 - height2 < low)


def view_of(camera: viser.CameraHandle) -> View:
    """How a camera of a browser sees the scene: forwards is its z axis, downwards its y axis."""
    from common.robot.transforms import quaternion_to_matrix

    w, x, y, z = (float(value) for value in camera.wxyz)
    rotation, eye = quaternion_to_matrix(x, y, z, w), np.array(camera.position, float)
    height, width = float(camera.image_height), float(camera.image_width)
    focal = height / (2 * np.tan(float(camera.fov) / 2))

    def seen(points: Array) -> Array:
        p = (points - eye) @ rotation
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = focal * p[:, :2] / p[:, 2:] + np.array([width / 2, height / 2])
        return np.where(p[:, 2:] > 1e-3, pixels, np.nan)

    return seen
