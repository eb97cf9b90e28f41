"""Rest poses in the kinematic world: where a body comes to rest after falling, or after an operator puts it down.

Equal spheres roll to the nearest free position on the table, or fill the slots of a container. All other bodies fall
straight down onto their nearest side and rest on the highest surface below, which must support their center. A body
that cannot stay there moves to the nearest position where it can.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from common.config import Container, World
from common.errors import Refused
from common.robot.transforms import rpy_to_matrix, transform
from common.sim.bodies import Block, Body, Rest, State
from common.sim.footprints import convex_parts, covers_point, footprint, heights, within
from common.sim.table import Slot, Slots, Table, is_inside, is_over, tables

Array = NDArray[np.float64]

FLOOR_BELOW_TABLE = 0.75  # depth of the floor below the table [m]
LEVEL = 1e-3  # [m] height tolerance of one surface
LIFTED = 0.02  # [m] a body released less than this below a surface is put on it
STEP = 5e-3  # [m] of the position search
SEARCH_RADIUS = 0.6  # [m] of the position search


class Ground:
    """Table, fixtures and containers on which bodies come to rest."""

    def __init__(self, world: World) -> None:
        """Collect the supporting surfaces."""
        self._world = world
        self._containers = list(world.containers.values())
        self._unbounded = not tables(world)
        self._fixtures = [
            Block(f.id, footprint(f), *heights(f), flat=f.shape != "sphere" and not any(f.rpy[:2]))
            for f in world.fixtures
        ]
        self._panels = [panel for box in self._containers for panel in _panels(box, world.table_height)]
        self._tables: dict[float, Table] = {}
        self._slots: dict[tuple[str, float], Slots] = {}

    # --- falling ---

    def below(self, body: Body, bodies: Mapping[str, Body]) -> Rest:
        """Rest of a released body."""
        x, y = float(body.T[0, 3]), float(body.T[1, 3])
        box = next((c for c in self._containers if is_over(c, x, y)), None)
        if body.solid.shape == "sphere":
            if box is not None and (found := self._slot(box, body, x, y, bodies)):
                return found
            if box is None or self._in_slots(box, body, bodies):
                return self._roll(body, x, y, bodies)
        rotation = body.solid.settled(body.T[:3, :3])
        outline, center = _centred(body.solid.footprint(rotation))
        bottom = float(body.T[2, 3]) + body.solid.lowest(body.T[:3, :3])
        at, blocks = (x + float(center[0]), y + float(center[1])), self._blocks(body, bodies)
        if box is not None and (position := self._nearest(outline, at, bottom, blocks, box)):
            return self._rest(body, rotation, position, box.id)
        if self._is_supported(*at, blocks) and (position := self._nearest(outline, at, bottom, blocks, None)):
            return self._rest(body, rotation, position)
        return self._rest(body, rotation, (*at, self._world.table_height - FLOOR_BELOW_TABLE), state="elsewhere")

    def unsupported_by(self, gone: Block, bodies: Mapping[str, Body]) -> list[Body]:
        """Bodies that rested on a removed block, lowest first."""
        return sorted(
            (b for b in bodies.values() if b.state in ("table", "contained") and b.slot is None
             and abs(b.bottom - gone.high) < 2 * LEVEL and gone.reaches(b.block().outline)),
            key=lambda b: b.bottom,
        )

    def slot_position(self, container: str, radius: float, slot: Slot) -> Array:
        """Center (3,) [m] of a sphere in a slot."""
        return self._slots_of(self._world.containers[container], radius).position(slot)

    def _slot(self, box: Container, body: Body, x: float, y: float, bodies: Mapping[str, Body]) -> Rest | None:
        """Slot in which a sphere comes to rest; None if all are taken or the container holds other bodies."""
        if not self._in_slots(box, body, bodies):
            return None
        slots = self._slots_of(box, body.solid.radius)
        others = [b for b in bodies.values() if b.name != body.name and b.container_taken == box.id]
        slot = slots.choose(x, y, [taken for b in others if (taken := b.slot_in) is not None])
        if slot is None:
            return None
        return Rest(transform(body.T[:3, :3], slots.position(slot)), "contained", box.id, slot)

    def _in_slots(self, box: Container, body: Body, bodies: Mapping[str, Body]) -> bool:
        """Whether a container holds only spheres of this radius in slots."""
        others = [b for b in bodies.values() if b.name != body.name and b.container_taken == box.id]
        return all(b.slot_in is not None and b.solid.radius == body.solid.radius for b in others)

    def _roll(self, body: Body, x: float, y: float, bodies: Mapping[str, Body]) -> Rest:
        """Nearest free position of a sphere on the table; off the table it is out of sight."""
        radius, table = body.solid.radius, self._table(body.solid.radius)
        position = None
        if table.carries(x, y):
            spheres = [(at, r) for _, at, r in self._spheres(body, bodies) if at[2] > table.height]
            others = np.array([at[:2] for at, _ in spheres]).reshape(-1, 2)
            apart = [2 * radius if r == radius else 2 * math.sqrt(radius * r) for _, r in spheres]
            position = table.nearest_free(
                x, y, others, apart=apart, outlines=[block.outline for block in self._blocks_of(body, bodies)]
            )
        if position is None:
            below = self._world.table_height - FLOOR_BELOW_TABLE + radius
            return Rest(transform(body.T[:3, :3], (x, y, below)), "elsewhere")
        return Rest(transform(body.T[:3, :3], (*position, table.height + radius)))

    def _nearest(
        self, outline: Array, at: tuple[float, float], bottom: float, blocks: list[Block], box: Container | None
    ) -> tuple[float, float, float] | None:
        """Nearest stable position (x, y, height) of an outline about its own origin, inside a container if given."""
        inner, parts = box.half_side - box.wall_thickness if box else 0.0, convex_parts(outline)
        levels = [b.high for b in blocks if b.flat and b.low < bottom and covers_point(b.outline, *at)]
        level = max(levels, default=self._world.table_height)  # it slides down to what is below its center, never up
        for ring in range(int(SEARCH_RADIUS / STEP)):
            for angle in np.linspace(0.0, 2 * math.pi, max(1, min(36, 8 * ring)), endpoint=False):
                x, y = at[0] + ring * STEP * math.cos(angle), at[1] + ring * STEP * math.sin(angle)
                shifted = outline + np.array([x, y])
                if box and (np.abs(shifted - (box.x, box.y)) > inner + 1e-9).any():
                    continue
                if not box and any(is_over(c, x, y) for c in self._containers):
                    continue
                height = self._height(shifted, parts + np.array([x, y]), x, y, bottom, blocks)
                if height is not None and (not ring or height < level + LEVEL):
                    return x, y, height
            if box and ring * STEP > 2 * box.half_side:
                break
        return None

    def _height(
        self, outline: Array, parts: Array, x: float, y: float, bottom: float, blocks: list[Block]
    ) -> float | None:
        """Stable height of an outline with these convex parts [m]; None if it would slide or tip."""
        touched = [block for block in blocks if block.low < bottom and block.reaches(outline, parts)]
        if not touched:
            return self._world.table_height if self._unbounded else None
        top = max(block.high for block in touched)
        if top < self._world.table_height and self._unbounded:
            return self._world.table_height
        if top > bottom + LIFTED:
            return None
        supports = [b for b in touched if b.flat and top - b.high < LEVEL and covers_point(b.outline, x, y)]
        return top if supports else None

    def _is_supported(self, x: float, y: float, blocks: list[Block]) -> bool:
        return self._unbounded or any(b.flat and covers_point(b.outline, x, y) for b in blocks)

    # --- put down by an operator ---

    def put(self, body: Body, x: float, y: float, yaw: float | None, bodies: Mapping[str, Body]) -> Rest:
        """Rest of a body put down with the center of its outline at (x, y) [m].

        Raises:
            Refused: it cannot lie there.
        """
        box = next((c for c in self._containers if is_inside(c, x, y)), None)
        at = Body(body.name, body.solid, body.color, transform(body.T[:3, :3], (x, y, 0.0)))
        if body.solid.shape == "sphere" and (box is None or self._in_slots(box, body, bodies)):
            if box is None:
                return self._put_sphere(at, body, x, y, bodies)
            if found := self._slot(box, body, x, y, bodies):
                return Rest(transform(body.T[:3, :3], found.T[:3, 3]), "contained", box.id, found.slot)
            count = self._slots_of(box, body.solid.radius).count
            raise Refused("container_full", f"{box.id} is full: it holds {count} of {body.name}'s size")
        rotation = body.solid.settled(body.T[:3, :3]) if yaw is None else rpy_to_matrix(0.0, 0.0, yaw)
        outline, _ = _centred(body.solid.footprint(rotation))
        if box is not None:
            position = self._nearest(outline, (x, y), math.inf, self._blocks(body, bodies), box)
            if position is None:
                raise Refused("container_full", f"{box.id} is full: no room for {body.name}")
            return self._rest(body, rotation, position, box.id)
        level = body.bottom if body.state == "table" and body.solid.shape != "sphere" else self._level(x, y)
        self._require_support(body, outline + np.array([x, y]), (x, y), level, rotation, bodies)
        return self._rest(body, rotation, (x, y, level))

    def _put_sphere(self, at: Body, body: Body, x: float, y: float, bodies: Mapping[str, Body]) -> Rest:
        radius, table = body.solid.radius, self._table(body.solid.radius)
        if not table.carries(x, y):
            raise Refused("off_table", f"({x:g}, {y:g}) is not on the table: {table.extent()}")
        if blocker := table.blocked(x, y):
            raise Refused("occupied", f"{at.name} at ({x:g}, {y:g}) would overlap {blocker}")
        position = np.array([x, y, table.height + radius])
        for other, shifted, r in self._spheres(body, bodies):
            distance = float(np.linalg.norm(shifted - position))
            if distance < radius + r - 1e-9:
                raise Refused("occupied", f"({x:g}, {y:g}) overlaps {other}: {distance * 1000:.0f} mm between "
                                          f"centers; at least {(radius + r) * 1000:.0f} mm is required")
        point = np.array([[x, y]])
        for block in self._blocks_of(body, bodies):
            if not table.free(point, np.empty((0, 2)), outlines=[block.outline])[0]:
                raise Refused("occupied", f"{at.name} at ({x:g}, {y:g}) would overlap {block.id}")
        return Rest(transform(body.T[:3, :3], position))

    def _level(self, x: float, y: float) -> float:
        """Height of the highest supporting fixture there [m]."""
        tops = [b.high for b in self._fixtures if b.flat and covers_point(b.outline, x, y)]
        return max([*tops, self._world.table_height]) if self._unbounded or not tops else max(tops)

    def _require_support(
        self, body: Body, outline: Array, at: tuple[float, float], level: float, rotation: Array,
        bodies: Mapping[str, Body],
    ) -> None:
        supports = [b for b in self._fixtures if b.flat and abs(b.high - level) < LEVEL]
        if supports and not any(within(outline, b.outline) for b in supports):
            across, along = np.ptp(outline, axis=0)
            extents = []
            for b in supports:
                (left, near), (right, far) = b.outline.min(axis=0), b.outline.max(axis=0)
                extents.append(f"{b.id} is x {left:g} to {right:g}, y {near:g} to {far:g}")
            raise Refused("off_table", f"({at[0]:g}, {at[1]:g}) is not on the table for {body.name}, which takes "
                                       f"{across:.3g} x {along:.3g} m: {' or '.join(extents)}")
        low = level + LEVEL
        high = level + body.solid.highest(rotation) - body.solid.lowest(rotation) - LEVEL
        for block in [*self._fixtures, *self._panels, *(b.block() for b in self._resting(body, bodies))]:
            if block.low < high and block.high > low and block.reaches(outline):
                raise Refused("occupied", f"{body.name} at ({at[0]:g}, {at[1]:g}) would overlap {block.id}")

    # --- queries ---

    def container_of(self, body: Body) -> str:
        """Id of the container that holds a body of a world file; empty if none."""
        x, y = body.T[:2, 3]
        rim = self._world.table_height
        return next((c.id for c in self._containers
                     if is_inside(c, x, y) and rim - LEVEL < body.bottom < rim + c.wall_height), "")

    def _rest(
        self, body: Body, rotation: Array, position: tuple[float, float, float], container: str = "",
        state: State = "table",
    ) -> Rest:
        """Rest with the center of the outline at this position."""
        x, y, height = position
        _, center = _centred(body.solid.footprint(rotation))
        x, y = x - float(center[0]), y - float(center[1])
        T = transform(rotation, (x, y, height - body.solid.lowest(rotation)))
        return Rest(T, "contained" if container else state, container)

    def _table(self, radius: float) -> Table:
        if radius not in self._tables:
            self._tables[radius] = Table(self._world, radius)
        return self._tables[radius]

    def _slots_of(self, box: Container, radius: float) -> Slots:
        if (box.id, radius) not in self._slots:
            self._slots[box.id, radius] = Slots(box, radius, self._world.table_height)
        return self._slots[box.id, radius]

    def _spheres(self, other_than: Body, bodies: Mapping[str, Body]) -> list[tuple[str, Array, float]]:
        """Names, centers (3,) and radii of the spheres outside containers, including held and falling ones."""
        return [(b.name, b.rest_pose[:3, 3], b.solid.radius) for b in bodies.values()
                if b.name != other_than.name and b.solid.shape == "sphere" and not b.container_taken]

    def _resting(self, other_than: Body, bodies: Mapping[str, Body]) -> Iterable[Body]:
        return (b for b in bodies.values() if b.name != other_than.name and b.state not in ("held", "elsewhere"))

    def _blocks_of(self, other_than: Body, bodies: Mapping[str, Body]) -> list[Block]:
        """Bodies on the table other than spheres, outside containers."""
        return [b.block() for b in self._resting(other_than, bodies)
                if b.solid.shape != "sphere" and not b.container_taken and b.bottom < self._world.table_height + 0.2]

    def _blocks(self, other_than: Body, bodies: Mapping[str, Body]) -> list[Block]:
        return [*self._fixtures, *self._panels, *(b.block() for b in self._resting(other_than, bodies))]


def _centred(outline: Array) -> tuple[Array, Array]:
    """Outline (N, 2) relative to the center (2,) of its bounding box, and that center [m]."""
    center = (outline.min(axis=0) + outline.max(axis=0)) / 2
    return outline - center, center


def _panels(box: Container, table_height: float) -> list[Block]:
    """Floor and four walls of a container."""
    h, t = box.half_side, box.wall_thickness
    floor = table_height + box.floor_thickness

    def block(x0: float, x1: float, y0: float, y1: float, top: float, *, flat: bool) -> Block:
        corners = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)]) + np.array([box.x, box.y])
        return Block(box.id, corners, table_height, top, flat)

    rim = table_height + box.wall_height
    return [
        block(-h, h, -h, h, floor, flat=True), block(-h, t - h, -h, h, rim, flat=False),
        block(h - t, h, -h, h, rim, flat=False), block(-h, h, -h, t - h, rim, flat=False),
        block(-h, h, h - t, h, rim, flat=False),
    ]
