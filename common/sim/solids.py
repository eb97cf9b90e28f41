"""Triangle meshes of solids for rendering: prisms, primitives, fixtures, robot links."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from common.config import Fixture
from common.robot.transforms import invert, rpy_to_matrix, transform
from common.sim.ray_caster import Mesh

if TYPE_CHECKING:  # a camera without an arm in its image loads no robot
    import coal

    from common.robot.model import RobotModel

Array = NDArray[np.float64]

RINGS = 24  # of a sphere, from pole to pole
CIRCLE_POINTS = 360  # a circle of 0.06 m is then at most 2.3 um off


def circle(radius: float) -> Array:
    """Points (N, 2) [m] on a circle about the origin, counterclockwise."""
    angles = np.linspace(0, 2 * math.pi, CIRCLE_POINTS, endpoint=False)
    return radius * np.column_stack([np.cos(angles), np.sin(angles)])


def extrude(outline: Array, hole: Array, low: float, high: float) -> Array:
    """Triangles (n, 3, 3) of a vertical prism between two heights [m] with an outline (k, 2) and an optional hole."""
    face = band_triangles(outline, hole) if len(hole) else triangulate(outline)
    parts = [_lift(face, low), _lift(face, high), _walls(outline, low, high)]
    if len(hole):
        parts.append(_walls(hole, low, high))
    return np.concatenate(parts)


def _lift(face: Array, z: float) -> Array:
    return np.concatenate([face, np.full((len(face), 3, 1), z)], axis=2)


def _walls(outline: Array, low: float, high: float) -> Array:
    a, b = outline, np.roll(outline, -1, axis=0)
    bottom, top = np.full((len(a), 1), low), np.full((len(a), 1), high)
    corners = [np.hstack(pair) for pair in ((a, bottom), (b, bottom), (b, top), (a, top))]
    return np.concatenate([np.stack([corners[0], corners[i], corners[i + 1]], axis=1) for i in (1, 2)])


def band_triangles(outline: Array, hole: Array) -> Array:
    """Triangles (n, 3, 2) of the band between two closed curves of the same orientation and start angle."""
    count = max(len(outline), len(hole))
    steps = np.arange(count + 1)
    a, b = outline[steps * len(outline) // count % len(outline)], hole[steps * len(hole) // count % len(hole)]
    first, second = np.stack([a[:-1], a[1:], b[:-1]], axis=1), np.stack([a[1:], b[1:], b[:-1]], axis=1)
    return np.concatenate([first, second])


def triangulate(outline: Array) -> Array:
    """Triangulate a simple polygon (k, 2) of either orientation by ear clipping: triangles (n, 3, 2).

    Meisters, "Polygons have ears" (1975). A convex polygon gets a fan about its center, whose triangles are less thin.
    If a polygon crosses itself, the rest without ears gets a fan about a corner.
    """
    following = np.roll(outline, -1, axis=0)
    twice_area = float(np.sum(_cross(outline, following)))
    corners = outline if twice_area > 0 else outline[::-1]
    side = np.roll(corners, -1, axis=0) - corners
    if (_cross(side, np.roll(side, -1, axis=0)) >= 0).all():
        middle = np.broadcast_to(corners.mean(axis=0), corners.shape)
        return np.stack([middle, corners, np.roll(corners, -1, axis=0)], axis=1)
    left = list(range(len(corners)))
    ears = []
    while len(left) > 3:
        ear = next((i for i in range(len(left)) if is_ear(corners, left, i)), None)
        if ear is None:
            break
        ears.append([left[ear - 1], left[ear], left[(ear + 1) % len(left)]])
        del left[ear]
    return np.asarray(corners[np.array([*ears, *([left[0], b, c] for b, c in pairwise(left[1:]))])])


def is_ear(corners: Array, left: Sequence[int], i: int) -> bool:
    """Whether corner i of the remaining polygon is an ear: convex, with no other corner inside its triangle."""
    a, b, c = corners[left[i - 1]], corners[left[i]], corners[left[(i + 1) % len(left)]]
    if _cross(b - a, c - b) <= 0:
        return False
    others = corners[[k for k in left if k not in (left[i - 1], left[i], left[(i + 1) % len(left)])]]
    least = -1e-9 * _cross(b - a, c - b)  # points on a side count as inside, despite rounding
    sides = [_cross(q - p, others - p) >= least for p, q in ((a, b), (b, c), (c, a))]
    within = sides[0] & sides[1] & sides[2]
    return not bool(within.any())


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def fixture_mesh(fixture: Fixture) -> Mesh:
    """Mesh of a fixture at its pose."""
    size = fixture.dimensions
    T = transform(rpy_to_matrix(*fixture.rpy), fixture.position)
    return Mesh(transformed(primitive(fixture.shape, size), T), fixture.color)


def primitive(shape: str, dimensions: Sequence[float]) -> Array:
    """Triangles (n, 3, 3) [m] about the origin: box (x, y, z), cylinder (radius, length along z), sphere (radius,)."""
    if shape == "box":
        x, y, z = (value / 2 for value in dimensions)
        return extrude(np.array([(-x, -y), (x, -y), (x, y), (-x, y)]), np.empty((0, 2)), -z, z)
    if shape == "cylinder":
        return extrude(circle(dimensions[0])[::4], np.empty((0, 2)), -dimensions[1] / 2, dimensions[1] / 2)
    if shape == "sphere":
        around, along = np.meshgrid(np.linspace(0, 2 * math.pi, 2 * RINGS + 1), np.linspace(0, math.pi, RINGS + 1))
        grid = dimensions[0] * np.stack(
            [np.sin(along) * np.cos(around), np.sin(along) * np.sin(around), np.cos(along)], axis=-1
        )
        a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
        return np.concatenate([np.stack(three, axis=-2).reshape(-1, 3, 3) for three in ((a, b, c), (a, c, d))])
    raise ValueError(f"no triangles for a {shape}; choices: box, cylinder, sphere")


def transformed(corners: Array, T: Array) -> Array:
    """Transform triangles (n, 3, 3) by a rigid (4, 4) transform."""
    return np.asarray(corners @ T[:3, :3].T + T[:3, 3])


# Robot links, from collision geometry

def robot_shapes(robot: RobotModel) -> dict[str, Array]:
    """Triangles (n, 3, 3) [m] of each link with a collision shape, in the frame of the link.

    Raises:
        ConfigError: a mesh is missing.
    """

    parts: dict[str, list[Array]] = {}
    for item in robot.full_geometry().geometryObjects:
        frame = robot.full_model.frames[item.parentFrame]
        T_link_shape = invert(np.array(frame.placement.homogeneous)) @ np.array(item.placement.homogeneous)
        parts.setdefault(frame.name, []).append(transformed(triangles(item.geometry), T_link_shape))
    return {link: np.concatenate(shapes) for link, shapes in parts.items()}


def triangles(shape: coal.CollisionGeometry) -> Array:
    """Triangles (n, 3, 3) [m] of one shape, about its own origin.

    Raises:
        ValueError: the shape is no mesh, box, cylinder, capsule or sphere.
    """
    import coal

    if isinstance(shape, coal.BVHModelBase):  # vertices are scaled already
        corners = [[shape.tri_indices(i)[k] for k in range(3)] for i in range(shape.num_tris)]
        return np.asarray(np.array(shape.vertices())[np.array(corners)], dtype=float)
    if isinstance(shape, coal.Box):
        return primitive("box", [2 * float(half) for half in shape.halfSide])
    if isinstance(shape, coal.Sphere):
        return primitive("sphere", [float(shape.radius)])
    if isinstance(shape, coal.Cylinder | coal.Capsule):
        radius, half = float(shape.radius), float(shape.halfLength)
        tube = primitive("cylinder", [radius, 2 * half])
        if isinstance(shape, coal.Cylinder):
            return tube
        end, up = primitive("sphere", [radius]), np.array([0.0, 0.0, half])
        return np.concatenate([tube, end + up, end - up])
    raise ValueError(f"no triangles for a {type(shape).__name__}")
