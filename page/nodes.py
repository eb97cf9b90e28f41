"""Messages as nodes of viser's scene: poses, colors, solids, lines, markers, labels.

viser takes quaternions as w, x, y, z and colors as 0 to 255. Helper nodes cast and receive no shadow: a browser without
a GPU would draw everything twice.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, TypedDict

import numpy as np
import viser
from numpy.typing import NDArray

from common.messages import CollisionObject, Color, MarkerArray, Pose, Quaternion, Vector3
from common.robot.transforms import matrix_to_quaternion, quaternion_to_matrix
from common.terminal import printable

Array = NDArray[np.float64]
Position = tuple[float, float, float]
Wxyz = tuple[float, float, float, float]
Rgb = tuple[int, int, int]
Solid = viser.BoxHandle | viser.IcosphereHandle | viser.CylinderHandle | viser.MeshHandle
Projection = Callable[[Array], Array]  # points (n, 3) [m] in world to pixels (n, 2); NaN: behind the camera


class _Shadow(TypedDict):
    cast_shadow: bool
    receive_shadow: bool


FLAT: _Shadow = {"cast_shadow": False, "receive_shadow": False}  # for helpers and transparent nodes
REAL: _Shadow = {"cast_shadow": True, "receive_shadow": True}  # for objects; free while the page has no shadows
_DARKEST, _DARK_ROBOT = 36, 64  # of 255
_CYLINDER_SIDES = 72

# --- poses and colors ---


def position_of(pose: Pose) -> Position:
    """Return the position x, y, z [m]."""
    return pose.position.x, pose.position.y, pose.position.z


def wxyz_of(pose: Pose) -> Wxyz:
    """Return the quaternion w, x, y, z of a pose message."""
    o = pose.orientation
    return o.w, o.x, o.y, o.z


def matrix_wxyz(T: Array) -> Wxyz:
    """Return the quaternion w, x, y, z of a (4, 4) pose."""
    x, y, z, w = matrix_to_quaternion(T[:3, :3])
    return w, x, y, z


def pose_from(position: Array, wxyz: Array) -> Pose:
    """Return the pose message of a node."""
    x, y, z = (float(value) for value in position)
    qw, qx, qy, qz = (float(value) for value in wxyz / np.linalg.norm(wxyz))
    return Pose(position=Vector3(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))


def points_of(poses: list[Pose]) -> Array:
    """Return the positions (n, 3) [m]."""
    return np.array([position_of(pose) for pose in poses]).reshape(-1, 3)


def rgb_of(color: Color) -> Rgb:
    """Return red, green, blue; black becomes dark gray, so that it is visible on a dark background."""
    red, green, blue = (max(_DARKEST, round(255 * value)) for value in (color.r, color.g, color.b))
    return red, green, blue


def brightened(color: Rgb) -> Rgb:
    """Return a color of a robot, brightened if it is dark, so that it is visible on a dark background."""
    r, g, b = color
    lighter = max(0, _DARK_ROBOT - max(color))
    return r + lighter, g + lighter, b + lighter


# --- solids and lines ---


def add_solid(scene: viser.SceneApi, name: str, solid: CollisionObject) -> Solid | None:
    """Add a solid of the planning scene at its pose in the parent node; return None for a degenerate prism."""
    from common.planning.prism import convex_hull  # slow to import, and needed with a scene only
    from common.sim.solids import extrude

    color, opacity = rgb_of(solid.color), solid.color.a if solid.color.a < 1 else None
    pose: dict[str, Any] = {"opacity": opacity, "position": position_of(solid.pose), "wxyz": wxyz_of(solid.pose)}
    sizes, shadow = solid.dimensions, REAL if opacity is None else FLAT
    if solid.shape == "box":  # its sides are flat without a separate shader
        return scene.add_box(name, color, (sizes[0], sizes[1], sizes[2]), flat_shading=False, **pose, **shadow)
    if solid.shape == "sphere":
        return scene.add_icosphere(name, sizes[0], color, **pose, **shadow)
    if solid.shape == "cylinder":
        return scene.add_cylinder(name, sizes[0], sizes[1], color, **pose, **shadow)
    hull = convex_hull(np.array(solid.outline))
    if len(hull) < 3:
        return None
    triangles = extrude(hull, np.empty((0, 2)), -sizes[0] / 2, sizes[0] / 2)
    return add_triangles(scene, name, triangles, color, **pose, **shadow)


def add_triangles(scene: viser.SceneApi, name: str, triangles: Array, color: Rgb, **options: Any) -> viser.MeshHandle:
    """Add triangles (n, 3, 3) [m], visible from both sides; `options` are those of viser's `add_mesh_simple`."""
    faces = np.arange(3 * len(triangles)).reshape(-1, 3)
    options = {**FLAT, **options}
    return scene.add_mesh_simple(name, triangles.reshape(-1, 3), faces, color=color, side="double", **options)


def add_line(
    scene: viser.SceneApi, name: str, points: Array, color: Rgb, thickness: float, *, closed: bool = False
) -> viser.LineSegmentsHandle:
    """Add a line through points (n, 3) [m], `thickness` pixels wide; a closed one returns to the first point."""
    through = [*points, points[0]] if closed else points
    return scene.add_line_segments(
        name, np.array(list(pairwise(through))), color, thickness=thickness, thickness_units="screen")


def tube(radius: float, height: float) -> tuple[Array, NDArray[np.int64], Array]:
    """Return vertices [m] and faces of a cylinder's wall about z, and its two rims as segments (n, 2, 3) [m].

    It has no lids: they would cover everything below, and a browser without a GPU draws them slowly.
    """
    angles = np.linspace(0, 2 * np.pi, _CYLINDER_SIDES, endpoint=False)
    circle = radius * np.column_stack([np.cos(angles), np.sin(angles)])
    low, high = (np.column_stack([circle, np.full(_CYLINDER_SIDES, z)]) for z in (-height / 2, height / 2))
    i, j = np.arange(_CYLINDER_SIDES), np.roll(np.arange(_CYLINDER_SIDES), -1)
    n = _CYLINDER_SIDES
    faces = np.concatenate([np.column_stack([i, j, j + n]), np.column_stack([i, j + n, i + n])])
    rims = [np.stack([circle3, np.roll(circle3, -1, axis=0)], axis=1) for circle3 in (low, high)]
    return np.concatenate([low, high]), faces, np.concatenate(rims)


def ring(radius: float) -> tuple[Array, NDArray[np.int64]]:
    """Return vertices [m] and faces of a flat ring about z."""
    import trimesh  # slow to import, and needed with a scene only

    mesh = trimesh.creation.torus(radius, 0.06 * radius, major_sections=32, minor_sections=6)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


# --- markers ---


class Markers:
    """The shapes of a `MarkerArray`."""

    def __init__(self, scene: viser.SceneApi, root: str) -> None:
        """Start empty, below the node `root`."""
        self._scene = scene
        self._root = root
        self.nodes: list[Any] = []
        self._shown: MarkerArray | None = None

    def show(self, m: MarkerArray) -> None:
        """Replace the displayed shapes."""
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
        pose: dict[str, Any] = {"position": position_of(marker.pose), "wxyz": wxyz_of(marker.pose)}
        style: dict[str, Any] = {"color": rgb_of(marker.color), "opacity": marker.color.a, "side": "double", **FLAT}
        size = (marker.scale.x, marker.scale.y, marker.scale.z)
        if marker.type == "cylinder":
            vertices, faces, rims = tube(size[0] / 2, size[2])
            self.nodes.append(self._scene.add_line_segments(
                f"{name}_rims", rims, style["color"], thickness=1.5, thickness_units="screen", **pose))
            return self._scene.add_mesh_simple(name, vertices, faces, **style | {"side": "back"}, **pose)
        if marker.type == "box":
            return self._scene.add_box(name, dimensions=size, flat_shading=False, **style, **pose)
        if marker.type == "sphere":
            return self._scene.add_icosphere(name, size[0] / 2, **style, **pose)
        return self._scene.add_label(name, printable(marker.text, keep="\n"), **pose)


# --- labels ---

CHAR_WIDTH, LINE_HEIGHT = 8.0, 19.0  # [px] at scale 1
_MERGE_DISTANCE = 0.03  # [m] below which labels are merged if the projection is unknown


@dataclass(eq=False)
class _Group:
    at: Array  # [m]
    corner: Array  # lower left [px]
    lines: list[str] = field(default_factory=list)

    def size(self, scale: float) -> Array:
        """Return width and height [px]."""
        return scale * np.array([CHAR_WIDTH * max(map(len, self.lines)), LINE_HEIGHT * len(self.lines)])


class Labels:
    """The labels of a layer; labels that would overlap on the screen become lines of one label."""

    def __init__(self, scene: viser.SceneApi, root: str, *, scale: float) -> None:
        """Start empty.

        Args:
            scene: to which labels are added.
            root: name of the parent node, at the origin of the world.
            scale: of the font.
        """
        self._scene, self._root, self._scale = scene, root, scale
        self._nodes: list[Any] = []

    @property
    def texts(self) -> list[str]:
        """Text of each displayed label."""
        return [node.text for node in self._nodes]

    def show(self, labels: Mapping[str, tuple[str, Array]], projection: Projection | None = None) -> None:
        """Replace the displayed labels.

        Args:
            labels: text and position (3,) [m] in world, by name.
            projection: of the camera of the browser for which labels are placed.
        """
        groups = group_labels([(printable(text), at) for text, at in labels.values()], self._scale, projection)
        while len(self._nodes) > len(groups):
            self._nodes.pop().remove()
        for number, group in enumerate(groups):
            text = "\n".join(group.lines)
            if number == len(self._nodes):
                self._nodes.append(self._scene.add_label(
                    f"{self._root}/label {number}", text, position=group.at, anchor="bottom-left",
                    font_screen_scale=self._scale))
            node = self._nodes[number]
            if node.text != text:
                node.text = text
            if np.abs(node.position - group.at).max() > 1e-3:
                node.position = group.at


def group_labels(labels: list[tuple[str, Array]], scale: float, projection: Projection | None) -> list[_Group]:
    """Merge labels that would overlap; each group is at the position of its first label."""
    if not labels:
        return []
    positions = np.array([at for _, at in labels], dtype=float)
    corners = projection(positions) if projection is not None else np.full((len(labels), 2), np.nan)
    groups = [_Group(at, corner, [text]) for (text, _), at, corner in zip(labels, positions, corners, strict=True)]
    sizes, remaining = np.array([group.size(scale) for group in groups]), np.full(len(groups), True)
    visible = np.asarray(np.isfinite(corners).all(axis=1))

    def overlapping(one: int, others: slice) -> list[int]:
        (left, bottom), (width, height) = corners[one], sizes[one]
        lefts, bottoms = corners[others].T
        widths, heights = sizes[others].T  # the y axis of the screen points down
        overlap = ((left < lefts + widths) & (lefts < left + width)
                   & (bottom - height < bottoms) & (bottoms - heights < bottom))
        near = np.linalg.norm(positions[others] - positions[one], axis=1) < _MERGE_DISTANCE
        found = np.where(visible[others] & visible[one], overlap, near)
        return [int(each) + others.start for each in np.flatnonzero(np.logical_and(remaining[others], found))]

    one = 0
    while one < len(groups):
        found = overlapping(one, slice(one + 1, len(groups))) if remaining[one] else []
        while found:
            other = found[0]
            groups[one].lines += groups[other].lines
            sizes[one], remaining[other] = groups[one].size(scale), False
            if before := overlapping(one, slice(0, one)):  # with more lines it may reach an earlier label
                one, found = before[0], [one]
            else:
                found = overlapping(one, slice(one + 1, len(groups)))
        one += 1
    return [group for group, remains in zip(groups, remaining, strict=True) if remains]


def projection_of(camera: viser.CameraHandle) -> Projection:
    """Return the projection of a browser's camera, whose z axis points forward and y axis down."""
    w, x, y, z = (float(value) for value in camera.wxyz)
    rotation, eye = quaternion_to_matrix(x, y, z, w), np.array(camera.position, float)
    height, width = float(camera.image_height), float(camera.image_width)
    focal = height / (2 * np.tan(float(camera.fov) / 2))

    def project(points: Array) -> Array:
        p = (points - eye) @ rotation
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = focal * p[:, :2] / p[:, 2:] + np.array([width / 2, height / 2])
        return np.where(p[:, 2:] > 1e-3, pixels, np.nan)

    return project
