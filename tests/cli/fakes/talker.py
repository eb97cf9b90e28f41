"""Publishes frames and old images, and answers requests of the task."""

import asyncio

from pydantic import Field

from common import messages as m
from common import topics
from common.config import Parameters
from common.errors import Refused
from common.process.service import main
from common.transport.bus import Bus

AGE = 0.4  # [s] of cell time: how old images are when they are published


class Config(Parameters):
    """How it looks."""

    width: int = Field(4, ge=1, description="of an image [px]")


async def run(bus: Bus, config: Config) -> None:
    async def answer(request: m.TaskCommand) -> m.TaskStatus:
        if request.command == "stop":
            raise Refused("busy", "not now")
        if request.command == "resume":
            await asyncio.Event().wait()
        return m.TaskStatus(header=bus.header(), paused=request.command == "pause")

    async def stop(request: m.StopRequest) -> m.MotionStatus:
        unsaved = m.Interlock(kind="stopped", by="anna", reason="not saved on disk (it is full)", since=1)
        return m.MotionStatus(header=bus.header(), interlocks=[unsaved])

    def transform(parent: str, child: str, x: float) -> m.TransformStamped:
        pose = m.Pose(position=m.Vector3(x=x))
        return m.TransformStamped(header=bus.header(parent), child_frame_id=child, transform=pose)

    images, fixed, moving = bus.writer(topics.CAMERA_IMAGE), bus.writer(topics.TF_STATIC), bus.writer(topics.TF)
    bus.reader(topics.GRIPPER_STATE)
    bus.client(topics.WORLD_EDIT)
    bus.serve(topics.TASK_COMMAND, answer)
    bus.serve(topics.MOTION_STOP, stop)
    fixed.put(m.TFMessage(transforms=[transform("world", "base", 1.0), transform("map", "cart", 0.5)]))
    await bus.ready()
    while True:
        moving.put(m.TFMessage(transforms=[transform("base", "hand", 0.25)]))
        header = m.Header(stamp=bus.clock.now_ns() - int(AGE * 1e9), frame_id="camera")
        pixels = bytes(9 * config.width)
        images.put(m.Image(header=header, height=3, width=config.width, encoding="bgr8", data=pixels))
        await asyncio.sleep(0.05)


if __name__ == "__main__":
    main(run, Config)
