"""Solids that are known beforehand: fixtures, and containers as a floor and four walls each."""

from __future__ import annotations

from common import messages as m
from common.config import Container, Rgb, Surroundings
from common.robot.transforms import matrix_to_pose, rpy_to_matrix, transform


def color_of(rgb: Rgb) -> m.Color:
    """An opaque colour."""
    return m.Color(r=rgb[0], g=rgb[1], b=rgb[2])


def fixed_objects(around: Surroundings) -> list[m.CollisionObject]:
    """All solids that never move, poses in world."""
    panels = [panel for box in around.containers.values() for panel in container_panels(box, around.table_height)]
    return fixture_objects(around) + panels


def fixture_objects(around: Surroundings) -> list[m.CollisionObject]:
    """The fixtures, without containers: a cell that fills none has none."""
    return [
        m.CollisionObject(
            id=f.id, role="fixture", shape=f.shape, dimensions=list(f.dimensions), color=color_of(f.color),
            pose=matrix_to_pose(transform(rpy_to_matrix(*f.rpy), f.position)),
        )
        for f in around.fixtures
    ]


def container_panels(box: Container, table_height: float) -> list[m.CollisionObject]:
    """Floor and four walls of the container, standing on the table at `table_height` [m]."""
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
