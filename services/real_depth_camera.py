"""Sends the pictures and the depth of a real camera, which a driver reads."""

from __future__ import annotations

import asyncio
import math
from typing import Any

from pydantic import Field

from common import topics
from common.config import Surroundings, Tunable
from common.perception.depth import point_cloud
from common.perception.depth_drivers import CameraLost, DepthSource, find_camera_driver, require_frame_shape
from common.perception.image import array_to_image
from common.perception.pinhole import Pinhole, camera_in_mount
from common.process.reopening import Gone, Reopening, keep_open
from common.process.service import main
from common.transport.bus import Bus

CLOSING = 5.0  # [s] after which a camera that hangs is left to itself


class Config(Reopening):
    """Which camera it is. Its pose and the name of its frame are those of the world's camera, the lens is its own."""

    world: Surroundings
    driver: str = Field("", description="realsense, oak, or a dotted module of yours: docs/depth_camera.md")
    options: dict[str, Any] = Field({}, description="of the driver")
    rate: Tunable[float] = Field(10.0, gt=0, le=90, description="pictures per second of wall time at most [Hz]")


async def run(bus: Bus, config: Config) -> None:
    """Send shots as they come, at the rate at most; a camera that vanishes is opened again."""
    images, depths = bus.writer(topics.DEPTH_CAMERA_IMAGE), bus.writer(topics.DEPTH_CAMERA_DEPTH)
    points, infos = bus.writer(topics.DEPTH_CAMERA_POINTS), bus.writer(topics.DEPTH_CAMERA_INFO)
    field = f"services.{bus.service}.driver"
    driver, options = find_camera_driver(config.driver, config.options, field)
    wanted, frame = config.world.camera, config.world.camera.frame
    await bus.ready()

    async def send(camera: DepthSource) -> Gone:
        """Send what the camera gives until it gives no more."""
        loop, sent, last, newest = asyncio.get_running_loop(), 0, -math.inf, 0
        lens = camera.lens
        known = Pinhole(lens.fx, lens.fy, lens.cx, lens.cy, lens.width, lens.height, camera_in_mount(wanted))
        while True:
            try:
                shot = await asyncio.to_thread(camera.read)
            except CameraLost as error:
                return Gone(f"camera {config.driver}: {error}", sent)
            require_frame_shape(shot, lens, field, config.driver)
            since = (loop.time() - last) * config.rate  # periods since the last picture was due
            if since < 0.5:
                continue  # it is read at its own pace, or old pictures would wait in there
            last = last + 1 / config.rate if since < 2 else loop.time()
            header = bus.header(frame)
            newest = max(newest + 1, header.stamp - round(max(shot.age, 0.0) * 1e9))  # a stamp never goes back
            header = header.model_copy(update={"stamp": newest})
            if not sent:
                infos.put(known.info(header))
            depths.put(array_to_image(shot.depth, "32FC1", header))  # first: who has the picture has its depth
            images.put(array_to_image(shot.colour, "bgr8", header))
            if points.matched:
                points.put(point_cloud(shot.colour, shot.depth, known, header))
            sent += 1

    async def use() -> Gone:
        try:
            camera = await asyncio.to_thread(driver.open_camera, options, (wanted.width, wanted.height), config.rate)
        except CameraLost as error:
            return Gone(f"camera {config.driver}: {error}")
        # Not closed when this is cancelled: a thread may still be waiting for a picture in there.
        gone = await send(camera)
        try:
            async with asyncio.timeout(CLOSING):
                await asyncio.to_thread(camera.close)
        except TimeoutError:
            bus.log.warning("camera %s does not let go of what is gone", config.driver)
        return gone

    await keep_open(use, config, bus.log)


if __name__ == "__main__":
    main(run, Config)
