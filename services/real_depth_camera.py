"""Publish color and depth of a real camera, read by a driver."""

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
from common.process.service import main
from common.process.timing import DeviceGone, Reopening, run_with_reopening
from common.transport.bus import Bus

CLOSING = 5.0  # [s] timeout for closing a camera


class Config(Reopening):
    """Driver of the camera. Pose and frame are those of the world's camera; the driver reports the intrinsics."""

    world: Surroundings
    driver: str = Field("", description="realsense, oak, or a dotted module: docs/depth_camera.md")
    options: dict[str, Any] = Field({}, description="of the driver")
    rate: Tunable[float] = Field(10.0, gt=0, le=90, description="frames per second of wall time at most [Hz]")


async def run(bus: Bus, config: Config) -> None:
    """Publish frames as they arrive, limited to the rate; reopen a camera that vanishes."""
    images, depths = bus.writer(topics.DEPTH_CAMERA_IMAGE), bus.writer(topics.DEPTH_CAMERA_DEPTH)
    points, infos = bus.writer(topics.DEPTH_CAMERA_POINTS), bus.writer(topics.DEPTH_CAMERA_INFO)
    field = f"services.{bus.service}.driver"
    driver, options = find_camera_driver(config.driver, config.options, field)
    requested, frame = config.world.camera, config.world.camera.frame
    await bus.ready()

    async def send(camera: DepthSource) -> DeviceGone:
        """Publish frames until the camera is lost."""
        loop, sent, last, newest = asyncio.get_running_loop(), 0, -math.inf, 0
        lens = camera.lens
        pinhole = Pinhole(lens.fx, lens.fy, lens.cx, lens.cy, lens.width, lens.height, camera_in_mount(requested))
        while True:
            try:
                shot = await asyncio.to_thread(camera.read)
            except CameraLost as error:
                return DeviceGone(f"camera {config.driver}: {error}", sent)
            require_frame_shape(shot, lens, field, config.driver)
            since = (loop.time() - last) * config.rate  # periods since the last frame was due
            if since < 0.5:
                continue  # read at the camera's own rate, or old frames queue up
            last = last + 1 / config.rate if since < 2 else loop.time()
            header = bus.header(frame)
            newest = max(newest + 1, header.stamp - round(max(shot.age, 0.0) * 1e9))  # stamps increase
            header = header.model_copy(update={"stamp": newest})
            if not sent:
                infos.put(pinhole.info(header))
            # Depth first: a client with the image has its depth.
            depths.put(array_to_image(shot.depth, "32FC1", header))
            images.put(array_to_image(shot.colour, "bgr8", header))
            if points.matched:
                points.put(point_cloud(shot.colour, shot.depth, pinhole, header))
            sent += 1

    async def open_and_send() -> DeviceGone:
        try:
            size = (requested.width, requested.height)
            camera = await asyncio.to_thread(driver.open_camera, options, size, config.rate)
        except CameraLost as error:
            return DeviceGone(f"camera {config.driver}: {error}")
        # Not closed on cancellation: a thread may still wait for a frame in `read`.
        lost = await send(camera)
        try:
            async with asyncio.timeout(CLOSING):
                await asyncio.to_thread(camera.close)
        except TimeoutError:
            bus.log.warning("camera %s does not close after it was lost", config.driver)
        return lost

    await run_with_reopening(open_and_send, config, bus.log)


if __name__ == "__main__":
    main(run, Config)
