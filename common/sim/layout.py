"""Initial object layout: as configured, or random but visible, separated and reachable."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from common.config import CameraConfig, ObjectConfig, World
from common.errors import ConfigError
from common.robot.transforms import rpy_to_matrix
from common.sim.objects import Solid, solid_of
from common.sim.table import Table

IMAGE_MARGIN = 6.0  # distance of an object's outline from the image border [px]
TRIES = 100  # samples per object before the layout restarts
ATTEMPTS = 20

Position = tuple[float, float]
Accepts = Callable[[float, float, float], bool]


def layout(world: World, seed: int, accepts: Accepts) -> list[ObjectConfig]:
    """Return the objects of the world, each with a position.

    Args:
        world: objects without a position get a random one.
        seed: of the random positions; the same seed gives the same layout.
        accepts: whether the arm can pick at (x, y, z) [m]; called for random positions only.

    Raises:
        ConfigError: no random layout was found.
    """
    unplaced = [obj for obj in world.objects if not obj.placed]
    if not unplaced:
        return list(world.objects)
    found = iter(random_layout(world, unplaced, np.random.default_rng(seed), accepts))
    return [obj if obj.placed else next(found) for obj in world.objects]


def random_layout(
    world: World, objects: Sequence[ObjectConfig], rng: np.random.Generator, accepts: Accepts
) -> list[ObjectConfig]:
    """Place objects on the table: inside an image, reachable, clear of each other and of containers.

    Other objects are treated as spheres: the radius is that of the circumscribed circle seen from above, or half the
    height if larger. Non-spherical objects get a random yaw.

    Raises:
        ConfigError: no layout was found; names the constraints to relax.
    """
    solids = [solid_of(obj) for obj in objects]
    radii = [_radius(solid) for solid in solids]
    low, high = seen_area(world, world.table_height + max(radii))
    table = {radius: Table(world, radius) for radius in radii}
    taken = [(obj.x, obj.y) for obj in world.objects if obj.x is not None and obj.y is not None]
    taken += [obj.position[:2] for obj in world.objects if obj.position is not None]
    largest = max(radii)

    def fits(position: Position, others: list[Position], radius: float, height: float) -> bool:
        apart = [radius + largest] * len(others)
        centres, gap = np.array(others).reshape(-1, 2), world.container_clearance
        return (
            all(math.dist(position, other) >= world.min_separation for other in others)
            and bool(table[radius].free(np.array([position]), centres, gap, apart=apart)[0])
            and any(sphere_in_image(camera, position, world.table_height + radius, radius)
                    for camera in world.cameras.values())
            and accepts(*position, world.table_height + height)
        )

    for _ in range(ATTEMPTS):
        positions: list[Position] = []
        for _ in range(TRIES * len(objects)):
            x, y = rng.uniform(low, high)
            solid, radius = solids[len(positions)], radii[len(positions)]
            if fits((float(x), float(y)), [*taken, *positions], radius, -float(solid.low[2])):
                positions.append((float(x), float(y)))
                if len(positions) == len(objects):
                    yaws = [0.0 if s.shape == "sphere" else float(rng.uniform(0, 2 * math.pi)) for s in solids]
                    return [
                        obj.model_copy(update={"x": x, "y": y, "z": world.table_height, "yaw": yaw})
                        for obj, (x, y), yaw in zip(objects, positions, yaws, strict=True)
                    ]
    raise ConfigError(
        "world.objects", len(objects), f"objects fit no random layout with min_separation {world.min_separation:g} and "
        f"container_clearance {world.container_clearance:g} in view and within reach; use fewer objects"
    )


def _radius(solid: Solid) -> float:
    """Radius of the substitute sphere [m]."""
    if solid.shape == "sphere":
        return solid.radius
    across = np.maximum(np.abs(solid.low[:2]), np.abs(solid.high[:2]))
    return max(float(np.hypot(*across)), float(solid.size[2]) / 2)


def seen_area(world: World, height: float) -> tuple[Position, Position]:
    """Lowest and highest (x, y) [m] that the cameras see at a height [m]."""
    corners = []
    for name, camera in world.cameras.items():
        R_world_camera, origin = rpy_to_matrix(*camera.rpy), np.array(camera.position)
        for u, v in ((0, 0), (camera.width, 0), (0, camera.height), (camera.width, camera.height)):
            ray = R_world_camera @ np.array([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0])
            distance = (height - origin[2]) / ray[2] if ray[2] else -1.0
            if distance <= 0:
                field = "world.camera.rpy" if len(world.cameras) == 1 else f"world.cameras.{name}.rpy"
                raise ConfigError(field, camera.rpy, "must point down at the table for a random layout")
            corners.append((origin + distance * ray)[:2])
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    return (float(low[0]), float(low[1])), (float(high[0]), float(high[1]))


def sphere_in_image(camera: CameraConfig, position: Position, z: float, radius: float) -> bool:
    """Whether the outline of a sphere at (x, y), z [m] stays inside the image by the margin.

    In a section along an image axis the sphere is a disc; the tangents from the optical center lie at
    atan2(X, Z) +- asin(radius / |(X, Z)|).
    """
    x, y, depth = rpy_to_matrix(*camera.rpy).T @ (np.array([*position, z]) - np.array(camera.position))
    if depth <= radius:
        return False
    for across, f, centre, size in ((x, camera.fx, camera.cx, camera.width), (y, camera.fy, camera.cy, camera.height)):
        center_angle, half = math.atan2(across, depth), math.asin(radius / math.hypot(across, depth))
        if center_angle - half <= -math.pi / 2 or center_angle + half >= math.pi / 2:
            return False
        first, last = centre + f * math.tan(center_angle - half), centre + f * math.tan(center_angle + half)
        if first < IMAGE_MARGIN or last > size - 1 - IMAGE_MARGIN:
            return False
    return True
