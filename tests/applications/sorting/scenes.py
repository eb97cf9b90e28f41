"""Synthetic scenes of the tray: solids that are rendered with the errors of a structured light camera."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from applications.sorting.clusters import Labels, find_objects
from applications.sorting.detector import AROUND, area_around
from applications.sorting.places import containers_of
from applications.sorting.seeing import Area, View, surface_of
from applications.sorting.surface import Surface
from applications.sorting.topics import SeenObject
from common.config import World, parse_yaml
from common.perception.pinhole import Pinhole
from common.robot.transforms import rpy_to_matrix, transform
from common.sim.ray_caster import Mesh, cast, empty_view
from common.sim.ray_caster import View as Rendered
from common.sim.rendering import GROUND, _static_meshes
from common.sim.sensors import DepthSensorParameters, simulate_depth
from common.sim.solids import circle, extrude, primitive, transformed

Rgb = tuple[float, float, float]
NOISE = DepthSensorParameters(baseline=0.05, disparity_step=0.0625, disparity_noise=0.06)  # as in the sorting cell
EXACT = DepthSensorParameters()
NO_HOLE: npt.NDArray[np.float64] = np.empty((0, 2))
FLOOR = 0.005  # z of the floor of the tray [m]
RED, GREEN, BLUE = (0.85, 0.1, 0.1), (0.1, 0.65, 0.2), (0.1, 0.2, 0.85)
YELLOW, PURPLE, GREY = (0.9, 0.8, 0.1), (0.5, 0.1, 0.6), (0.35, 0.35, 0.35)


@cache
def tray_world() -> World:
    """Return the world of the sorting cell."""
    path = Path(__file__).parents[3] / "config" / "worlds" / "tray.yaml"
    return World.model_validate(parse_yaml(path.read_text()))


@cache
def camera() -> Pinhole:
    """Return its camera."""
    return Pinhole.from_config(tray_world().camera)


@cache
def empty_tray() -> Rendered:
    """Return the view without objects."""
    return cast(_static_meshes(tray_world()), camera(), empty_view(camera(), GROUND))


def area() -> Area:
    """Return the area of all containers and the table around them."""
    return area_around([place.area(AROUND) for place in containers_of(tray_world())])


def box(x: float, y: float, size: tuple[float, float, float], color: Rgb, yaw: float = 0.0, z: float = FLOOR) -> Mesh:
    """Return a box whose base is centered at a position [m]."""
    T = transform(rpy_to_matrix(0, 0, yaw), (x, y, z + size[2] / 2))
    return Mesh(transformed(primitive("box", list(size)), T), color)


def sphere(x: float, y: float, radius: float, color: Rgb, z: float = FLOOR) -> Mesh:
    """Return a sphere that lies at a height z [m]."""
    return Mesh(primitive("sphere", [radius]) + np.array([x, y, z + radius]), color)


def ring(x: float, y: float, outer: float, inner: float, height: float, color: Rgb) -> Mesh:
    """Return a flat ring on the floor of the tray."""
    at = np.array([x, y])
    return Mesh(extrude(circle(outer) + at, circle(inner) + at, FLOOR, FLOOR + height), color)


def angle_piece(x: float, y: float, side: float, color: Rgb) -> Mesh:
    """Return an L-shaped prism with its corner at a position [m]."""
    third = side / 2.5
    corners = np.array([(0, 0), (side, 0), (side, third), (third, third), (third, side), (0, side)]) + np.array([x, y])
    return Mesh(extrude(corners, NO_HOLE, FLOOR, FLOOR + 0.03), color)


def view_of(
    meshes: Sequence[Mesh], seed: int = 0, noise: DepthSensorParameters = NOISE, dropout: float = 0.0
) -> View:
    """Return what the camera measures of the tray with these solids."""
    seen = cast(list(meshes), camera(), empty_tray()) if meshes else empty_tray()
    rng = np.random.default_rng(seed)
    depth = simulate_depth(seen.depth, camera(), noise, rng)
    depth = np.where((depth > 0.1) & (depth < 2.25), depth, np.float32(np.nan)).astype(np.float32)
    if dropout:
        depth[rng.random(depth.shape) < dropout] = np.nan
    return depth, seen.colour, camera()


def surface_with(meshes: Sequence[Mesh], seed: int = 0, noise: DepthSensorParameters = NOISE) -> Surface:
    """Return the surface of the tray with these solids."""
    return surface_of([view_of(meshes, seed, noise)], area(), floor=FLOOR)


def found_in(meshes: Sequence[Mesh], seed: int = 0) -> tuple[Labels, list[SeenObject]]:
    """Return the objects found in the noisy view of the tray with these solids."""
    return find_objects(surface_with(meshes, seed), tray_world())
