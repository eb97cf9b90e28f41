"""Publish the images of a camera of ROS 2 as the cell's camera (extra `ros2`)."""

from __future__ import annotations

import asyncio
import contextlib

from pydantic import Field

from bridges.ros2.inputs import SILENCE, Input, InputConfig, ProblemLog, inputs, usable_endpoint
from common import topics
from common.config import Surroundings
from common.process.service import main
from common.transport.bus import Bus

INFO = "camera_info"


class Config(InputConfig):
    """Topics of the camera. Its pose and frame are those of the world's camera."""

    world: Surroundings
    topic: str = Field("", max_length=200, description="of sensor_msgs/Image, such as /camera/image_raw")
    info: str = Field("", max_length=200, description="of sensor_msgs/CameraInfo; empty: the camera_info next to it")
    rectified: bool = Field(False, description="the images are rectified (image_rect): intrinsics are those of P; "
                                               "false: distortion of camera_info is removed here")


async def run(bus: Bus, config: Config) -> None:
    """Publish images with the stamps of ROS as they arrive.

    Raises:
        ConfigError: no topic is named, a package is missing, or the cell is secured.
    """
    images, infos = bus.writer(topics.CAMERA_IMAGE), bus.writer(topics.CAMERA_INFO)
    endpoint = usable_endpoint(bus, config, config.topic)
    await bus.ready()
    from bridges.ros2.camera import Camera, Unusable

    camera = Camera(config.world.camera.frame, config.rectified)
    problems = ProblemLog(bus, config.topic, config.domain)
    calibrated = asyncio.Event()
    info = config.info or f"{config.topic.rpartition('/')[0]}/{INFO}"

    async def calibrate(calibrations: Input) -> None:
        unusable = ProblemLog(bus, info, config.domain)
        while True:
            try:
                if (found := camera.calibrate(await calibrations.next())) is not None:
                    infos.put(found)
                    calibrated.set()
            except (Unusable, ValueError) as error:
                unusable.left_out(str(error))

    async def show(pictures: Input) -> None:
        with contextlib.suppress(TimeoutError):  # images often come first
            async with asyncio.timeout(SILENCE):
                await calibrated.wait()
        while True:
            try:
                async with asyncio.timeout(SILENCE):
                    message = await pictures.next()
                image = await asyncio.to_thread(camera.convert, message, config.topic)
            except TimeoutError:
                problems.left_out(f"no image for {SILENCE:g} s: is its node up, with rmw_zenoh on the same router?")
            except (Unusable, ValueError) as error:
                problems.left_out(str(error))
            else:
                images.put(image)
                problems.used(image.header.stamp)

    wanted = (config.topic, "sensor_msgs/msg/Image"), (info, "sensor_msgs/msg/CameraInfo")
    async with inputs(bus, endpoint, config.domain, *wanted) as (pictures, calibrations), asyncio.TaskGroup() as group:
        group.create_task(calibrate(calibrations))
        group.create_task(show(pictures))


if __name__ == "__main__":
    main(run, Config)
