"""Layout of the simulated world: initial, random or configured, and validated edits by operators."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence

import numpy as np

from common.config import CameraConfig, ObjectConfig, World
from common.errors import ConfigError, Refused, UnknownName
from common.messages import Vector3, WorldEdit
from common.planning.prism import convex_hull
from common.robot.transforms import rpy_to_matrix
from common.sim.bodies import Body
from common.sim.footprints import is_convex
from common.sim.objects import Solid, make_solid, solid_of
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


MAX_OBJECTS = 500  # in the world: each is published while it moves, and checked in every cycle
MAX_CORNERS = 50_000  # of all objects together
FARTHEST = 1000.0  # [m] from the origin of world along each axis, and from an object's own origin
MAX_CONCAVE = 200  # corners of a concave cross-section: overlap tests cost the product of corner counts


def new_body(
    request: WorldEdit, first: Mapping[str, ObjectConfig], solids: Mapping[str, Solid], spare: ObjectConfig | None,
    existing: Mapping[str, Body],
) -> Body:
    """Return the body that an `add` request describes, without a position yet.

    Args:
        request: the edit.
        first: objects of the initial layout, by id.
        solids: their shapes.
        spare: template for a request without `like`.
        existing: bodies in the world, by id.

    Raises:
        Refused: an unknown template, a used or invalid id, an invalid shape.
    """
    model = first.get(request.like) if request.like else spare
    if model is None:
        raise Refused("unknown_id", str(UnknownName("object of the first layout", request.like, first)))
    name = request.id or _free_name(request.shape or re.sub(r"_\d+$", "", model.id), existing)
    if name in existing:
        raise Refused("id_exists", f"id: {name!r} exists already; leave it empty for a new one")
    if not re.fullmatch(r"[A-Za-z0-9_.-]{1,60}", name):
        raise Refused("bad_id", f"id: {name[:60]!r} must be letters, digits, '_', '.' and '-', at most 60")
    c = request.color
    color = model.color if c is None else (c.r, c.g, c.b)
    if request.shape is None:
        solid = solids.get(model.id) or solid_of(model)
        like = model.id if model.id in first and c is None else ""
    else:
        solid, like = requested_solid(request), ""
    mass = request.mass or (model.mass if request.shape is None else 0.0)
    return Body(name, solid, color, np.eye(4), "elsewhere", added=True, like=like, mass=mass)


def _free_name(kind: str, taken: Collection[str]) -> str:
    return next(n for i in range(1, len(taken) + 2) if (n := f"{kind}_{i}") not in taken)


def requested_solid(request: WorldEdit) -> Solid:
    """Return the shape that a request describes.

    Raises:
        Refused: a value of the shape is missing or out of range.
    """
    size = request.size
    if request.shape is None or size is None or size.x <= 0 or (request.shape != "sphere" and size.z <= 0):
        raise Refused("no_size", f"size: a {request.shape} needs one, for example {{x: 0.04, y: 0.04, z: 0.04}}")
    inner = (request.inner_radius or 0.0) if request.shape == "ring" else 0.0
    if request.shape == "ring" and not 0 < inner < size.x / 2:
        raise Refused("no_size", f"inner_radius: a ring needs one below {size.x / 2:g} m")
    if request.shape == "box" and size.y <= 0:
        raise Refused("no_size", "size: a box needs x, y and z")
    if request.shape == "prism" and len(request.polygon) < 3:
        raise Refused("no_size", "polygon: a prism needs at least 3 corners")
    if len(request.polygon) > MAX_CONCAVE and not is_convex(np.array(request.polygon)):
        raise Refused("too_many_corners", f"polygon: has {len(request.polygon)} corners and is not convex; at most "
                                          f"{MAX_CONCAVE} are supported")
    if request.shape == "prism" and len(convex_hull(np.array(request.polygon))) < 3:
        raise Refused("no_size", "polygon: encloses no area")
    solid = make_solid(request.shape, size, inner, request.polygon)
    if solid.reach > FARTHEST:
        raise Refused("no_size", f"size: extends {solid.reach:g} m from its center; the limit is {FARTHEST:g} m")
    return solid


def requested_position(request: WorldEdit) -> Vector3:
    """Return the position of a request.

    Raises:
        Refused: it is missing or too far away.
    """
    at = request.position
    if at is None:
        raise Refused("no_position", f"position: {request.op} needs one, for example {{x: 0.5, y: 0.0}}")
    if max(abs(at.x), abs(at.y), abs(at.z)) > FARTHEST:
        raise Refused("too_far", f"position: is more than {FARTHEST:g} m from the origin of world")
    return at


def require_room(solids: Iterable[Solid], count: int) -> None:
    """Check that the world may hold these shapes, including a new one, in addition to `count` objects.

    Raises:
        Refused: a limit would be exceeded.
    """
    if count >= MAX_OBJECTS:
        raise Refused("world_full", f"there are {count} objects; at most {MAX_OBJECTS} are supported")
    corners = sum(len(solid.section) + len(solid.hole) + 3 * len(solid.mesh) for solid in solids)
    if corners > MAX_CORNERS:
        raise Refused("world_full", f"all objects together would have {corners} corners; at most {MAX_CORNERS} are "
                                    "supported")
