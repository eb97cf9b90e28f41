"""Maintains the planning scene: fixtures, detected objects with their own ids, attached ones, those in containers."""

from __future__ import annotations

import asyncio

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from applications.pick_place.detections import CameraDetections, DetectionViews, ViewsParameters
from applications.pick_place.perceived_scene import PerceivedScene
from applications.pick_place.tracks import SceneParameters
from common import topics
from common.config import Arms, RobotConfig, Surroundings
from common.errors import ConfigError
from common.perception.camera_input import FrameError, SkippedFrames
from common.perception.moving import Encoders
from common.process.other_arms import OtherArm
from common.process.planning_scene import SceneWriter
from common.process.service import main
from common.robot.model import RobotModel
from common.transport.bus import Bus

RETRY = 0.1  # [s] wall time until the held object is looked up again


class Config(ViewsParameters, SceneParameters):
    """Parameters of the tracking, and the sections that it needs."""

    only_at_home: bool = Field(False, description="use only images taken with the arm at home: for a camera whose "
                                                  "view the arm occludes otherwise")
    robot: RobotConfig
    arms: Arms = Arms()
    world: Surroundings


async def run(bus: Bus, config: Config) -> None:
    """Publish the planning scene after each detection message and each change of the gripper."""
    views = DetectionViews(bus, config.views, config.world, config.robot, config.arms, bus.log,
                           only_at_home=config.only_at_home)
    joints = bus.reader(topics.JOINT_STATES)
    gripper = bus.reader(topics.GRIPPER_STATE)
    others = [OtherArm(bus, name, other) for name, other in config.arms.robots.items()
              if config.arms.own not in ("", name)]
    out = SceneWriter(bus)
    robot = RobotModel.load(config.robot)
    if config.robot.gripper is None:
        raise ConfigError("robot.gripper", ..., "is missing: scene_manager needs a robot with one")
    encoders = Encoders(config.world.conveyors) if config.world.conveyors else None
    belts = bus.reader(topics.CONVEYOR_STATE) if encoders is not None else None
    scene = PerceivedScene(config, config.world, config.robot.gripper, config.robot.tcp_link, encoders)
    skipped = SkippedFrames(bus.log, "planning scene")
    await out.begin(scene.scene())
    await bus.ready()

    def update_gripper() -> NDArray[np.float64] | None:
        """Apply the gripper state, which decides how detections are interpreted; return T_world_tcp if known."""
        state, measured = gripper.latest, joints.latest
        q = robot.order(measured.name, measured.position) if measured else None
        T_world_tcp = robot.fk(q) if q is not None else None
        known = [arm.now() for arm in others]
        scene.held_by_others = [one.holds for one in known if one is not None and one.holds is not None]
        if state is not None:
            scene.update_gripper(state, T_world_tcp)
        return T_world_tcp

    async def watch_gripper() -> None:
        async for _ in gripper:
            while True:
                before = scene.held
                update_gripper()
                if scene.held is not before:
                    out.put(scene.scene())
                assert gripper.latest is not None
                if not (gripper.latest.holding and (scene.held is None or (others and scene.is_undetected))):
                    break
                await asyncio.sleep(RETRY)  # after a restart joints and other arms are known later than the gripper

    async def update(view: int, seen: CameraDetections) -> None:
        scene.update_detections(seen.frame, seen.camera, update_gripper(), view, seen.at_times, seen.hidden)
        if scene.crowded:  # publish no scene without some obstacles: clients that wait for a newer one do not move
            skipped.note(FrameError("crowded", "more objects are detected than a planning scene can contain"))
        else:
            out.put(scene.scene())

    async def watch_belts() -> None:
        if encoders is not None and belts is not None:
            async for state in belts:
                encoders.add(state)

    async with asyncio.TaskGroup() as group:
        group.create_task(watch_belts())
        group.create_task(watch_gripper())
        group.create_task(views.watch(update))


if __name__ == "__main__":
    main(run, Config)
