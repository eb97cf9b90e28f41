"""The shapes of what can be taken and moved, whatever made them: a world's file, a request, or a message."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from common.config import ObjectConfig
from common.config.objects import Shape
from common.errors import ConfigError
from common.mesh_files import triangles_of
from common.messages import Color, Pose, Vector3, WorldObject
from common.planning.prism import convex_hull
from common.robot.transforms import matrix_to_pose, pose_to_matrix, rpy_to_matrix, transform
from common.sim.ray_caster import Mesh
from common.sim.solids import circle, placed, primitive, upright

Array = NDArray[np.float64]

MOST_TRIANGLES = 2000  # of a mesh: it travels in every message about it
LEVEL = 1 - 1e-9  # cosine of the tilt from which on something does not stand upright
NEAR = 1e-6  # [m] beyond the box about it something may still be said to meet a solid
_OFF = np.array([1.234e-7, 2.345e-7])  # [m] lines are shifted by it: they meet no edge of a shape in round numbers
_NONE = np.empty((0, 2))


@dataclass(frozen=True, eq=False)
class Solid:
    """A shape in its own frame (see ObjectConfig).

    Attributes:
        low, high: (3,) corners of the box about it [m].
        radius: of a sphere [m].
        section, hole: (N, 2) outer and inner edge of the cross-section of what is a prism along z [m], anticlockwise.
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
        """Its surface (n, 3, 3) [m]."""
        if self.shape == "sphere":
            return primitive("sphere", [self.radius])
        if self.shape == "mesh":
            return self.mesh
        return upright(self.section, self.hole, float(self.low[2]), float(self.high[2]))

    @cached_property
    def corners(self) -> Array:
        """Points (n, 3) [m] of which it is the convex hull, or more; those of a sphere are not exact."""
        if self.shape in ("sphere", "mesh"):
            return np.unique(self.triangles.reshape(-1, 3), axis=0)
        return np.concatenate([np.column_stack([self.section, np.full(len(self.section), z)])
                               for z in (self.low[2], self.high[2])])

    @cached_property
    def reach(self) -> float:
        """Distance of its farthest point from the origin of its frame [m]."""
        return self.radius if self.shape == "sphere" else float(np.linalg.norm(self.corners, axis=1).max())

    @property
    def size(self) -> Array:
        """(3,) of the box about it [m]."""
        return self.high - self.low

    def lowest(self, rotation: Array) -> float:
        """Height of its lowest point above its origin, negative below it [m], when turned by (3, 3)."""
        return -self.radius if self.shape == "sphere" else float((self.corners @ rotation[2]).min())

    def highest(self, rotation: Array) -> float:
        """Height of its highest point above its origin [m], when turned by (3, 3)."""
        return self.radius if self.shape == "sphere" else float((self.corners @ rotation[2]).max())

    def footprint(self, rotation: Array) -> Array:
        """Outline (N, 2) [m] seen from above, anticlockwise about its origin, when turned by (3, 3)."""
        if self.shape == "sphere":
            return circle(self.radius)[::10]
        if len(self.section) and abs(rotation[2, 2]) > LEVEL:
            outline = self.section @ rotation[:2, :2].T
            return outline if rotation[2, 2] > 0 else outline[::-1]
        return convex_hull((self.corners @ rotation.T)[:, :2])

    def settled(self, rotation: Array) -> Array:
        """How it lies when it was let go in that (3, 3) rotation: on the nearest of its sides."""
        if self.shape == "sphere":
            return rotation
        axis = int(np.argmax(np.abs(rotation[2])))
        side = np.zeros(3)
        side[axis] = math.copysign(1.0, rotation[2, axis])
        up = rotation @ side  # the axis of its own that points up most is made upright, on the shortest way
        turn = np.cross(up, (0.0, 0.0, 1.0))
        cross = np.array([[0, -turn[2], turn[1]], [turn[2], 0, -turn[0]], [-turn[1], turn[0], 0]])
        upright_one = rotation + (cross + cross @ cross / (1.0 + up[2])) @ rotation
        upright_one[2], upright_one[:, axis] = side, (0.0, 0.0, side[axis])
        return np.asarray(upright_one)

    def may_meet(self, T_tool_object: Array) -> bool:
        """Whether the tool's y axis meets the box about it, by the slab method; else it meets nothing of the solid."""
        way, origin = T_tool_object[1, :3], -T_tool_object[:3, 3] @ T_tool_object[:3, :3]
        way = np.where(np.abs(way) < 1e-12, 1e-12, way)
        first, second = (self.low - NEAR - origin) / way, (self.high + NEAR - origin) / way
        return bool(np.minimum(first, second).max() <= np.maximum(first, second).min())

    def spans(self, T_tool_object: Array, lines: Array) -> list[Array]:
        """Where lines along the tool's y axis, through (k, 2) places x, z [m], run within it: (n, 2) y [m] of each.

        Of a mesh, which need not be closed, from the first to the last point. What is last in the list are the ends
        of what of its edges lies among the lines.
        """
        surface = placed(self.triangles, T_tool_object)
        corners, flat = surface, surface[..., [0, 2]]
        wanted = lines + _OFF
        near = ((flat.max(axis=1) >= wanted.min(axis=0)) & (flat.min(axis=1) <= wanted.max(axis=0))).all(axis=1)
        corners, flat = corners[near], flat[near]
        a, first, second = flat[:, 0], flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
        area = _cross(first, second)
        good = np.abs(area) > 1e-15
        corners, a, first, second, area = corners[good], a[good], first[good], second[good], area[good]
        way = wanted[:, None] - a
        u, v = _cross(way, second) / area, _cross(first, way) / area
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
    """y (n,) [m] of the ends of what of the edges between points (m, 3) lies between two corners (x, z) [m].

    Liang and Barsky, "A new concept and method for line clipping" (1984).
    """
    way = end - start
    enter, leave = np.zeros(len(start)), np.ones(len(start))
    for axis, bottom, top in ((0, low[0], high[0]), (2, low[1], high[1])):
        flat = np.abs(way[:, axis]) < 1e-12
        slope = np.where(flat, 1.0, way[:, axis])
        s, t = (bottom - start[:, axis]) / slope, (top - start[:, axis]) / slope
        within = (start[:, axis] >= bottom) & (start[:, axis] <= top)
        enter = np.maximum(enter, np.where(flat, np.where(within, 0.0, 2.0), np.minimum(s, t)))
        leave = np.minimum(leave, np.where(flat, 1.0, np.maximum(s, t)))
    some = enter <= leave
    return np.concatenate([(start[:, 1] + share * way[:, 1])[some] for share in (enter, leave)])


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def solid_of(thing: ObjectConfig) -> Solid:
    """The shape that the configuration describes.

    Raises:
        ConfigError: the file of a mesh cannot be read.
    """
    if thing.shape == "mesh":
        return mesh(load_mesh(thing.id, Path(thing.mesh), thing.scale))
    across = 2 * (thing.radius or 0.0)
    x, y = (thing.size or (across, across))[:2]
    return make_solid(thing.shape, Vector3(x=x, y=y, z=thing.height or 0.0), thing.inner_radius or 0.0, thing.polygon)


def sphere(radius: float) -> Solid:
    """A sphere about its origin."""
    return Solid("sphere", np.full(3, -radius), np.full(3, radius), radius=radius)


def cylinder_or_ring(shape: Shape, radius: float, inner_radius: float, height: float) -> Solid:
    """A cylinder, or a ring with an inner radius, along z [m]."""
    hole = circle(inner_radius) if shape == "ring" else _NONE
    size = np.array([radius, radius, height / 2])
    return Solid(shape, -size, size, inner_radius=inner_radius, section=circle(radius), hole=hole)


def prism(shape: Shape, polygon: Array, height: float) -> Solid:
    """A prism along z with this cross-section (N, 2) [m], either way round; a box is one."""
    x, y = polygon.T
    section = polygon if float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)) > 0 else polygon[::-1]
    low, high = section.min(axis=0), section.max(axis=0)
    return Solid(shape, np.array([*low, -height / 2]), np.array([*high, height / 2]), section=section)


def mesh(triangles: Array) -> Solid:
    """A mesh of triangles (n, 3, 3) [m]."""
    points = triangles.reshape(-1, 3)
    return Solid("mesh", points.min(axis=0), points.max(axis=0), mesh=triangles)


def load_mesh(name: str, path: Path, scale: float) -> Array:
    """Triangles (n, 3, 3) [m] of a file, scaled.

    Raises:
        ConfigError: it cannot be read, or has too many triangles.
    """
    triangles = scale * triangles_of(f"world.objects.{name}.mesh", path)
    if len(triangles) > MOST_TRIANGLES:
        raise ConfigError(f"world.objects.{name}.mesh", str(path),
                          f"has {len(triangles)} triangles; at most {MOST_TRIANGLES} can be simulated: simplify it")
    return triangles


def initial_pose(thing: ObjectConfig, solid: Solid) -> Array:
    """(4, 4) T_world_object at the start."""
    if thing.position is not None:
        return transform(rpy_to_matrix(*thing.rpy), thing.position)
    height = thing.z - float(solid.low[2])
    return transform(rpy_to_matrix(0.0, 0.0, thing.yaw), (thing.x or 0.0, thing.y or 0.0, height))


def object_message(
    name: str, solid: Solid, T: Array, color: Sequence[float], *, state: str = "table", container: str = ""
) -> WorldObject:
    """The solid at a (4, 4) pose as a message."""
    vertices: list[tuple[float, float, float]] = []
    triangles: list[tuple[int, int, int]] = []
    if solid.shape == "mesh":
        points, index = np.unique(solid.mesh.reshape(-1, 3), axis=0, return_inverse=True)
        vertices = [(x, y, z) for x, y, z in points.tolist()]
        triangles = [(a, b, c) for a, b, c in index.reshape(-1, 3).tolist()]
    stands = len(solid.section) > 0 and T[2, 2] > LEVEL and state not in ("held", "falling")
    at, turn = T[:2, 3], T[:2, :2].T
    size = solid.size
    return WorldObject.model_validate({
        "id": name, "shape": solid.shape,
        "pose": Pose(position=_vector(T[:3, 3])) if solid.shape == "sphere" else matrix_to_pose(T),
        "size": _vector(size), "inner_radius": solid.inner_radius,
        "polygon": solid.section.tolist() if solid.shape == "prism" else [],
        "vertices": vertices, "triangles": triangles,
        "color": Color(r=color[0], g=color[1], b=color[2]), "state": state, "container": container,
        "outline": (solid.section @ turn + at).tolist() if stands else [],
        "hole": (solid.hole @ turn + at).tolist() if stands else [],
        "base": float(T[2, 3] + solid.low[2]) if stands else 0.0, "height": float(size[2]) if stands else 0.0,
    })


def world_object(thing: ObjectConfig) -> WorldObject:
    """The object of a world's file as it lies at the start."""
    solid = solid_of(thing)
    return object_message(thing.id, solid, initial_pose(thing, solid), thing.color)


def solid_of_message(thing: WorldObject) -> Solid:
    """The shape that a message describes."""
    if thing.shape == "mesh":
        return mesh(np.array(thing.vertices, float)[np.array(thing.triangles, int)].reshape(-1, 3, 3))
    return make_solid(thing.shape, thing.size, thing.inner_radius, thing.polygon)


def make_solid(shape: Shape, size: Vector3, inner_radius: float, polygon: Sequence[tuple[float, float]]) -> Solid:
    """A solid that is no mesh, by the size of the box about it, and what else its shape needs."""
    if shape == "sphere":
        return sphere(size.x / 2)
    if shape in ("cylinder", "ring"):
        return cylinder_or_ring(shape, size.x / 2, inner_radius, size.z)
    x, y = size.x / 2, size.y / 2
    return prism(shape, np.array([(-x, -y), (x, -y), (x, y), (-x, y)] if shape == "box" else polygon), size.z)


def appearance_of(thing: WorldObject) -> tuple[object, ...]:
    """What tells its shape and colour from others, wherever it is."""
    size, color = thing.size, thing.color
    sizes = tuple(round(value, 7) for value in (size.x, size.y, size.z, thing.inner_radius))
    polygon = tuple((round(x, 7), round(y, 7)) for x, y in thing.polygon)
    return (thing.shape, sizes, polygon, tuple(thing.vertices), tuple(thing.triangles), color.r, color.g, color.b)


def object_mesh(thing: WorldObject) -> Mesh:
    """Its surface in world, in its colour."""
    T = pose_to_matrix(thing.pose)
    return Mesh(placed(solid_of_message(thing).triangles, T), (thing.color.r, thing.color.g, thing.color.b))


def centre_of(thing: WorldObject) -> tuple[float, float, float]:
    """Middle [m] of the box about an object: of its outline when it stands upright, else of its own box."""
    if thing.outline:
        outline = np.array(thing.outline)
        x, y = (outline.min(axis=0) + outline.max(axis=0)) / 2
        return float(x), float(y), thing.base + thing.height / 2
    p = thing.pose.position
    return p.x, p.y, p.z


def _vector(values: Array) -> Vector3:
    x, y, z = (float(value) for value in values)
    return Vector3(x=x, y=y, z=z)
