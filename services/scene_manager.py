"""Keeps the planning scene: fixtures, perceived balls with ids of its own, the ball in the hand, balls in the box."""

from __future__ import annotations

import asyncio

from common import messages as m
from common import topics
from common.config import RobotConfig, Surroundings
from common.perception.pinhole import Pinhole
from common.robot.model import RobotModel
from common.robot.transforms import pose_to_matrix
from common.scene.perceived import PerceivedScene, SceneParameters
from common.transport.bus import Bus
from common.transport.service import main


class Config(SceneParameters):
    """Parameters of the tracking and the sections that it needs."""

    robot: RobotConfig
    world: Surroundings


async def run(bus: Bus, config: Config) -> None:
    """Publish the planning scene whenever a frame was looked at or the hand closed or opened."""
    detected = bus.reader(topics.DETECTED_OBJECTS)
    infos = bus.reader(topics.CAMERA_INFO)
    statics = bus.reader(topics.TF_STATIC)
    joints = bus.reader(topics.JOINT_STATES)
    gripper = bus.reader(topics.GRIPPER_STATE)
    out = bus.writer(topics.PLANNING_SCENE)
    robot = RobotModel.load(config.robot)
    if config.robot.gripper is None:
        raise ValueError("the scene manager needs a robot with a gripper")
    scene = PerceivedScene(config, config.world, config.robot.gripper, config.robot.tcp_link)
    out.put(scene.scene())
    await bus.ready()

    def hand() -> None:
        """Feel before every look: what the hand does now decides what a frame means."""
        state, measured = gripper.latest, joints.latest
        if state is not None:
            q = robot.order(measured.name, measured.position) if measured else None
            scene.feel(state, robot.fk(q) if q is not None else None)

    async def watch_hand() -> None:
        held: bool | None = None
        async for state in gripper:
            if state.holding != held:
                held = state.holding
                hand()
                out.put(scene.scene())

    async def watch_table() -> None:
        async for markers in detected:
            camera = _camera(infos.latest, statics.latest, config.world.camera.frame)
            if camera is None:
                continue
            hand()
            measured = joints.latest
            q = robot.order(measured.name, measured.position) if measured else None
            scene.see(markers, camera, robot.fk(q) if q is not None else None)
            out.put(scene.scene())

    async with asyncio.TaskGroup() as group:
        group.create_task(watch_hand())
        group.create_task(watch_table())


def _camera(info: m.CameraInfo | None, statics: m.TFMessage | None, frame: str) -> Pinhole | None:
    """The camera as camera_info and tf describe it, once both are known."""
    pose = next((t.transform for t in statics.transforms if t.child_frame_id == frame), None) if statics else None
    return Pinhole.from_info(info, pose_to_matrix(pose)) if info and pose else None


if __name__ == "__main__":
    main(run, Config)
