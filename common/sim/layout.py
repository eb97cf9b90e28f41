"""Where the balls lie at the start: as the world file says, or at random but seen, apart and within reach."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from common.config import CameraConfig, World
from common.errors import ConfigError
from common.robot.transforms import rpy_to_matrix
from common.sim.places import Table

PICTURE_MARGIN = 6.0  # a ball's outline stays this far inside the picture [px]
TRIES = 100  # places drawn for each ball before the layout is begun anew
ATTEMPTS = 20

Place = tuple[float, float]
Accepts = Callable[[float, float], bool]


def layout(world: World, seed: int, accepts: Accepts) -> list[Place]:
    """Centres of the balls at the start, (x, y) [m].

    Args:
        world: `balls` if given, else the first `count` spots, or `count` random places.
        seed: of a random layout; the same seed gives the same layout.
        accepts: whether the arm can take a ball from (x, y); asked for random places only.

    Raises:
        ConfigError: no random layout was found.
    """
    if world.balls:
        return list(world.balls)
    if world.layout == "fixed":
        return list(world.spots[: world.count])
    return random_layout(world, np.random.default_rng(seed), accepts)


def random_layout(world: World, rng: np.random.Generator, accepts: Accepts) -> list[Place]:
    """`world.count` places on the table, wholly in the picture, accepted by the arm, clear of each other and the box.

    Raises:
        ConfigError: none found; names what could be asked less of.
    """
    table = Table(world)
    low, high = seen_area(world)

    def fits(place: Place, others: list[Place]) -> bool:
        point = np.array([place])
        return (
            all(math.dist(place, other) >= world.min_separation for other in others)
            and bool(table.free(point, np.array(others).reshape(-1, 2), world.container_clearance)[0])
            and wholly_in_picture(world.camera, place, table.height + table.radius, table.radius)
            and accepts(*place)
        )

    if world.count == 0:
        return []
    for _ in range(ATTEMPTS):
        places: list[Place] = []
        for _ in range(TRIES * world.count):
            x, y = rng.uniform(low, high)
            if fits((float(x), float(y)), places):
                places.append((float(x), float(y)))
                if len(places) == world.count:
                    return places
    raise ConfigError(
        "world.count", world.count, f"balls find no random layout with min_separation {world.min_separation:g} and "
        f"container_clearance {world.container_clearance:g} in view and within reach; ask for fewer or less"
    )


def seen_area(world: World) -> tuple[Place, Place]:
    """Lowest and highest (x, y) [m] at the height of the balls' centres that the camera sees."""
    camera = world.camera
    R_world_camera, origin = rpy_to_matrix(*camera.rpy), np.array(camera.position)
    corners = []
    for u, v in ((0, 0), (camera.width, 0), (0, camera.height), (camera.width, camera.height)):
        ray = R_world_camera @ np.array([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0])
        distance = (world.table_height + world.ball_radius - origin[2]) / ray[2] if ray[2] else -1.0
        if distance <= 0:
            raise ConfigError("world.camera.rpy", camera.rpy, "must look down on the table for a random layout")
        corners.append((origin + distance * ray)[:2])
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    return (float(low[0]), float(low[1])), (float(high[0]), float(high[1]))


def wholly_in_picture(camera: CameraConfig, place: Place, z: float, radius: float) -> bool:
    """Whether the outline of a ball with its centre at place, z [m] stays within the picture by the margin.

    Seen along one axis of the picture the ball is a disc, and the tangents to it from the optical centre lie at
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
