"""Where a body of the kinematic world comes to rest: where it falls, and where a person puts it.

Equal spheres lie on the table, where they roll to the nearest free place, or in the slots of a container. All else
falls straight down onto the nearest of its sides and rests on the highest thing below it, which must carry its middle;
where it cannot stay it lies at the nearest place where it can.
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

FLOOR_BELOW_TABLE = 0.75  # what falls off the table lies this far below its surface [m]
LEVEL = 1e-3  # [m] tops so near to each other are one surface
LIFTED = 0.02  # [m] what was let go so little below the top of something is put on it
STEP = 5e-3  # [m] of the search for a place
FARTHEST = 0.6  # [m] from where it fell


class Ground:
    """The table, fixtures and containers of a world, on which bodies come to rest."""

    def __init__(self, world: World) -> None:
        """Find out what carries."""
        self._world = world
        self._containers = list(world.containers.values())
        self._endless = not tables(world)
        self._fixtures = [
            Block(f.id, footprint(f), *heights(f), flat=f.shape != "sphere" and not any(f.rpy[:2]))
            for f in world.fixtures
        ]
        self._panels = [panel for box in self._containers for panel in _panels(box, world.table_height)]
        self._tables: dict[float, Table] = {}
        self._slots: dict[tuple[str, float], Slots] = {}

    # --- falling ---

    def below(self, body: Body, bodies: Mapping[str, Body]) -> Rest:
        """Where a body that is let go comes to rest."""
        x, y = float(body.T[0, 3]), float(body.T[1, 3])
        box = next((c for c in self._containers if is_over(c, x, y)), None)
        if body.solid.shape == "sphere":
            if box is not None and (found := self._slot(box, body, x, y, bodies)):
                return found
            if box is None or self._in_slots(box, body, bodies):
                return self._roll(body, x, y, bodies)
        rotation = body.solid.settled(body.T[:3, :3])
        outline, middle = _centred(body.solid.footprint(rotation))
        bottom = float(body.T[2, 3]) + body.solid.lowest(body.T[:3, :3])
        at, blocks = (x + float(middle[0]), y + float(middle[1])), self._blocks(body, bodies)
        if box is not None and (place := self._nearest(outline, at, bottom, blocks, box)):
            return self._rest(body, rotation, place, box.id)
        if self._is_carried(*at, blocks) and (place := self._nearest(outline, at, bottom, blocks, None)):
            return self._rest(body, rotation, place)
        return self._rest(body, rotation, (*at, self._world.table_height - FLOOR_BELOW_TABLE), state="elsewhere")

    def carries_nothing_any_more(self, gone: Block, bodies: Mapping[str, Body]) -> list[Body]:
        """Bodies that lay on something that is no longer there, lowest first."""
        return sorted(
            (b for b in bodies.values() if b.state in ("table", "contained") and b.slot is None
             and abs(b.bottom - gone.high) < 2 * LEVEL and gone.reaches(b.block().outline)),
            key=lambda b: b.bottom,
        )

    def slot_position(self, container: str, radius: float, slot: Slot) -> Array:
        """Centre (3,) [m] of a sphere in a slot."""
        return self._slots_of(self._world.containers[container], radius).position(slot)

    def _slot(self, box: Container, body: Body, x: float, y: float, bodies: Mapping[str, Body]) -> Rest | None:
        """The slot in which a sphere comes to lie; None when all are taken, or something else lies in there."""
        if not self._in_slots(box, body, bodies):
            return None
        slots = self._slots_of(box, body.solid.radius)
        others = [b for b in bodies.values() if b.name != body.name and b.container_taken == box.id]
        slot = slots.choose(x, y, [taken for b in others if (taken := b.slot_in) is not None])
        if slot is None:
            return None
        return Rest(transform(body.T[:3, :3], slots.position(slot)), "contained", box.id, slot)

    def _in_slots(self, box: Container, body: Body, bodies: Mapping[str, Body]) -> bool:
        """Whether all that lies in a container are spheres of one size in their slots."""
        others = [b for b in bodies.values() if b.name != body.name and b.container_taken == box.id]
        return all(b.slot_in is not None and b.solid.radius == body.solid.radius for b in others)

    def _roll(self, body: Body, x: float, y: float, bodies: Mapping[str, Body]) -> Rest:
        """A sphere on the table, at the nearest place that is free; beside the table it is out of sight."""
        radius, table = body.solid.radius, self._table(body.solid.radius)
        place = None
        if table.carries(x, y):
            spheres = [(at, r) for _, at, r in self._spheres(body, bodies) if at[2] > table.height]
            others = np.array([at[:2] for at, _ in spheres]).reshape(-1, 2)
            apart = [2 * radius if r == radius else 2 * math.sqrt(radius * r) for _, r in spheres]
            place = table.nearest_free(
                x, y, others, apart=apart, outlines=[block.outline for block in self._blocks_of(body, bodies)]
            )
        if place is None:
            below = self._world.table_height - FLOOR_BELOW_TABLE + radius
            return Rest(transform(body.T[:3, :3], (x, y, below)), "elsewhere")
        return Rest(transform(body.T[:3, :3], (*place, table.height + radius)))

    def _nearest(
        self, outline: Array, at: tuple[float, float], bottom: float, blocks: list[Block], box: Container | None
    ) -> tuple[float, float, float] | None:
        """The nearest place (x, y, height) where an outline about its own origin rests, within a container if given."""
        inner, parts = box.half_side - box.wall_thickness if box else 0.0, convex_parts(outline)
        carried = [b.high for b in blocks if b.flat and b.low < bottom and covers_point(b.outline, *at)]
        level = max(carried, default=self._world.table_height)  # it slides off to below its middle, never up
        for ring in range(int(FARTHEST / STEP)):
            for angle in np.linspace(0.0, 2 * math.pi, max(1, min(36, 8 * ring)), endpoint=False):
                x, y = at[0] + ring * STEP * math.cos(angle), at[1] + ring * STEP * math.sin(angle)
                there = outline + np.array([x, y])
                if box and (np.abs(there - (box.x, box.y)) > inner + 1e-9).any():
                    continue
                if not box and any(is_over(c, x, y) for c in self._containers):
                    continue
                height = self._height(there, parts + np.array([x, y]), x, y, bottom, blocks)
                if height is not None and (not ring or height < level + LEVEL):
                    return x, y, height
            if box and ring * STEP > 2 * box.half_side:
                break
        return None

    def _height(
        self, outline: Array, parts: Array, x: float, y: float, bottom: float, blocks: list[Block]
    ) -> float | None:
        """The height on which an outline with these convex parts rests there [m]; None where it would not stay."""
        met = [block for block in blocks if block.low < bottom and block.reaches(outline, parts)]
        if not met:
            return self._world.table_height if self._endless else None
        top = max(block.high for block in met)
        if top < self._world.table_height and self._endless:
            return self._world.table_height
        if top > bottom + LIFTED:
            return None
        carriers = [b for b in met if b.flat and top - b.high < LEVEL and covers_point(b.outline, x, y)]
        return top if carriers else None

    def _is_carried(self, x: float, y: float, blocks: list[Block]) -> bool:
        return self._endless or any(b.flat and covers_point(b.outline, x, y) for b in blocks)

    # --- put down by a person ---

    def put(self, body: Body, x: float, y: float, yaw: float | None, bodies: Mapping[str, Body]) -> Rest:
        """Where a body lies that is put at (x, y) [m], with the middle of what it covers.

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
            place = self._nearest(outline, (x, y), math.inf, self._blocks(body, bodies), box)
            if place is None:
                raise Refused("container_full", f"{box.id} is full: there is no room for {body.name} in it")
            return self._rest(body, rotation, place, box.id)
        level = body.bottom if body.state == "table" and body.solid.shape != "sphere" else self._level(x, y)
        self._must_stand(body, outline + np.array([x, y]), (x, y), level, rotation, bodies)
        return self._rest(body, rotation, (x, y, level))

    def _put_sphere(self, at: Body, body: Body, x: float, y: float, bodies: Mapping[str, Body]) -> Rest:
        radius, table = body.solid.radius, self._table(body.solid.radius)
        if not table.carries(x, y):
            raise Refused("off_table", f"({x:g}, {y:g}) is not on the table: {table.extent()}")
        if blocker := table.blocked(x, y):
            raise Refused("occupied", f"{at.name} at ({x:g}, {y:g}) would reach into {blocker}")
        place = np.array([x, y, table.height + radius])
        for other, there, r in self._spheres(body, bodies):
            distance = float(np.linalg.norm(there - place))
            if distance < radius + r - 1e-9:
                raise Refused("occupied", f"({x:g}, {y:g}) overlaps {other}: {distance * 1000:.0f} mm between "
                                          f"centres, at least {(radius + r) * 1000:.0f} are needed")
        point = np.array([[x, y]])
        for block in self._blocks_of(body, bodies):
            if not table.free(point, np.empty((0, 2)), outlines=[block.outline])[0]:
                raise Refused("occupied", f"{at.name} at ({x:g}, {y:g}) would reach into {block.id}")
        return Rest(transform(body.T[:3, :3], place))

    def _level(self, x: float, y: float) -> float:
        """Height of the highest fixture that carries something there [m]."""
        tops = [b.high for b in self._fixtures if b.flat and covers_point(b.outline, x, y)]
        return max([*tops, self._world.table_height]) if self._endless or not tops else max(tops)

    def _must_stand(
        self, body: Body, outline: Array, at: tuple[float, float], level: float, rotation: Array,
        bodies: Mapping[str, Body],
    ) -> None:
        carriers = [b for b in self._fixtures if b.flat and abs(b.high - level) < LEVEL]
        if carriers and not any(within(outline, b.outline) for b in carriers):
            across, along = np.ptp(outline, axis=0)
            extents = []
            for b in carriers:
                (left, near), (right, far) = b.outline.min(axis=0), b.outline.max(axis=0)
                extents.append(f"{b.id} is x {left:g} to {right:g}, y {near:g} to {far:g}")
            raise Refused("off_table", f"({at[0]:g}, {at[1]:g}) is not on the table for {body.name}, which takes "
                                       f"{across:.3g} x {along:.3g} m: {' or '.join(extents)}")
        low = level + LEVEL
        high = level + body.solid.highest(rotation) - body.solid.lowest(rotation) - LEVEL
        for block in [*self._fixtures, *self._panels, *(b.block() for b in self._resting(body, bodies))]:
            if block.low < high and block.high > low and block.reaches(outline):
                raise Refused("occupied", f"{body.name} at ({at[0]:g}, {at[1]:g}) would reach into {block.id}")

    # --- what there is ---

    def container_of(self, body: Body) -> str:
        """The id of the container in which a body lies as a world's file has it; empty when in none."""
        x, y = body.T[:2, 3]
        rim = self._world.table_height
        return next((c.id for c in self._containers
                     if is_inside(c, x, y) and rim - LEVEL < body.bottom < rim + c.wall_height), "")

    def _rest(
        self, body: Body, rotation: Array, place: tuple[float, float, float], container: str = "",
        state: State = "table",
    ) -> Rest:
        """There with the middle of its outline."""
        x, y, height = place
        _, middle = _centred(body.solid.footprint(rotation))
        x, y = x - float(middle[0]), y - float(middle[1])
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

    def _spheres(self, but: Body, bodies: Mapping[str, Body]) -> list[tuple[str, Array, float]]:
        """Centres (3,) and radii of spheres on the table, of those that fall to it, and of what is held."""
        return [(b.name, b.lying[:3, 3], b.solid.radius) for b in bodies.values()
                if b.name != but.name and b.solid.shape == "sphere" and not b.container_taken]

    def _resting(self, but: Body, bodies: Mapping[str, Body]) -> Iterable[Body]:
        return (b for b in bodies.values() if b.name != but.name and b.state not in ("held", "elsewhere"))

    def _blocks_of(self, but: Body, bodies: Mapping[str, Body]) -> list[Block]:
        """What lies on the table and is no sphere, outside of containers."""
        return [b.block() for b in self._resting(but, bodies)
                if b.solid.shape != "sphere" and not b.container_taken and b.bottom < self._world.table_height + 0.2]

    def _blocks(self, but: Body, bodies: Mapping[str, Body]) -> list[Block]:
        return [*self._fixtures, *self._panels, *(b.block() for b in self._resting(but, bodies))]


def _centred(outline: Array) -> tuple[Array, Array]:
    """An outline (N, 2) about the middle (2,) of the box around it, and that middle [m]."""
    middle = (outline.min(axis=0) + outline.max(axis=0)) / 2
    return outline - middle, middle


def _panels(box: Container, table_height: float) -> list[Block]:
    """The floor and the four walls of a container."""
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
