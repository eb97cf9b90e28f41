"""Where everything lies at the start: as the world file says, or at random but seen, apart and within reach."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from common.config import CameraConfig, ObjectConfig, World
from common.errors import ConfigError
from common.robot.transforms import rpy_to_matrix
from common.sim.objects import Solid, solid_of
from common.sim.table import Table

PICTURE_MARGIN = 6.0  # the outline of what is placed stays this far inside the picture [px]
TRIES = 100  # places drawn for each object before the layout is begun anew
ATTEMPTS = 20

Place = tuple[float, float]
Accepts = Callable[[float, float, float], bool]


def layout(world: World, seed: int, accepts: Accepts) -> list[ObjectConfig]:
    """The objects of the world, each with a place.

    Args:
        world: objects that have no place are given a random one.
        seed: of the random places; the same seed gives the same ones.
        accepts: whether the arm can take something from (x, y, z) [m]; asked for random places only.

    Raises:
        ConfigError: no random layout was found.
    """
    scattered = [thing for thing in world.objects if not thing.placed]
    if not scattered:
        return list(world.objects)
    found = iter(random_layout(world, scattered, np.random.default_rng(seed), accepts))
    return [thing if thing.placed else next(found) for thing in world.objects]


def random_layout(
    world: World, things: Sequence[ObjectConfig], rng: np.random.Generator, accepts: Accepts
) -> list[ObjectConfig]:
    """The things on the table, wholly in a picture, accepted by the arm, clear of each other and of containers.

    A sphere stands for what is no sphere: it has the radius of the circle about it seen from above, or half its height
    if that is more. All else but spheres is turned at random.

    Raises:
        ConfigError: no places were found; names what could be asked less of.
    """
    solids = [solid_of(thing) for thing in things]
    radii = [_radius(solid) for solid in solids]
    low, high = seen_area(world, world.table_height + max(radii))
    table = {radius: Table(world, radius) for radius in radii}
    taken = [(thing.x, thing.y) for thing in world.objects if thing.x is not None and thing.y is not None]
    taken += [thing.position[:2] for thing in world.objects if thing.position is not None]
    largest = max(radii)

    def fits(place: Place, others: list[Place], radius: float, height: float) -> bool:
        apart = [radius + largest] * len(others)
        centres, gap = np.array(others).reshape(-1, 2), world.container_clearance
        return (
            all(math.dist(place, other) >= world.min_separation for other in others)
            and bool(table[radius].free(np.array([place]), centres, gap, apart=apart)[0])
            and any(sphere_in_image(camera, place, world.table_height + radius, radius)
                    for camera in world.cameras.values())
            and accepts(*place, world.table_height + height)
        )

    for _ in range(ATTEMPTS):
        places: list[Place] = []
        for _ in range(TRIES * len(things)):
            x, y = rng.uniform(low, high)
            solid, radius = solids[len(places)], radii[len(places)]
            if fits((float(x), float(y)), [*taken, *places], radius, -float(solid.low[2])):
                places.append((float(x), float(y)))
                if len(places) == len(things):
                    yaws = [0.0 if s.shape == "sphere" else float(rng.uniform(0, 2 * math.pi)) for s in solids]
                    return [
                        thing.model_copy(update={"x": x, "y": y, "z": world.table_height, "yaw": yaw})
                        for thing, (x, y), yaw in zip(things, places, yaws, strict=True)
                    ]
    raise ConfigError(
        "world.objects", len(things), f"objects find no random layout with min_separation {world.min_separation:g} and "
        f"container_clearance {world.container_clearance:g} in view and within reach; ask for fewer or less"
    )


def _radius(solid: Solid) -> float:
    """Of the sphere that stands for a solid [m]."""
    if solid.shape == "sphere":
        return solid.radius
    across = np.maximum(np.abs(solid.low[:2]), np.abs(solid.high[:2]))
    return max(float(np.hypot(*across)), float(solid.size[2]) / 2)


def seen_area(world: World, height: float) -> tuple[Place, Place]:
    """Lowest and highest (x, y) [m] at a height [m] that the cameras see."""
    corners = []
    for name, camera in world.cameras.items():
        R_world_camera, origin = rpy_to_matrix(*camera.rpy), np.array(camera.position)
        for u, v in ((0, 0), (camera.width, 0), (0, camera.height), (camera.width, camera.height)):
            ray = R_world_camera @ np.array([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0])
            distance = (height - origin[2]) / ray[2] if ray[2] else -1.0
            if distance <= 0:
                field = "world.camera.rpy" if len(world.cameras) == 1 else f"world.cameras.{name}.rpy"
                raise ConfigError(field, camera.rpy, "must look down on the table for a random layout")
            corners.append((origin + distance * ray)[:2])
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    return (float(low[0]), float(low[1])), (float(high[0]), float(high[1]))


def sphere_in_image(camera: CameraConfig, place: Place, z: float, radius: float) -> bool:
    """Whether the outline of a sphere with its centre at place, z [m] stays within the picture by the margin.

    Seen along one axis of the picture the sphere is a disc, and the tangents to it from the optical centre lie at
    atan2(X, Z) +- asin(radius / |(X, Z)|).
    """
    x, y, depth = rpy_to_matrix(*camera.rpy).T @ (np.array([*place, z]) - np.array(camera.position))
    if depth <= radius:
        return False
    for across, f, centre, size in ((x, camera.fx, camera.cx, camera.width), (y, camera.fy, camera.cy, camera.height)):
        middle, half = math.atan2(across, depth), math.asin(radius / math.hypot(across, depth))
        if middle - half <= -math.pi / 2 or middle + half >= math.pi / 2:
            return False
        first, last = centre + f * math.tan(middle - half), centre + f * math.tan(middle + half)
        if first < PICTURE_MARGIN or last > size - 1 - PICTURE_MARGIN:
            return False
    return True
