"""Publish rectified images of a real camera, a video file or an image folder."""

from __future__ import annotations

import asyncio
import math

from pydantic import Field

from common import topics
from common.config import Surroundings, Tunable
from common.errors import ConfigError
from common.messages import CameraInfo
from common.perception.camera_file import CameraFile, Rectifier, require_size
from common.perception.image import array_to_image
from common.perception.image_sources import Source, open_source
from common.process.service import main
from common.process.timing import DeviceGone, LoopRate, Reopening, run_with_reopening
from common.transport.bus import Bus


class Config(Reopening):
    """Source of the images. The pose of the camera is that of the world's camera."""

    world: Surroundings
    source: str | int = Field("/dev/video0", description="device number or path, video file, or folder of images")
    intrinsics: str = Field(
        "", description="YAML file with width, height, fx, fy, cx, cy [px] and distortion d, for a camera at the "
                        "pose of the world's camera; empty: the world's camera, also a file of `zencell calibrate`"
    )
    rectify: bool = Field(True, description="remove lens distortion; false publishes distorted images and d in "
                                            "camera_info, for recording: the detectors reject them")
    rate: Tunable[float] = Field(10.0, gt=0, le=250, description="images per second of wall time at most [Hz]")
    loop: bool = Field(True, description="restart a file or folder at its end")


def calibrated(config: Config) -> CameraFile:
    """Return the camera's intrinsics.

    Raises:
        ConfigError: their file is invalid, or holds another pose than the world's camera.
    """
    world = CameraFile.of(config.world.camera)
    if not config.intrinsics:
        return world
    camera = CameraFile.load(config.intrinsics)
    if camera.position is not None and (camera.mount or "", camera.position, camera.rpy or world.rpy) != (
            world.mount or "", world.position, world.rpy):
        raise ConfigError("intrinsics", config.intrinsics, "holds another pose than the world's camera: "
                          f"use the file as world.camera: --set world.camera={config.intrinsics}")
    return camera


async def run(bus: Bus, config: Config) -> None:
    """Publish images; reopen a device that vanishes. Images of another size end the service with an error."""
    images, infos = bus.writer(topics.CAMERA_IMAGE), bus.writer(topics.CAMERA_INFO)
    frame = config.world.camera.frame
    i = calibrated(config)
    rectify, d = Rectifier(i), [0.0] * 5 if config.rectify else i.distortion.tolist()
    k = [i.fx, 0.0, i.cx, 0.0, i.fy, i.cy, 0.0, 0.0, 1.0]
    pace = LoopRate(bus, lambda: config.rate)
    await bus.ready()

    async def send(source: Source) -> int:
        """Publish images until the source ends; return their number."""
        loop, count, last = asyncio.get_running_loop(), 0, -math.inf
        while (image := await asyncio.to_thread(source.read)) is not None:
            header = bus.header(frame)
            if not count:
                infos.put(CameraInfo(header=header, height=i.height, width=i.width, d=d, k=k,
                                     distortion_model="plumb_bob" if config.rectify else i.distortion_model))
            since = (loop.time() - last) * config.rate  # periods since the last image was due
            if source.live and since < 0.5:
                continue  # read a device at its own rate, or its buffer fills with old images
            last = last + 1 / config.rate if since < 2 else loop.time()
            if config.rectify:
                image = await asyncio.to_thread(rectify, image, str(config.source))
            else:
                require_size(image, i, str(config.source))
            images.put(array_to_image(image, "bgr8", header))
            count += 1
            if not source.live:
                await pace.wait()
        return count

    async def open_and_send() -> DeviceGone | None:
        source = await asyncio.to_thread(open_source, config.source, (i.width, i.height), config.rate, loop=config.loop)
        sent = 0
        if source is not None:
            # Not closed on cancellation: a thread may still wait for an image in `read`.
            sent = await send(source)
            source.close()
            if not source.live:
                return None
        return DeviceGone(f"camera {config.source} delivers no image", sent)

    await run_with_reopening(open_and_send, config, bus.log)
    bus.log.info("%s has ended", config.source)
    await asyncio.Event().wait()  # other services still use the last image


if __name__ == "__main__":
    main(run, Config)
