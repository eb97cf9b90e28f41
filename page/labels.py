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
    sizes, there = np.array([group.size(scale) for group in groups]), np.full(len(groups), True)
    seen = np.asarray(np.isfinite(corners).all(axis=1))

    def meeting(one: int, others: slice) -> list[int]:
        """Those of the others that one label would lie over."""
        (left, low), (width, height) = corners[one], sizes[one]
        lefts, lows = corners[others].T
        widths, heights = sizes[others].T
        over = (left < lefts + widths) & (lefts < left + width) & (low - height < lows) & (lows - heights < low)  # down
        near = np.linalg.norm(places[others] - places[one], axis=1) < _NEAR
        lies = np.where(seen[others] & seen[one], over, near)
        return [int(each) + others.start for each in np.flatnonzero(np.logical_and(there[others], lies))]

    one = 0
    while one < len(groups):
        found = meeting(one, slice(one + 1, len(groups))) if there[one] else []
        while found:
            other = found[0]
            groups[one].words += groups[other].words
            sizes[one], there[other] = groups[one].size(scale), False
            # With more lines it may reach what it did not before.
            if before := meeting(one, slice(0, one)):
                one, found = before[0], [one]
            else:
                found = meeting(one, slice(one + 1, len(groups)))
        one += 1
    return [group for group, kept in zip(groups, there, strict=True) if kept]


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
