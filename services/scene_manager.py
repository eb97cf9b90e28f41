"""Keeps the planning scene: fixtures, perceived objects with ids of its own, the one in the hand, those in boxes."""

from __future__ import annotations

import asyncio

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from applications.pick_place.detections import CameraDetections, DetectionViews, ViewsParameters
from applications.pick_place.perceived_scene import PerceivedScene, SceneParameters
from common import topics
from common.config import RobotConfig, Surroundings
from common.errors import ConfigError
from common.perception.camera_input import FrameError, SkippedFrames
from common.process.planning_scene import SceneWriter
from common.process.service import main
from common.robot.model import RobotModel
from common.transport.bus import Bus


class Config(ViewsParameters, SceneParameters):
    """Parameters of the tracking and the sections that it needs."""

    only_at_home: bool = Field(False, description="only pictures count that were taken with the arm at home: for a "
                                                  "camera before which the arm hides what lies there")
    robot: RobotConfig
    world: Surroundings


async def run(bus: Bus, config: Config) -> None:
    """Publish the planning scene whenever a frame was looked at or the hand closed or opened."""
    views = DetectionViews(bus, config.views, config.world, config.robot, bus.log, only_at_home=config.only_at_home)
    joints = bus.reader(topics.JOINT_STATES)
    gripper = bus.reader(topics.GRIPPER_STATE)
    out = SceneWriter(bus)
    robot = RobotModel.load(config.robot)
    if config.robot.gripper is None:
        raise ConfigError("robot.gripper", ..., "is missing: scene_manager needs a robot with one")
    scene = PerceivedScene(config, config.world, config.robot.gripper, config.robot.tcp_link)
    left_out = SkippedFrames(bus.log, "planning scene")
    await out.begin(scene.scene())
    await bus.ready()

    def hand() -> NDArray[np.float64] | None:
        """Feel before every look: what the hand does now decides what a frame means. Returns T_world_tcp, if known."""
        state, measured = gripper.latest, joints.latest
        q = robot.order(measured.name, measured.position) if measured else None
        T_world_tcp = robot.fk(q) if q is not None else None
        if state is not None:
            scene.update_gripper(state, T_world_tcp)
        return T_world_tcp

    async def watch_hand() -> None:
        held: bool | None = None
        async for state in gripper:
            if state.holding != held:
                held = state.holding
                hand()
                out.put(scene.scene())

    async def look(view: int, seen: CameraDetections) -> None:
        scene.update_detections(seen.frame, seen.camera, hand(), view, seen.at_times, seen.hidden)
        if scene.crowded:  # none without some of what stands in the way: who waits for a newer one moves nothing
            left_out.note(FrameError("crowded", "more is seen than a planning scene has room for"))
        else:
            out.put(scene.scene())

    async with asyncio.TaskGroup() as group:
        group.create_task(watch_hand())
        group.create_task(views.watch(look))


if __name__ == "__main__":
    main(run, Config)
