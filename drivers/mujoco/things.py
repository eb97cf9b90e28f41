"""Objects in a model: free bodies with the mass and the shape that they have."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from common.sim.footprints import convex_parts
from common.sim.objects import Solid
from drivers.mujoco.contact import THING, touches

Array = NDArray[np.float64]

RING_PIECES = 16  # convex pieces of a ring
USUAL_MASS = 0.1  # [kg] where nobody says


@dataclass(frozen=True, eq=False)
class Thing:
    """An object: its shape in its own frame, its colour and its mass [kg]."""

    id: str
    solid: Solid
    color: tuple[float, float, float]
    mass: float = USUAL_MASS


def add_thing(spec: mujoco.MjSpec, thing: Thing) -> None:
    """Put an object into a model: a free body `thing:ID` at the origin."""
    body = spec.worldbody.add_body(name=f"thing:{thing.id}")
    body.add_freejoint(name=f"thing:{thing.id}")
    geoms = _geoms(spec, body, thing)
    volume = sum(volume for _, volume in geoms)
    for geom, part in geoms:
        geom.mass = thing.mass * part / volume
        geom.rgba = [*thing.color, 1.0]
        touches(geom, THING)


def _geoms(spec: mujoco.MjSpec, body: Any, thing: Thing) -> list[tuple[Any, float]]:
    """Convex geoms, each with its volume [m^3]."""
    solid, kinds = thing.solid, mujoco.mjtGeom
    if solid.shape == "sphere":
        return [(body.add_geom(type=kinds.mjGEOM_SPHERE, size=[solid.radius, 0.0, 0.0]), 1.0)]
    if solid.shape in ("box", "cylinder"):
        size, middle = solid.size / 2, (solid.low + solid.high) / 2
        if solid.shape == "box":
            return [(body.add_geom(type=kinds.mjGEOM_BOX, size=size, pos=middle), 1.0)]
        return [(body.add_geom(type=kinds.mjGEOM_CYLINDER, size=[size[0], size[2], 0.0], pos=middle), 1.0)]
    made = []
    for number, points in enumerate(convex_pieces(solid)):
        mesh = spec.add_mesh(name=f"thing:{thing.id}.{number}")
        mesh.uservert = points.ravel()
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
        made.append((body.add_geom(type=kinds.mjGEOM_MESH, meshname=mesh.name), _volume(points)))
    return made


def convex_pieces(solid: Solid) -> list[Array]:
    """Points (n, 3) [m] of convex pieces of a solid.

    A prism is cut into triangles where it is not convex, a ring into wedges; of a mesh each connected part is taken for
    its convex hull.
    """
    if solid.shape == "mesh":
        return _connected(solid.mesh)
    heights = np.array([solid.low[2], solid.high[2]])
    if solid.shape == "ring":
        outer, inner = float(solid.high[0]), solid.inner_radius
        angles = np.linspace(0.0, 2 * math.pi, RING_PIECES + 1)
        sections = []
        for a, b in pairwise(angles):
            way = np.array([[math.cos(t), math.sin(t)] for t in (a, (a + b) / 2, b)])
            sections.append(np.concatenate([outer * way, inner * way[::-2]]))
    else:
        sections = [np.asarray(part) for part in convex_parts(solid.section)]
    return [np.concatenate([np.column_stack([section, np.full(len(section), z)]) for z in heights])
            for section in sections]


def _connected(triangles: Array) -> list[Array]:
    """Points (n, 3) of each connected part of triangles (n, 3, 3)."""
    points, corners = np.unique(triangles.reshape(-1, 3), axis=0, return_inverse=True)
    corners = corners.reshape(-1, 3)
    lowest = np.arange(len(points))
    while True:
        least = lowest[corners].min(axis=1)
        before = lowest.copy()
        for column in range(3):
            np.minimum.at(lowest, corners[:, column], least)
        if (lowest == before).all():
            break
    return [part for label in np.unique(lowest) if len(part := points[lowest == label]) >= 4]


def _volume(points: Array) -> float:
    """About that of what is convex [m^3]: a share of the box about it is enough to part a mass."""
    return float(np.prod(np.maximum(np.ptp(points, axis=0), 1e-6)))
