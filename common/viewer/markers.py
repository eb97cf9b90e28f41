"""What perception says: targets, rejections with their reason, and the bounds of the workspace."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
import viser
from numpy.typing import NDArray

from common.messages import MarkerArray, PoseArray, Rejections
from common.viewer.poses import position_of, rgb_of, wxyz_of

Array = NDArray[np.float64]

TARGET = (70, 220, 110)
REJECTED = (255, 90, 200)
_STILL = 1e-3  # [m] detections tremble by less
_SAME_PLACE = 0.03  # [m] a rejection this near to another, or to a target, is of the same thing
_FORGET_AFTER = 3_000_000_000  # [ns, cell time] without a detection there; the validator takes 2 s
_SIDES = 72  # of a cylinder
_MOST = 60  # rejections that are kept


def ring(radius: float) -> trimesh.Trimesh:
    """A flat ring about the z axis [m]."""
    mesh: trimesh.Trimesh = trimesh.creation.torus(radius, 0.06 * radius, major_sections=32, minor_sections=6)
    return mesh


def tube(radius: float, height: float) -> tuple[trimesh.Trimesh, Array]:
    """The wall of a cylinder about the z axis [m], and its two rims as segments (n, 2, 3) [m].

    Lids would veil everything below them, and a browser without a graphics card draws them slowly.
    """
    angles = np.linspace(0, 2 * np.pi, _SIDES, endpoint=False)
    circle = radius * np.column_stack([np.cos(angles), np.sin(angles)])
    low, high = (np.column_stack([circle, np.full(_SIDES, z)]) for z in (-height / 2, height / 2))
    i, j = np.arange(_SIDES), np.roll(np.arange(_SIDES), -1)
    faces = np.concatenate([np.column_stack([i, j, j + _SIDES]), np.column_stack([i, j + _SIDES, i + _SIDES])])
    rims = [np.stack([ring, np.roll(ring, -1, axis=0)], axis=1) for ring in (low, high)]
    return trimesh.Trimesh(np.concatenate([low, high]), faces, process=False), np.concatenate(rims)


class Targets:
    """A ring about each target."""

    def __init__(self, scene: viser.SceneApi, root: str, radius: float) -> None:
        """Start without any. `radius` [m] is that of the rings."""
        self._scene = scene
        self._root = root
        self._ring = ring(radius)
        # A mesh each: their shader is that of everything else, and a browser without a graphics card needs a moment
        # for one of their own.
        self._nodes: list[viser.MeshHandle] = []

    def show(self, m: PoseArray) -> None:
        """Show these targets and no others."""
        at = np.array([position_of(pose) for pose in m.poses]).reshape(-1, 3)
        while len(self._nodes) > len(at):
            self._nodes.pop().remove()
        for node, place in zip(self._nodes, at, strict=False):
            if np.abs(node.position - place).max() >= _STILL:
                node.position = place
        for place in at[len(self._nodes) :]:
            self._nodes.append(self._scene.add_mesh_simple(
                f"{self._root}/{len(self._nodes)}", self._ring.vertices, self._ring.faces, color=TARGET,
                position=place, cast_shadow=False, receive_shadow=False,
            ))


@dataclass
class _Rejected:
    at: tuple[float, float, float]
    reason: str
    seen: int  # newest time [ns] at which something was detected there
    nodes: list[viser.MeshHandle | viser.LabelHandle]


class Rejected:
    """A ring and the reason at each place from which something was rejected, until nothing is there any more."""

    def __init__(self, scene: viser.SceneApi, root: str, radius: float) -> None:
        """Start without any. `radius` [m] is that of the rings."""
        self._scene = scene
        self._root = root
        self._ring = ring(radius)
        self._known: list[_Rejected] = []
        self._count = 0

    def show(self, m: Rejections) -> None:
        """Add these; one at a known place replaces it."""
        for each in m.rejected:
            at = (each.position.x, each.position.y, each.position.z)
            self._drop([known for known in self._known if math.dist(known.at, at) < _SAME_PLACE])
            self._drop(self._known[: max(0, len(self._known) - _MOST + 1)])
            self._known.append(_Rejected(at, each.reason, m.header.stamp, self._add(at, each.reason)))

    def accept(self, m: PoseArray) -> None:
        """Forget those where a target is now."""
        targets = [position_of(pose) for pose in m.poses]
        self._drop([k for k in self._known if any(math.dist(k.at, at) < _SAME_PLACE for at in targets)])

    def look(self, m: MarkerArray) -> None:
        """Forget those where nothing has been detected for a while."""
        places = [position_of(marker.pose) for marker in m.markers]
        for known in self._known:
            if any(math.dist(known.at, at) < _SAME_PLACE for at in places):
                known.seen = m.header.stamp
        self._drop([known for known in self._known if m.header.stamp - known.seen > _FORGET_AFTER])

    def clear(self) -> None:
        """Forget all."""
        self._drop(list(self._known))

    @property
    def reasons(self) -> list[str]:
        """The reasons that are shown, oldest first."""
        return [known.reason for known in self._known]

    def _add(self, at: tuple[float, float, float], reason: str) -> list[viser.MeshHandle | viser.LabelHandle]:
        self._count += 1
        name = f"{self._root}/{self._count}"
        mesh = self._scene.add_mesh_simple(
            f"{name}_ring", self._ring.vertices, self._ring.faces, color=REJECTED, position=at, cast_shadow=False,
            receive_shadow=False,
        )
        label = self._scene.add_label(
            f"{name}_reason", reason, position=at, anchor="bottom-center", font_screen_scale=0.75
        )
        return [mesh, label]

    def _drop(self, gone: list[_Rejected]) -> None:
        for known in gone:
            self._known.remove(known)
            for node in known.nodes:
                node.remove()


class Workspace:
    """Translucent shapes, as their message has them."""

    def __init__(self, scene: viser.SceneApi, root: str) -> None:
        """Start without any."""
        self._scene = scene
        self._root = root
        self._nodes: list[Any] = []
        self._shown: MarkerArray | None = None

    def show(self, m: MarkerArray) -> None:
        """Show these shapes and no others."""
        if self._shown is not None and self._shown.markers == m.markers:
            return
        self._shown = m
        for node in self._nodes:
            node.remove()
        self._nodes = []
        for index in range(len(m.markers)):
            self._nodes.append(self._add(index))

    def _add(self, index: int) -> Any:
        assert self._shown is not None
        marker, name = self._shown.markers[index], f"{self._root}/{index}"
        place: dict[str, Any] = {"position": position_of(marker.pose), "wxyz": wxyz_of(marker.pose)}
        look: dict[str, Any] = {
            "color": rgb_of(marker.color), "opacity": marker.color.a, "side": "double", "cast_shadow": False,
            "receive_shadow": False,
        }
        size = (marker.scale.x, marker.scale.y, marker.scale.z)
        if marker.type == "cylinder":
            wall, rims = tube(size[0] / 2, size[2])
            self._nodes.append(self._scene.add_line_segments(
                f"{name}_rims", rims, look["color"], thickness=1.5, thickness_units="screen", **place
            ))
            return self._scene.add_mesh_simple(name, wall.vertices, wall.faces, **look | {"side": "back"}, **place)
        if marker.type == "box":
            return self._scene.add_box(name, dimensions=size, flat_shading=False, **look, **place)
        if marker.type == "sphere":
            return self._scene.add_icosphere(name, size[0] / 2, **look, **place)
        return self._scene.add_label(name, marker.text, **place)
