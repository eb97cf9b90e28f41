"""A kinematic world with a gripper and a clock that tests drive by hand."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from applications.pick_place.topics import scene_balls
from common.config import Container, Fixture, World
from common.messages import Header, Vector3, WorldEdit, WorldObject
from common.robot.transforms import pose_to_matrix, tool_down
from common.sim.kinematic import KinematicWorld

R = 0.03  # radius of balls [m]
OPEN, GRIP = 0.08, 2 * R
TABLE = Fixture(id="table", dimensions=[1.0, 1.0, 0.05], position=(0.5, 0.0, -0.025))
BOX = (0.55, 0.25)  # center of the container of a world with balls
CUBE = {"shape": "box", "size": [0.04, 0.04, 0.04]}
L_SHAPE = [(-0.02, -0.02), (0.03, -0.02), (0.03, 0.0), (0.0, 0.0), (0.0, 0.03), (-0.02, 0.03)]
SHAPES: dict[str, dict[str, Any]] = {
    "sphere": {"shape": "sphere", "radius": 0.02},
    "box": {"shape": "box", "size": [0.03, 0.05, 0.04]},
    "cylinder": {"shape": "cylinder", "radius": 0.025, "height": 0.06},
    "prism": {"shape": "prism", "polygon": L_SHAPE, "height": 0.04},
    "ring": {"shape": "ring", "radius": 0.03, "inner_radius": 0.02, "height": 0.03},
}


class Rig:
    """A table with objects `object_N` and the containers `left` and `right`, and an open gripper above it."""

    def __init__(self, *objects: dict[str, Any], config: World | None = None) -> None:
        described = [{"id": f"object_{i + 1}", "x": 0.4, "y": 0.0, **values} for i, values in enumerate(objects)]
        containers = {"left": Container(x=0.6, y=0.3), "right": Container(x=0.6, y=-0.3)}
        self.config = config or World.model_validate(
            {"fixtures": [TABLE], "containers": containers, "objects": described})
        self.world = KinematicWorld(self.config)
        self.now, self.tool, self.width = 100.0, tool_down(0.5, 0.0, 0.3), OPEN

    @classmethod
    def with_balls(cls, *spots: tuple[float, float]) -> Rig:
        """Balls `ball_N` on the table, by default one at (0.5, 0), and the container `box`."""
        return cls(config=World(fixtures=[TABLE], balls=list(spots) or [(0.5, 0.0)]))

    @classmethod
    def holding_ball(cls, *spots: tuple[float, float]) -> Rig:
        """With balls, the first of them in the gripper."""
        rig = cls.with_balls(*spots)
        rig.grasp(*(spots[0] if spots else (0.5, 0.0)))
        return rig

    @classmethod
    def holding_cube(cls, *others: dict[str, Any]) -> Rig:
        """With a cube in the gripper and further objects."""
        rig = cls(CUBE, *others)
        rig.grasp(0.4, 0.0, 0.02)
        return rig

    def tick(self, tool: Any = None, width: float | None = None) -> None:
        """Run one control cycle with simulated fingers."""
        self.now += 0.01
        self.tool = self.tool if tool is None else tool
        obstruction = self.world.obstruction(self.tool, self.width)
        target = self.width if width is None else width
        self.width = max(target, obstruction)
        self.world.tick(self.now, self.tool, self.width, obstruction > target)

    def grasp(self, x: float, y: float, z: float = R, yaw: float = 0.0) -> str:
        """Close the fingers there; return the id of the held object."""
        self.tick(tool_down(x, y, z, yaw), OPEN)
        for width in np.linspace(OPEN, 0.0, 9):
            self.tick(width=float(width))
        return self.world.held

    def release(self, x: float, y: float, z: float = 0.2, yaw: float = 0.0) -> None:
        self.tick(tool_down(x, y, z, yaw), 0.0)
        self.tick(width=OPEN)

    def settle(self) -> None:
        for _ in range(100):
            self.tick()

    def put_down(self, x: float, y: float, z: float = 0.2, yaw: float = 0.0) -> None:
        self.release(x, y, z, yaw)
        self.settle()

    def edit(self, op: str, name: str = "", at: Sequence[float] | None = None, **fields: Any) -> str:
        position = Vector3(x=at[0], y=at[1]) if at else None
        return self.world.edit(WorldEdit.model_validate({"op": op, "id": name, "position": position, **fields}),
                               self.now)

    def events(self) -> list[str]:
        return [update.data for update in self.world.take_events()]

    def objects(self) -> dict[str, WorldObject]:
        return {obj.id: obj for obj in self.world.objects(Header()).objects}

    def object(self, name: str = "object_1") -> WorldObject:
        return self.objects()[name]

    def pose(self, name: str = "object_1") -> Any:
        return pose_to_matrix(self.object(name).pose)

    def place(self, name: str = "object_1") -> Any:
        """Position (3,) [m] of an object."""
        return self.pose(name)[:3, 3]

    def balls(self) -> dict[str, tuple[str, Any]]:
        """State and position of each ball."""
        balls = scene_balls(self.world.objects(Header()))
        return {i: (label, np.array([p.position.x, p.position.y, p.position.z]))
                for i, label, p in zip(balls.ids, balls.labels, balls.poses, strict=True)}

    def ball(self, number: int = 1) -> tuple[str, Any]:
        return self.balls()[f"ball_{number}"]
