"""Shapes of movable objects, created from a world file, an edit request or a message."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from common.config import ObjectConfig
from common.config.world import Shape
from common.errors import ConfigError
from common.messages import Color, Pose, Vector3, WorldObject
from common.planning.prism import convex_hull
from common.robot.mesh_files import triangles_of
from common.robot.transforms import matrix_to_pose, pose_to_matrix, rpy_to_matrix, transform
from common.sim.ray_caster import Mesh
from common.sim.solids import circle, extrude, primitive, transformed

Array = NDArray[np.float64]

MAX_TRIANGLES = 2000  # of a mesh: every message about it carries them
UPRIGHT = 1 - 1e-9  # cosine of the largest tilt of an extrude object
SLACK = 1e-6  # [m] tolerance of the bounding box test
_OFF = np.array([1.234e-7, 2.345e-7])  # [m] shifts lines off edges at round coordinates
_NONE = np.empty((0, 2))

Indexed = tuple[list[tuple[float, float, float]], list[tuple[int, int, int]]]
_NO_MESH: Indexed = ([], [])


@dataclass(frozen=True, eq=False)
class Solid:
    """A shape in its own frame (see ObjectConfig).

    Attributes:
        low, high: (3,) corners of the bounding box [m].
        radius: of a sphere [m].
        section, hole: (N, 2) outer and inner edge of the cross-section of a prism along z [m], counterclockwise.
        mesh: (n, 3, 3) triangles of a mesh [m].
    """

    shape: Shape
    low: Array
    high: Array
    radius: float = 0.0
    inner_radius: float = 0.0
    section: Array = field(default_factory=lambda: _NONE)
    hole: Array = field(default_factory=lambda: _NONE)
    mesh: Array = field(default_factory=lambda: np.empty((0, 3, 3)))

    @cached_property
    def triangles(self) -> Array:
        """Surface (n, 3, 3) [m]."""
        if self.shape == "sphere":
            return primitive("sphere", [self.radius])
        if self.shape == "mesh":
            return self.mesh
        return extrude(self.section, self.hole, float(self.low[2]), float(self.high[2]))

    @cached_property
    def corners(self) -> Array:
        """Points (n, 3) [m] whose convex hull contains the solid; approximate for a sphere."""
        if self.shape in ("sphere", "mesh"):
            return np.unique(self.triangles.reshape(-1, 3), axis=0)
        return np.concatenate([np.column_stack([self.section, np.full(len(self.section), z)])
                               for z in (self.low[2], self.high[2])])

    @cached_property
    def indexed(self) -> Indexed:
        """Distinct corners [m] of a mesh, and the indices of those of each triangle, as in messages."""
        points, index = np.unique(self.mesh.reshape(-1, 3), axis=0, return_inverse=True)
        return [(x, y, z) for x, y, z in points.tolist()], [(a, b, c) for a, b, c in index.reshape(-1, 3).tolist()]

    @cached_property
    def reach(self) -> float:
        """Distance of the farthest point from the origin [m]."""
        return self.radius if self.shape == "sphere" else float(np.linalg.norm(self.corners, axis=1).max())

    @property
    def size(self) -> Array:
        """(3,) of the bounding box [m]."""
        return self.high - self.low

    def lowest(self, rotation: Array) -> float:
        """Height of the lowest point relative to the origin [m] under a rotation (3, 3)."""
        return -self.radius if self.shape == "sphere" else float((self.corners @ rotation[2]).min())

    def highest(self, rotation: Array) -> float:
        """Height of the highest point relative to the origin [m] under a rotation (3, 3)."""
        return self.radius if self.shape == "sphere" else float((self.corners @ rotation[2]).max())

    def footprint(self, rotation: Array) -> Array:
        """Counterclockwise outline (N, 2) [m] seen from above, about the origin, under a rotation (3, 3)."""
        if self.shape == "sphere":
            return circle(self.radius)[::10]
        if len(self.section) and abs(rotation[2, 2]) > UPRIGHT:
            outline = self.section @ rotation[:2, :2].T
            return outline if rotation[2, 2] > 0 else outline[::-1]
        return convex_hull((self.corners @ rotation.T)[:, :2])

    def settled(self, rotation: Array) -> Array:
        """Rotation (3, 3) after it tips from a rotation onto its nearest side."""
        if self.shape == "sphere":
            return rotation
        axis = int(np.argmax(np.abs(rotation[2])))
        side = np.zeros(3)
        side[axis] = math.copysign(1.0, rotation[2, axis])
        up = rotation @ side  # turn the body axis nearest to vertical upright by the smallest rotation
        turn = np.cross(up, (0.0, 0.0, 1.0))
        cross = np.array([[0, -turn[2], turn[1]], [turn[2], 0, -turn[0]], [-turn[1], turn[0], 0]])
        result = rotation + (cross + cross @ cross / (1.0 + up[2])) @ rotation
        result[2], result[:, axis] = side, (0.0, 0.0, side[axis])
        return np.asarray(result)

    def may_meet(self, T_tool_object: Array) -> bool:
        """Whether the tool's y axis meets the bounding box (slab method); necessary for contact."""
        direction, origin = T_tool_object[1, :3], -T_tool_object[:3, 3] @ T_tool_object[:3, :3]
        direction = np.where(np.abs(direction) < 1e-12, 1e-12, direction)
        first, second = (self.low - SLACK - origin) / direction, (self.high + SLACK - origin) / direction
        return bool(np.minimum(first, second).max() <= np.maximum(first, second).min())

    def spans(self, T_tool_object: Array, lines: Array) -> list[Array]:
        """Intervals (n, 2) y [m] inside the solid of lines along the tool's y axis through (k, 2) positions x, z [m].

        A mesh may be open: its interval runs from the first to the last intersection. The last list entry holds the end
        points of the edges, clipped to the region of the lines.
        """
        surface = transformed(self.triangles, T_tool_object)
        corners, flat = surface, surface[..., [0, 2]]
        targets = lines + _OFF
        near = ((flat.max(axis=1) >= targets.min(axis=0)) & (flat.min(axis=1) <= targets.max(axis=0))).all(axis=1)
        corners, flat = corners[near], flat[near]
        a, first, second = flat[:, 0], flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
        area = _cross(first, second)
        valid = np.abs(area) > 1e-15
        corners, a, first, second, area = corners[valid], a[valid], first[valid], second[valid], area[valid]
        direction = targets[:, None] - a
        u, v = _cross(direction, second) / area, _cross(first, direction) / area
        met = (u >= 0) & (v >= 0) & (u + v <= 1)
        y = corners[:, 0, 1] + u * (corners[:, 1, 1] - corners[:, 0, 1]) + v * (corners[:, 2, 1] - corners[:, 0, 1])
        found = []
        for ys, hit in zip(y, met, strict=True):
            crossed = np.sort(ys[hit])
            if self.shape == "mesh" or len(crossed) % 2:
                crossed = crossed[[0, -1]] if len(crossed) else crossed
            found.append(crossed.reshape(-1, 2))
        start = surface[near].reshape(-1, 3)
        y = _clipped(start, np.roll(surface[near], -1, axis=1).reshape(-1, 3), lines.min(axis=0), lines.max(axis=0))
        return [*found, np.repeat(y[:, None], 2, axis=1)]


def _clipped(start: Array, end: Array, low: Array, high: Array) -> Array:
    """y (n,) [m] of both ends of the edges between points (m, 3), clipped between two corners (x, z) [m].

    Liang and Barsky, "A new concept and method for line clipping" (1984).
    """
    direction = end - start
    enter, leave = np.zeros(len(start)), np.ones(len(start))
    for axis, bottom, top in ((0, low[0], high[0]), (2, low[1], high[1])):
        flat = np.abs(direction[:, axis]) < 1e-12
        slope = np.where(flat, 1.0, direction[:, axis])
        s, t = (bottom - start[:, axis]) / slope, (top - start[:, axis]) / slope
        within = (start[:, axis] >= bottom) & (start[:, axis] <= top)
        enter = np.maximum(enter, np.where(flat, np.where(within, 0.0, 2.0), np.minimum(s, t)))
        leave = np.minimum(leave, np.where(flat, 1.0, np.maximum(s, t)))
    entering = enter <= leave
    return np.concatenate([(start[:, 1] + fraction * direction[:, 1])[entering] for fraction in (enter, leave)])


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def solid_of(obj: ObjectConfig) -> Solid:
    """Return the shape of a configured object.

    Raises:
        ConfigError: a mesh file cannot be read.
    """
    if obj.shape == "mesh":
        return mesh(load_mesh(obj.id, Path(obj.mesh), obj.scale))
    across = 2 * (obj.radius or 0.0)
    x, y = (obj.size or (across, across))[:2]
    return make_solid(obj.shape, Vector3(x=x, y=y, z=obj.height or 0.0), obj.inner_radius or 0.0, obj.polygon)


def sphere(radius: float) -> Solid:
    """Return a sphere about the origin."""
    return Solid("sphere", np.full(3, -radius), np.full(3, radius), radius=radius)


def cylinder_or_ring(shape: Shape, radius: float, inner_radius: float, height: float) -> Solid:
    """Return a cylinder, or a ring with an inner radius, along z [m]."""
    hole = circle(inner_radius) if shape == "ring" else _NONE
    size = np.array([radius, radius, height / 2])
    return Solid(shape, -size, size, inner_radius=inner_radius, section=circle(radius), hole=hole)


def prism(shape: Shape, polygon: Array, height: float) -> Solid:
    """Return a prism along z with a cross-section (N, 2) [m] of either orientation; boxes too."""
    x, y = polygon.T
    section = polygon if float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)) > 0 else polygon[::-1]
    low, high = section.min(axis=0), section.max(axis=0)
    return Solid(shape, np.array([*low, -height / 2]), np.array([*high, height / 2]), section=section)


def mesh(triangles: Array) -> Solid:
    """Return a solid of triangles (n, 3, 3) [m]."""
    points = triangles.reshape(-1, 3)
    return Solid("mesh", points.min(axis=0), points.max(axis=0), mesh=triangles)


def load_mesh(name: str, path: Path, scale: float) -> Array:
    """Load scaled triangles (n, 3, 3) [m] from a file.

    Raises:
        ConfigError: the file cannot be read, has no extent, or too many triangles.
    """
    from common.robot.collision_shapes import solid

    field = f"world.objects.{name}.mesh"
    triangles = solid(scale * triangles_of(field, path), field, path)
    if len(triangles) > MAX_TRIANGLES:
        raise ConfigError(field, str(path),
                          f"has {len(triangles)} triangles; at most {MAX_TRIANGLES} can be simulated: simplify it")
    return triangles


def initial_pose(obj: ObjectConfig, solid: Solid) -> Array:
    """(4, 4) T_world_object at the start."""
    if obj.position is not None:
        return transform(rpy_to_matrix(*obj.rpy), obj.position)
    height = obj.z - float(solid.low[2])
    return transform(rpy_to_matrix(0.0, 0.0, obj.yaw), (obj.x or 0.0, obj.y or 0.0, height))


def object_message(
    name: str, solid: Solid, T: Array, color: Sequence[float], *, state: str = "table", container: str = ""
) -> WorldObject:
    """Return the message of a solid at a (4, 4) pose."""
    vertices, triangles = _NO_MESH
    if solid.shape == "mesh":
        vertices, triangles = solid.indexed
    is_upright = len(solid.section) > 0 and T[2, 2] > UPRIGHT and state not in ("held", "falling")
    at, turn = T[:2, 3], T[:2, :2].T
    size = solid.size
    return WorldObject.model_validate({
        "id": name, "shape": solid.shape,
        "pose": Pose(position=_vector(T[:3, 3])) if solid.shape == "sphere" else matrix_to_pose(T),
        "size": _vector(size), "inner_radius": solid.inner_radius,
        "polygon": solid.section.tolist() if solid.shape == "prism" else [],
        "vertices": vertices, "triangles": triangles,
        "color": Color(r=color[0], g=color[1], b=color[2]), "state": state, "container": container,
        "outline": (solid.section @ turn + at).tolist() if is_upright else [],
        "hole": (solid.hole @ turn + at).tolist() if is_upright else [],
        "base": float(T[2, 3] + solid.low[2]) if is_upright else 0.0, "height": float(size[2]) if is_upright else 0.0,
    })


def world_object(obj: ObjectConfig) -> WorldObject:
    """Return the message of a configured object at its initial pose."""
    solid = solid_of(obj)
    return object_message(obj.id, solid, initial_pose(obj, solid), obj.color)


def solid_of_message(obj: WorldObject) -> Solid:
    """Return the shape that a message describes."""
    if obj.shape == "mesh":
        return mesh(np.array(obj.vertices, float)[np.array(obj.triangles, int)].reshape(-1, 3, 3))
    return make_solid(obj.shape, obj.size, obj.inner_radius, obj.polygon)


def make_solid(shape: Shape, size: Vector3, inner_radius: float, polygon: Sequence[tuple[float, float]]) -> Solid:
    """Return a solid that is no mesh, from its bounding box and shape-specific values."""
    if shape == "sphere":
        return sphere(size.x / 2)
    if shape in ("cylinder", "ring"):
        return cylinder_or_ring(shape, size.x / 2, inner_radius, size.z)
    x, y = size.x / 2, size.y / 2
    return prism(shape, np.array([(-x, -y), (x, -y), (x, y), (-x, y)] if shape == "box" else polygon), size.z)


def appearance_of(obj: WorldObject) -> tuple[object, ...]:
    """Return a hashable key of shape and color, independent of the pose."""
    size, color = obj.size, obj.color
    sizes = tuple(round(value, 7) for value in (size.x, size.y, size.z, obj.inner_radius))
    polygon = tuple((round(x, 7), round(y, 7)) for x, y in obj.polygon)
    return (obj.shape, sizes, polygon, tuple(obj.vertices), tuple(obj.triangles), color.r, color.g, color.b)


def object_mesh(obj: WorldObject) -> Mesh:
    """Return its colored surface in world."""
    T = pose_to_matrix(obj.pose)
    return Mesh(transformed(solid_of_message(obj).triangles, T), (obj.color.r, obj.color.g, obj.color.b))


def centre_of(obj: WorldObject) -> tuple[float, float, float]:
    """Center [m] of the bounding box: of the outline if upright, else the origin of its frame."""
    if obj.outline:
        outline = np.array(obj.outline)
        x, y = (outline.min(axis=0) + outline.max(axis=0)) / 2
        return float(x), float(y), obj.base + obj.height / 2
    p = obj.pose.position
    return p.x, p.y, p.z


def _vector(values: Array) -> Vector3:
    x, y, z = (float(value) for value in values)
    return Vector3(x=x, y=y, z=z)
