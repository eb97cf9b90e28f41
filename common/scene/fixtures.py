"""Solids that no camera sees: fixtures, containers with their slots for equal spheres, and solids of operators."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from common import messages as m
from common.config import Container, Rgb, Surroundings
from common.errors import Refused
from common.messages import CollisionObject, SceneEdit
from common.messages.scene import MAX_ADDED
from common.perception.pinhole import Pinhole
from common.robot.transforms import matrix_to_pose, rpy_to_matrix, transform

Array = NDArray[np.float64]


def color_of(rgb: Rgb) -> m.Color:
    """Return an opaque colour."""
    return m.Color(r=rgb[0], g=rgb[1], b=rgb[2])


def fixed_objects(around: Surroundings) -> list[m.CollisionObject]:
    """Return all solids that never move, poses in world."""
    panels = [panel for box in around.containers.values() for panel in container_panels(box, around.table_height)]
    return fixture_objects(around) + panels


def fixture_objects(around: Surroundings) -> list[m.CollisionObject]:
    """Return the fixtures without containers, for cells that fill none."""
    return [
        m.CollisionObject(
            id=f.id, role="fixture", shape=f.shape, dimensions=list(f.dimensions), color=color_of(f.color),
            pose=matrix_to_pose(transform(rpy_to_matrix(*f.rpy), f.position)),
        )
        for f in around.fixtures
    ]


def container_panels(box: Container, table_height: float) -> list[m.CollisionObject]:
    """Return floor and four walls of a container on the table at `table_height` [m]."""
    inner = box.half_side - box.wall_thickness / 2
    side = 2 * box.half_side
    wall_z, floor_z = table_height + box.wall_height / 2, table_height + box.floor_thickness / 2
    panels = {
        "floor": ((0.0, 0.0, floor_z), (side, side, box.floor_thickness)),
        "wall_front": ((-inner, 0.0, wall_z), (box.wall_thickness, side, box.wall_height)),
        "wall_back": ((inner, 0.0, wall_z), (box.wall_thickness, side, box.wall_height)),
        "wall_right": ((0.0, -inner, wall_z), (side, box.wall_thickness, box.wall_height)),
        "wall_left": ((0.0, inner, wall_z), (side, box.wall_thickness, box.wall_height)),
    }
    return [
        m.CollisionObject(
            id=f"{box.id}_{name}", role="container", shape="box", dimensions=list(size), color=color_of(box.color),
            pose=m.Pose(position=m.Vector3(x=box.x + at[0], y=box.y + at[1], z=at[2])),
        )
        for name, (at, size) in panels.items()
    ]


def slot_positions(box: Container, radius: float, table_height: float) -> Array:
    """Return centres (layers, 4, 3) [m], world, of the spheres that fill the container: 2 x 2 in each layer.

    Each layer is straight above the one below it.
    """
    d = box.slot_offset
    corners = [(-d, -d), (-d, d), (d, -d), (d, d)]
    lowest = table_height + box.floor_thickness + radius
    return np.array([
        [(box.x + dx, box.y + dy, lowest + 2 * radius * layer) for dx, dy in corners] for layer in range(box.layers)
    ])


def column_at(box: Container, place: tuple[float, float]) -> tuple[float, float]:
    """Return (x, y) of the column of slots nearest to a position [m], world."""
    d = box.slot_offset
    return box.x + (d if place[0] > box.x else -d), box.y + (d if place[1] > box.y else -d)


def low_columns(box: Container, places: Iterable[tuple[float, float, float]], same: float) -> list[tuple[float, float]]:
    """Return (x, y) of the lowest columns of slots, which may be all of them [m], world.

    Args:
        box: the container.
        places: centres of what lies in it or will soon [m], world; each belongs to the nearest column.
        same: columns whose highest centres differ by less count as equally high [m].
    """
    d = box.slot_offset
    heights = {(box.x + dx, box.y + dy): -np.inf for dx in (-d, d) for dy in (-d, d)}
    for x, y, z in places:
        if max(abs(x - box.x), abs(y - box.y)) <= box.half_side:
            column = column_at(box, (x, y))
            heights[column] = max(heights[column], z)
    least = min(heights.values())
    return [column for column, height in heights.items() if height == least or height - least < same]


def occupied_slots(
    pixels: Iterable[tuple[float, float]], camera: Pinhole, slots: Array, radius: float, free: Collection[int] = ()
) -> tuple[set[int], set[int]]:
    """Return the indices of slots with a sphere that is seen, and of slots with an occluded one.

    Each seen sphere belongs to the slot whose centre is imaged nearest to it, the nearest pairs first, one to one.
    Below a seen sphere there are those that carry it, though they are occluded; but none in a slot that is known to be
    free: a sphere above it hangs or falls.

    Args:
        pixels: (u, v) of the spheres that are seen inside the container.
        camera: with its pose in world.
        slots: (n, 3) [m], world, in the order of `slot_positions`.
        radius: of a sphere [m].
        free: slots that contain a sphere only if it is seen.
    """
    images = camera.project(slots)
    seen = np.array(list(pixels)).reshape(-1, 2)
    reach = camera.fx * radius / float(np.min(camera.to_camera(slots)[:, 2]))
    away = images[:, None] - seen
    distances = np.hypot(away[..., 0], away[..., 1])
    near = np.argwhere(distances <= reach).tolist()
    taken: set[int] = set()
    matched: set[int] = set()
    for slot, number in sorted(near, key=lambda pair: distances[pair[0], pair[1]]):
        if slot in taken or number in matched:
            continue
        taken.add(slot)
        matched.add(number)
    carriers = {slot - 4 * below for slot in taken for below in range(1, slot // 4 + 1)}
    return taken, carriers - taken - set(free)


PREFIX = "added/"  # of their ids in the planning scene


class AddedSolids(BaseModel):
    """All added solids, as persisted across restarts of the service that publishes the scene."""

    model_config = ConfigDict(extra="forbid")

    version: Literal[1] = 1
    solids: list[CollisionObject] = Field([], max_length=MAX_ADDED)

    @property
    def ids(self) -> list[str]:
        """Their ids in the planning scene."""
        return [solid.id for solid in self.solids]

    def apply(self, edit: SceneEdit, perceived: Iterable[str] = ()) -> AddedSolids:
        """Return the solids after an edit; repeating an edit changes nothing.

        Args:
            edit: a validated one.
            perceived: ids of all other objects of the planning scene.

        Raises:
            Refused: `exists`, `unknown` or `too_many`.
        """
        name = added_id(edit.id)
        existing = next((solid for solid in self.solids if solid.id == name), None)
        others = [solid for solid in self.solids if solid is not existing]
        if edit.op == "remove":
            if existing is None:
                raise Refused("unknown", f"no added solid is called {name}; there are: {', '.join(self.ids) or 'none'}")
            return AddedSolids(solids=others)
        solid = CollisionObject.model_validate({
            "id": name, "role": "fixture", "shape": edit.shape, "dimensions": edit.dimensions, "pose": edit.pose,
            "color": edit.color})
        if solid == existing:
            return self
        if existing is not None or name in perceived:
            raise Refused("exists", f"another solid is called {name} already: remove it first")
        if len(others) >= MAX_ADDED:
            raise Refused("too_many", f"{MAX_ADDED} solids were added already: remove some first")
        return AddedSolids(solids=[*others, solid])


def added_id(name: str) -> str:
    """Return the id in the planning scene of a solid that an operator named."""
    return name if name.startswith(PREFIX) else PREFIX + name


def added_solids(objects: Iterable[CollisionObject]) -> list[CollisionObject]:
    """Return those objects of a planning scene that an operator added."""
    return [item for item in objects if item.id.startswith(PREFIX)]
