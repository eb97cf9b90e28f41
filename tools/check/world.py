"""The world of a cell by itself: what the cameras see of it, what overlaps at the start, what fits into the fingers.

Where things really lie is known of simulated worlds only: of others only cameras and containers are looked at.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from common.application import Application
from common.config import Cell, Container, GripperConfig, ObjectConfig, World
from common.hardware.loading import is_simulated
from common.perception.pinhole import Pinhole
from common.sim.footprints import overlap, within
from common.sim.objects import Solid, initial_pose, solid_of
from common.sim.table import Table, tables
from tools.check import Finding, error, warning

Array = NDArray[np.float64]

GRID = 21  # points of a table along each side that are looked for in the pictures
LEAST_SEEN = 0.5  # of a table: cameras need not see its rim
INTO = 5e-4  # [m] things may reach into each other by rounding
THINNEST = 2e-3  # [m] of what fingers hold: less cannot be told from fingers that closed on nothing


def check_world(cell: Cell, application: Application, seen_from: str = "") -> Iterator[Finding]:
    """What does not fit in the world of a cell.

    Args:
        cell: whose cameras are all fixed.
        application: what it is for.
        seen_from: where the robot is for that, in words such as ` from home`, if one of them sits on it.

    Raises:
        ConfigError: a mesh cannot be read.
    """
    world = cell.world
    placed = [thing for thing in world.objects if thing.placed] if is_simulated(cell.robot) else []
    solids = {thing.id: solid_of(thing) for thing in placed}
    yield from _pictures(world, placed, solids, seen_from)
    yield from _places(world, placed, solids)
    if application.grasps and cell.robot.gripper is not None and cell.robot.gripper.cup is None:
        for thing in placed:
            yield from _width(cell.robot.gripper, thing, solids[thing.id])


# --- what the cameras see -----------------------------------------------------------------------------------------


def _pictures(
    world: World, placed: list[ObjectConfig], solids: dict[str, Solid], seen_from: str,
) -> Iterator[Finding]:
    cameras = {name: Pinhole.from_config(camera) for name, camera in world.cameras.items()}
    field = "world.camera" if len(cameras) == 1 else "world.cameras"
    for table in tables(world):
        # The corner points and what lies between, seen from above.
        x, y = (np.linspace(-side / 2, side / 2, GRID) for side in table.dimensions[:2])
        cos, sin = np.cos(table.rpy[2]), np.sin(table.rpy[2])
        along, across = (axis.ravel() for axis in np.meshgrid(x, y))
        points = np.column_stack([table.position[0] + cos * along - sin * across,
                                  table.position[1] + sin * along + cos * across,
                                  np.full(along.shape, world.table_height)])
        seen = np.any([_seen(camera, points) for camera in cameras.values()], axis=0)
        if seen.mean() < LEAST_SEEN:
            yield warning(f"{field}: {100 * (1 - seen.mean()):.0f} % of the top of {table.id} is outside of "
                          f"{'the picture' if len(cameras) == 1 else 'all pictures'}{seen_from}",
                          f"correct position, rpy or fx, fy of {field}")
    for thing in placed:
        corners = _corners(thing, solids[thing.id])
        seen_by = {name: float(_seen(camera, corners).mean()) for name, camera in cameras.items()}
        best = max(seen_by.values())
        if best < 1:
            outside = "wholly" if best == 0 else f"to {100 * (1 - best):.0f} %"
            yield warning(f"world.objects: {thing.id} at {_at(thing)} is {outside} outside of "
                          f"{'the picture' if len(cameras) == 1 else 'every picture'}{seen_from}",
                          f"move it, or correct {field}")


def _seen(camera: Pinhole, points: Array) -> NDArray[np.bool_]:
    return camera.in_image(camera.project(points))


def _corners(thing: ObjectConfig, solid: Solid) -> Array:
    T = initial_pose(thing, solid)
    corners: Array = solid.corners @ T[:3, :3].T + T[:3, 3]
    return corners


def _at(thing: ObjectConfig) -> str:
    x, y = thing.position[:2] if thing.position is not None else (thing.x or 0.0, thing.y or 0.0)
    return f"({x:g}, {y:g})"


# --- where things lie ---------------------------------------------------------------------------------------------


def _places(world: World, placed: list[ObjectConfig], solids: dict[str, Solid]) -> Iterator[Finding]:
    for (a, b) in combinations(placed, 2):
        if _meet(a, solids[a.id], b, solids[b.id]):
            yield error(f"world.objects: {a.id} at {_at(a)} and {b.id} at {_at(b)} overlap at the start",
                        "move one of them")
    for thing in placed:
        solid = solids[thing.id]
        outline, low, _ = _extent(thing, solid)
        for container in world.containers.values():
            inner = _square(container, container.half_side - container.wall_thickness)
            if low < world.table_height + container.wall_height and _reach_into(
                    outline, _square(container, container.half_side)) and not within(outline, inner):
                yield warning(f"world.objects: {thing.id} at {_at(thing)} stands in a wall of {container.id} at the "
                              "start", f"move it, or world.containers.{container.id}")
        x, y = (thing.position or (thing.x or 0.0, thing.y or 0.0))[:2]
        table = Table(world, solid.radius)
        # Spheres that lie nowhere are refused by whoever simulates the world.
        if tables(world) and solid.shape != "sphere" and not table.carries(x, y) and low < world.table_height + INTO:
            yield warning(f"world.objects: {thing.id} at {_at(thing)} is beside the table, which reaches over "
                          f"{table.extent()}", "move it")


def _extent(thing: ObjectConfig, solid: Solid) -> tuple[Array, float, float]:
    """Outline from above (N, 2), lowest and highest z [m], world."""
    T = initial_pose(thing, solid)
    R, z = T[:3, :3], float(T[2, 3])
    return solid.footprint(R) + T[:2, 3], z + solid.lowest(R), z + solid.highest(R)


def _meet(a: ObjectConfig, solid_a: Solid, b: ObjectConfig, solid_b: Solid) -> bool:
    if solid_a.shape == solid_b.shape == "sphere":
        away = float(np.linalg.norm(initial_pose(a, solid_a)[:3, 3] - initial_pose(b, solid_b)[:3, 3]))
        return away < solid_a.radius + solid_b.radius - INTO
    (outline_a, low_a, high_a), (outline_b, low_b, high_b) = _extent(a, solid_a), _extent(b, solid_b)
    return min(high_a, high_b) - max(low_a, low_b) > INTO and _reach_into(outline_a, outline_b)


def _reach_into(a: Array, b: Array) -> bool:
    """Whether two outlines overlap by more than rounding."""
    middle = a.mean(axis=0)
    away = np.linalg.norm(a - middle, axis=1).max()
    return overlap(middle + (a - middle) * (1 - INTO / away), b)


def _square(container: Container, half: float) -> Array:
    corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    square: Array = np.array([container.x, container.y]) + half * corners
    return square


# --- what fits between the fingers --------------------------------------------------------------------------------


def _width(gripper: GripperConfig, thing: ObjectConfig, solid: Solid) -> Iterator[Finding]:
    """Whether the fingers close about an object in any way they are turned."""
    if solid.shape == "sphere":
        narrowest = 2 * solid.radius
    else:
        outline = solid.footprint(initial_pose(thing, solid)[:3, :3])
        turns = np.linspace(0.0, np.pi, 36, endpoint=False)
        along = outline @ np.stack([np.cos(turns), np.sin(turns)])
        narrowest = float(np.ptp(along, axis=0).min())
    if narrowest >= gripper.max_width:
        yield error(f"world.objects: {thing.id} is {1e3 * narrowest:.0f} mm wide, the fingers open to "
                    f"{1e3 * gripper.max_width:.0f} mm (robot.gripper.max_width)",
                    "take a smaller object, or another gripper")
    elif narrowest < THINNEST:
        yield error(f"world.objects: {thing.id} is {1e3 * narrowest:.1f} mm wide, so that fingers that hold it look "
                    "closed", "take a wider object")
