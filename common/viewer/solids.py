"""Solids of the planning scene and of the simulated world as nodes of the scene."""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray

from common.messages import CollisionObject, WorldObject
from common.planning.prism import convex_hull
from common.robot.transforms import pose_to_matrix
from common.sim.objects import solid_of_message
from common.sim.solids import upright
from common.viewer.poses import Rgb, position_of, rgb_of, wxyz_of

_LARGER = 1.03  # a sphere is drawn a little outside of what was perceived

Solid = viser.BoxHandle | viser.IcosphereHandle | viser.CylinderHandle | viser.MeshHandle


def add_solid(scene: viser.SceneApi, name: str, solid: CollisionObject) -> Solid:
    """The node of a solid of the planning scene, in its colour, at its pose in the node above it."""
    color, opacity = rgb_of(solid.color), solid.color.a if solid.color.a < 1 else None
    position, wxyz = position_of(solid.pose), wxyz_of(solid.pose)
    sizes = solid.dimensions
    if solid.shape == "box":
        return scene.add_box(
            name, color, (sizes[0], sizes[1], sizes[2]), opacity=opacity, position=position, wxyz=wxyz,
            cast_shadow=False, receive_shadow=False, flat_shading=False,  # its sides are flat, with one shader less
        )
    if solid.shape == "sphere":
        return scene.add_icosphere(
            name, sizes[0], color, opacity=opacity, position=position, wxyz=wxyz, cast_shadow=False,
            receive_shadow=False,
        )
    if solid.shape == "cylinder":
        return scene.add_cylinder(
            name, sizes[0], sizes[1], color, opacity=opacity, position=position, wxyz=wxyz, cast_shadow=False,
            receive_shadow=False,
        )
    hull = convex_hull(np.array(solid.outline))
    triangles = upright(hull, np.empty((0, 2)), -sizes[0] / 2, sizes[0] / 2)
    return add_triangles(scene, name, triangles, color, opacity=opacity, position=position, wxyz=wxyz)


def add_triangles(
    scene: viser.SceneApi,
    name: str,
    triangles: NDArray[np.float64],
    color: Rgb,
    *,
    opacity: float | None = None,
    wireframe: bool = False,
    position: tuple[float, float, float] = (0.0, 0.0, 0.0),
    wxyz: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0),
) -> viser.MeshHandle:
    """A node of triangles (n, 3, 3) [m], seen from both sides."""
    return scene.add_mesh_simple(
        name, triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3), color=color, opacity=opacity,
        wireframe=wireframe, side="double", position=position, wxyz=wxyz, cast_shadow=False, receive_shadow=False,
    )


def add_world_object(
    scene: viser.SceneApi, name: str, thing: WorldObject, color: Rgb
) -> viser.MeshHandle | viser.IcosphereHandle:
    """An object of the simulated world as a wireframe, its node in the middle of its box."""
    if thing.shape == "sphere":
        return scene.add_icosphere(
            name, _LARGER * thing.size.x / 2, color, subdivisions=2, wireframe=True, position=middle_of(thing),
            cast_shadow=False, receive_shadow=False,
        )
    solid = solid_of_message(thing)
    triangles = solid.triangles - (solid.low + solid.high) / 2
    return add_triangles(scene, name, triangles, color, wireframe=True, position=middle_of(thing),
                         wxyz=wxyz_of(thing.pose))


def middle_of(thing: WorldObject) -> tuple[float, float, float]:
    """Middle [m], world, of the box about an object along the axes of its own frame."""
    if thing.shape in ("prism", "mesh"):
        points = np.array(thing.vertices or [(x, y, 0.0) for x, y in thing.polygon])
        x, y, z = (pose_to_matrix(thing.pose) @ np.array([*(points.min(axis=0) + points.max(axis=0)) / 2, 1.0]))[:3]
        return float(x), float(y), float(z)
    return position_of(thing.pose)
