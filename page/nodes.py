"""Messages as nodes of viser's scene: poses, colours, solids, lines, markers.

viser takes quaternions as w, x, y, z and colours as 0 to 255. No node casts or takes a shadow: a browser without a
graphics card would draw everything twice.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any, TypedDict

import numpy as np
import viser
from numpy.typing import NDArray

from common.messages import CollisionObject, Color, MarkerArray, Pose, Quaternion, Vector3
from common.robot.transforms import matrix_to_quaternion
from common.terminal import printable

Array = NDArray[np.float64]
Position = tuple[float, float, float]
Wxyz = tuple[float, float, float, float]
Rgb = tuple[int, int, int]
Solid = viser.BoxHandle | viser.IcosphereHandle | viser.CylinderHandle | viser.MeshHandle


class _Shade(TypedDict):
    cast_shadow: bool
    receive_shadow: bool


FLAT: _Shade = {"cast_shadow": False, "receive_shadow": False}  # signs, and what is seen through
REAL: _Shade = {"cast_shadow": True, "receive_shadow": True}  # things; without shadows on the page it costs nothing
_DARKEST, _DARK = 36, 64  # of 255
_SIDES = 72  # of a cylinder


# --- poses and colours ---


def position_of(pose: Pose) -> Position:
    """Position x, y, z [m]."""
    return pose.position.x, pose.position.y, pose.position.z


def wxyz_of(pose: Pose) -> Wxyz:
    """Quaternion w, x, y, z of a pose message."""
    o = pose.orientation
    return o.w, o.x, o.y, o.z


def matrix_wxyz(T: Array) -> Wxyz:
    """Quaternion w, x, y, z of a (4, 4) pose."""
    x, y, z, w = matrix_to_quaternion(T[:3, :3])
    return w, x, y, z


def pose_from(position: Array, wxyz: Array) -> Pose:
    """The pose message of a node of the scene."""
    x, y, z = (float(value) for value in position)
    qw, qx, qy, qz = (float(value) for value in wxyz / np.linalg.norm(wxyz))
    return Pose(position=Vector3(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))


def points_of(poses: list[Pose]) -> Array:
    """Positions (n, 3) [m]."""
    return np.array([position_of(pose) for pose in poses]).reshape(-1, 3)


def rgb_of(color: Color) -> Rgb:
    """Red, green, blue of a colour message; black is a dark grey, so as to be seen before a dark background."""
    return _seen(color.r), _seen(color.g), _seen(color.b)


def brightened(color: Rgb) -> Rgb:
    """A colour of a robot as it is drawn: what is dark throughout is lighter, so as to be seen before a dark ground."""
    r, g, b = color
    lighter = max(0, _DARK - max(color))
    return r + lighter, g + lighter, b + lighter


def _seen(value: float) -> int:
    return max(_DARKEST, round(255 * value))


# --- solids and lines ---


def add_solid(scene: viser.SceneApi, name: str, solid: CollisionObject) -> Solid | None:
    """The node of a solid of the planning scene, in its colour, at its pose in the node above it.

    None for a prism whose outline encloses nothing.
    """
    from common.planning.prism import convex_hull  # brings the collision library, which only a scene needs
    from common.sim.solids import extrude

    color, opacity = rgb_of(solid.color), solid.color.a if solid.color.a < 1 else None
    place: dict[str, Any] = {"opacity": opacity, "position": position_of(solid.pose), "wxyz": wxyz_of(solid.pose)}
    sizes, shade = solid.dimensions, REAL if opacity is None else FLAT
    if solid.shape == "box":  # its sides are flat, with one shader less
        return scene.add_box(name, color, (sizes[0], sizes[1], sizes[2]), flat_shading=False, **place, **shade)
    if solid.shape == "sphere":
        return scene.add_icosphere(name, sizes[0], color, **place, **shade)
    if solid.shape == "cylinder":
        return scene.add_cylinder(name, sizes[0], sizes[1], color, **place, **shade)
    hull = convex_hull(np.array(solid.outline))
    if len(hull) < 3:
        return None
    triangles = extrude(hull, np.empty((0, 2)), -sizes[0] / 2, sizes[0] / 2)
    return add_triangles(scene, name, triangles, color, **place, **shade)


def add_triangles(scene: viser.SceneApi, name: str, triangles: Array, color: Rgb, **options: Any) -> viser.MeshHandle:
    """A node of triangles (n, 3, 3) [m], seen from both sides; `options` are those of viser's `add_mesh_simple`."""
    faces = np.arange(3 * len(triangles)).reshape(-1, 3)
    shade: dict[str, Any] = {**FLAT, **options}
    return scene.add_mesh_simple(name, triangles.reshape(-1, 3), faces, color=color, side="double", **shade)


def add_line(
    scene: viser.SceneApi, name: str, points: Array, color: Rgb, thickness: float, *, closed: bool = False
) -> viser.LineSegmentsHandle:
    """A line through points (n, 3) [m], `thickness` pixels wide; a closed one goes back to the first."""
    through = [*points, points[0]] if closed else points
    return scene.add_line_segments(
        name, np.array(list(pairwise(through))), color, thickness=thickness, thickness_units="screen")


# --- markers ---


class Markers:
    """The shapes of a `MarkerArray`."""

    def __init__(self, scene: viser.SceneApi, root: str) -> None:
        """Start without any, below the node `root`."""
        self._scene = scene
        self._root = root
        self.nodes: list[Any] = []
        self._shown: MarkerArray | None = None

    def show(self, m: MarkerArray) -> None:
        """Show these shapes and no others."""
        if self._shown is not None and self._shown.markers == m.markers:
            return
        self._shown = m
        for node in self.nodes:
            node.remove()
        self.nodes = []
        for index in range(len(m.markers)):
            self.nodes.append(self._add(index))

    def _add(self, index: int) -> Any:
        assert self._shown is not None
        marker, name = self._shown.markers[index], f"{self._root}/{index}"
        place: dict[str, Any] = {"position": position_of(marker.pose), "wxyz": wxyz_of(marker.pose)}
        look: dict[str, Any] = {"color": rgb_of(marker.color), "opacity": marker.color.a, "side": "double", **FLAT}
        size = (marker.scale.x, marker.scale.y, marker.scale.z)
        if marker.type == "cylinder":
            vertices, faces, rims = tube(size[0] / 2, size[2])
            self.nodes.append(self._scene.add_line_segments(
                f"{name}_rims", rims, look["color"], thickness=1.5, thickness_units="screen", **place
            ))
            return self._scene.add_mesh_simple(name, vertices, faces, **look | {"side": "back"}, **place)
        if marker.type == "box":
            return self._scene.add_box(name, dimensions=size, flat_shading=False, **look, **place)
        if marker.type == "sphere":
            return self._scene.add_icosphere(name, size[0] / 2, **look, **place)
        return self._scene.add_label(name, printable(marker.text, keep="\n"), **place)


def tube(radius: float, height: float) -> tuple[Array, NDArray[np.int64], Array]:
    """The wall of a cylinder about the z axis: vertices [m] and faces; and its two rims as segments (n, 2, 3) [m].

    Lids would veil everything below them, and a browser without a graphics card draws them slowly.
    """
    angles = np.linspace(0, 2 * np.pi, _SIDES, endpoint=False)
    circle = radius * np.column_stack([np.cos(angles), np.sin(angles)])
    low, high = (np.column_stack([circle, np.full(_SIDES, z)]) for z in (-height / 2, height / 2))
    i, j = np.arange(_SIDES), np.roll(np.arange(_SIDES), -1)
    faces = np.concatenate([np.column_stack([i, j, j + _SIDES]), np.column_stack([i, j + _SIDES, i + _SIDES])])
    rims = [np.stack([ring, np.roll(ring, -1, axis=0)], axis=1) for ring in (low, high)]
    return np.concatenate([low, high]), faces, np.concatenate(rims)


def ring(radius: float) -> tuple[Array, NDArray[np.int64]]:
    """Vertices [m] and faces of a flat ring about the z axis."""
    import trimesh  # takes a third of a second, which only a scene needs

    mesh = trimesh.creation.torus(radius, 0.06 * radius, major_sections=32, minor_sections=6)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)
