"""Publish the planning scene of the sorting cell: what the depth camera sees, and the object in the gripper."""

from __future__ import annotations

import asyncio

import numpy as np
import numpy.typing as npt
from pydantic import Field

from applications.sorting.scene import SortingScene
from applications.sorting.topics import HEAP
from common import topics
from common.config import Parameters, RobotConfig, Surroundings
from common.errors import ConfigError
from common.process.planning_scene import SceneWriter
from common.process.service import main
from common.robot.model import RobotModel
from common.transport.bus import Bus


class Config(Parameters):
    """The container that objects are taken from."""

    tray: str = Field("tray", description="id of the container that objects are taken from")
    robot: RobotConfig
    world: Surroundings


async def run(bus: Bus, config: Config) -> None:
    """Publish the planning scene after each image and each change of what the gripper holds."""
    heaps, joints = bus.reader(HEAP), bus.reader(topics.JOINT_STATES)
    gripper = bus.reader(topics.GRIPPER_STATE)
    out = SceneWriter(bus)
    robot = RobotModel.load(config.robot)
    if config.robot.gripper is None:
        raise ConfigError("robot.gripper", ..., "is missing: sorting_scene needs a robot with one")
    scene = SortingScene(config.world, config.robot.tcp_link, config.tray)
    await out.begin(scene.scene())
    await bus.ready()

    def tool() -> npt.NDArray[np.float64] | None:
        measured = joints.latest
        q = robot.order(measured.name, measured.position) if measured else None
        return robot.fk(q) if q is not None else None

    async def watch_gripper() -> None:
        async for state in gripper:
            if scene.update_gripper(state, tool()):
                out.put(scene.scene())

    async def watch_heap() -> None:
        async for heap in heaps:
            scene.update_heap(heap, tool())
            if gripper.latest is not None:  # the tool may have been unknown before
                scene.update_gripper(gripper.latest, tool())
            out.put(scene.scene())

    async with asyncio.TaskGroup() as group:
        group.create_task(watch_gripper())
        group.create_task(watch_heap())


if __name__ == "__main__":
    main(run, Config)
