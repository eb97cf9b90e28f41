"""Checks the world of a cell: visibility, overlapping objects, and objects that do not fit the gripper.

Positions of objects are known for simulated worlds only; for others only cameras and containers are checked.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations, pairwise

import numpy as np
from numpy.typing import NDArray

from common.application import Application
from common.config import Cell, Container, GripperConfig, ObjectConfig, World
from common.hardware.backends import has_simulated_world
from common.perception.pinhole import Pinhole
from common.sim.footprints import overlap, within
from common.sim.objects import Solid, initial_pose, solid_of
from common.sim.table import Table, tables
from tools.check import Finding, error, warning

Array = NDArray[np.float64]

GRID = 21  # points along each side of a table that are projected into the images
LEAST_VISIBLE = 0.5  # share of a table: cameras need not see its rim
INTO = 5e-4  # [m] overlap that rounding may cause
STEP = 2e-3  # [m] between sampled points of edges
MOST_POINTS = 20_000  # exact; more of them are rounded to a grid
PARALLEL = 0.1  # share by which an extent may differ between two halves of a finger
THINNEST = 2e-3  # [m] width of a held object: a thinner one looks like an empty gripper


def check_world(cell: Cell, application: Application, seen_from: str = "") -> Iterator[Finding]:
    """Yield problems of the world of a cell.

    Args:
        cell: with fixed cameras only.
        application: of the cell.
        seen_from: text such as ` from home`, if a camera is mounted on the arm.

    Raises:
        ConfigError: a mesh cannot be read.
    """
    world = cell.world
    placed = [item for item in world.objects if item.placed] if has_simulated_world(cell.robot) else []
    solids = {item.id: solid_of(item) for item in placed}
    yield from _visibility(world, placed, solids, seen_from)
    yield from _positions(world, placed, solids)
    if application.grasps and cell.robot.gripper is not None and cell.robot.gripper.cup is None:
        for item in placed:
            yield from _width(cell.robot.gripper, item, solids[item.id])


# --- visibility ---------------------------------------------------------------------------------------------------


def _visibility(
    world: World, placed: list[ObjectConfig], solids: dict[str, Solid], seen_from: str,
) -> Iterator[Finding]:
    cameras = {name: Pinhole.from_config(camera) for name, camera in world.cameras.items()}
    field = "world.camera" if len(cameras) == 1 else "world.cameras"
    for table in tables(world):
        # A grid over the table top, seen from above.
        x, y = (np.linspace(-side / 2, side / 2, GRID) for side in table.dimensions[:2])
        cos, sin = np.cos(table.rpy[2]), np.sin(table.rpy[2])
        along, across = (axis.ravel() for axis in np.meshgrid(x, y))
        points = np.column_stack([table.position[0] + cos * along - sin * across,
                                  table.position[1] + sin * along + cos * across,
                                  np.full(along.shape, world.table_height)])
        seen = np.any([_visible(camera, points) for camera in cameras.values()], axis=0)
        if seen.mean() < LEAST_VISIBLE:
            yield warning(f"{field}: {100 * (1 - seen.mean()):.0f} % of the top of {table.id} is outside of "
                          f"{'the image' if len(cameras) == 1 else 'all images'}{seen_from}",
                          f"correct position, rpy or fx, fy of {field}")
    for item in placed:
        corners = _corners(item, solids[item.id])
        x, y = corners[:, :2].mean(axis=0)
        if any(belt.speed and belt.carries(x, y, corners[:, 2].min()) for belt in world.conveyors.values()):
            continue  # it starts where the belt comes from
        seen_by = {name: float(_visible(camera, corners).mean()) for name, camera in cameras.items()}
        best = max(seen_by.values())
        if best < 1:
            outside = "completely" if best == 0 else f"to {100 * (1 - best):.0f} %"
            yield warning(f"world.objects: {item.id} at {_at(item)} is {outside} outside of "
                          f"{'the image' if len(cameras) == 1 else 'every image'}{seen_from}",
                          f"move it, or correct {field}")


def _visible(camera: Pinhole, points: Array) -> NDArray[np.bool_]:
    return camera.in_image(camera.project(points))


def _corners(item: ObjectConfig, solid: Solid) -> Array:
    T = initial_pose(item, solid)
    corners: Array = solid.corners @ T[:3, :3].T + T[:3, 3]
    return corners


def _at(item: ObjectConfig) -> str:
    x, y = item.position[:2] if item.position is not None else (item.x or 0.0, item.y or 0.0)
    return f"({x:g}, {y:g})"


# --- positions ----------------------------------------------------------------------------------------------------


def _positions(world: World, placed: list[ObjectConfig], solids: dict[str, Solid]) -> Iterator[Finding]:
    for (a, b) in combinations(placed, 2):
        if _overlap(a, solids[a.id], b, solids[b.id]):
            yield error(f"world.objects: {a.id} at {_at(a)} and {b.id} at {_at(b)} overlap at the start",
                        "move one of them")
    for item in placed:
        solid = solids[item.id]
        outline, low, _ = _extent(item, solid)
        for container in world.containers.values():
            inner = _square(container, container.half_side - container.wall_thickness)
            if low < world.table_height + container.wall_height and _outlines_overlap(
                    outline, _square(container, container.half_side)) and not within(outline, inner):
                yield warning(f"world.objects: {item.id} at {_at(item)} intersects a wall of {container.id} at the "
                              "start", f"move it, or world.containers.{container.id}")
        x, y = (item.position or (item.x or 0.0, item.y or 0.0))[:2]
        table = Table(world, solid.radius)
        # The simulator itself refuses spheres that are not on a table.
        if tables(world) and solid.shape != "sphere" and not table.carries(x, y) and low < world.table_height + INTO:
            yield warning(f"world.objects: {item.id} at {_at(item)} is not on the table, which covers "
                          f"{table.extent()}", "move it")


def _extent(item: ObjectConfig, solid: Solid) -> tuple[Array, float, float]:
    """Return outline from above (N, 2), lowest and highest z, in world [m]."""
    T = initial_pose(item, solid)
    R, z = T[:3, :3], float(T[2, 3])
    return solid.footprint(R) + T[:2, 3], z + solid.lowest(R), z + solid.highest(R)


def _overlap(a: ObjectConfig, solid_a: Solid, b: ObjectConfig, solid_b: Solid) -> bool:
    if solid_a.shape == solid_b.shape == "sphere":
        distance = float(np.linalg.norm(initial_pose(a, solid_a)[:3, 3] - initial_pose(b, solid_b)[:3, 3]))
        return distance < solid_a.radius + solid_b.radius - INTO
    (outline_a, low_a, high_a), (outline_b, low_b, high_b) = _extent(a, solid_a), _extent(b, solid_b)
    return min(high_a, high_b) - max(low_a, low_b) > INTO and _outlines_overlap(outline_a, outline_b)


def _outlines_overlap(a: Array, b: Array) -> bool:
    """Return whether two outlines overlap by more than rounding."""
    middle = a.mean(axis=0)
    radius = np.linalg.norm(a - middle, axis=1).max()
    return overlap(middle + (a - middle) * (1 - INTO / radius), b)


def _square(container: Container, half: float) -> Array:
    corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    square: Array = np.array([container.x, container.y]) + half * corners
    return square


def _edge_points(triangles: Array) -> Array:
    """Return points (N, 2) [m], at most STEP apart, on the edges of triangles (n, 3, 3), seen from above."""
    first, second = triangles[..., :2].reshape(-1, 2), np.roll(triangles, -1, axis=1)[..., :2].reshape(-1, 2)
    count = np.ceil(np.linalg.norm(second - first, axis=1) / STEP).astype(int) + 1
    share = (np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)) / np.repeat(count, count)
    start = np.repeat(first, count, axis=0)
    points: Array = start + share[:, None] * (np.repeat(second, count, axis=0) - start)
    return points if len(points) <= MOST_POINTS else np.unique(np.round(points / STEP), axis=0) * STEP


def _narrowest(along: Array, across: Array, finger: float) -> float:
    """Return the smallest extent (N,) [m] along an axis between parallel sides as wide as a finger [m], across it."""
    order = np.argsort(across)
    along, across = along[order], across[order]
    finger = min(finger, across[-1] - across[0])
    narrowest = float(np.ptp(along))
    for start in np.arange(across[0], across[-1] - finger + STEP / 2, STEP):
        ends = np.searchsorted(across, [start - STEP, start + finger / 2, start + finger + STEP])
        first, second = (float(np.ptp(along[a:b])) if b > a else np.inf for a, b in pairwise(ends))
        if abs(first - second) < PARALLEL * max(first, second):  # else it is a corner
            narrowest = min(narrowest, max(first, second))
    return narrowest


# --- gripper ------------------------------------------------------------------------------------------------------


def _width(gripper: GripperConfig, item: ObjectConfig, solid: Solid) -> Iterator[Finding]:
    """Check that the fingers fit around the object in some orientation."""
    if solid.shape == "sphere":
        narrowest = 2 * solid.radius
    else:
        edges = _edge_points(solid.triangles @ initial_pose(item, solid)[:3, :3].T)
        turns = np.linspace(0.0, np.pi, 36, endpoint=False)
        narrowest = min(_narrowest(edges @ [np.cos(turn), np.sin(turn)], edges @ [-np.sin(turn), np.cos(turn)],
                                   2 * gripper.fingers.half_width) for turn in turns)
    if narrowest >= gripper.max_width:
        yield error(f"world.objects: {item.id} is {1e3 * narrowest:.0f} mm wide, the fingers open to "
                    f"{1e3 * gripper.max_width:.0f} mm (robot.gripper.max_width)",
                    "take a smaller object, or another gripper")
    elif narrowest < THINNEST:
        yield error(f"world.objects: {item.id} is {1e3 * narrowest:.1f} mm wide, so that fingers that hold it look "
                    "closed", "take a wider object")
