"""Sends the pictures of a real camera, a video file or an image folder, rectified."""

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
from common.process.pace import Pace
from common.process.reopening import Gone, Reopening, keep_open
from common.process.service import main
from common.transport.bus import Bus


class Config(Reopening):
    """Where pictures come from. The pose of the camera is that of the world's camera."""

    world: Surroundings
    source: str | int = Field("/dev/video0", description="device number or path, video file, or folder of images")
    intrinsics: str = Field(
        "", description="YAML file with width, height, fx, fy, cx, cy [px] and distortion d, for a camera at the pose "
                        "of the world's; empty: the world's camera, which may itself be a file of `zencell calibrate`"
    )
    rectify: bool = Field(True, description="take the distortion of the lens out; false sends pictures as they come, "
                                            "and d in camera_info, for recording: the detectors refuse them")
    rate: Tunable[float] = Field(10.0, gt=0, le=250, description="pictures per second of wall time at most [Hz]")
    loop: bool = Field(True, description="begin a file or folder again at its end")


def calibrated(config: Config) -> CameraFile:
    """The camera's intrinsics.

    Raises:
        ConfigError: their file cannot be used, or knows of another pose than the rest of the cell.
    """
    world = CameraFile.of(config.world.camera)
    if not config.intrinsics:
        return world
    camera = CameraFile.load(config.intrinsics)
    if camera.position is not None and (camera.mount or "", camera.position, camera.rpy or world.rpy) != (
            world.mount or "", world.position, world.rpy):
        raise ConfigError("intrinsics", config.intrinsics, "holds another pose than the world's camera has: "
                          f"let world.camera be the file, as in --set world.camera={config.intrinsics}")
    return camera


async def run(bus: Bus, config: Config) -> None:
    """Send pictures; a device that vanishes is opened again. Pictures of another size end the service with one line."""
    images, infos = bus.writer(topics.CAMERA_IMAGE), bus.writer(topics.CAMERA_INFO)
    frame = config.world.camera.frame
    i = calibrated(config)
    rectify, d = Rectifier(i), [0.0] * 5 if config.rectify else i.distortion.tolist()
    k = [i.fx, 0.0, i.cx, 0.0, i.fy, i.cy, 0.0, 0.0, 1.0]
    pace = Pace(bus, lambda: config.rate)
    await bus.ready()

    async def send(source: Source) -> int:
        """Send what the source gives until it gives no more; the number of pictures."""
        loop, count, last = asyncio.get_running_loop(), 0, -math.inf
        while (picture := await asyncio.to_thread(source.read)) is not None:
            header = bus.header(frame)
            if not count:
                infos.put(CameraInfo(header=header, height=i.height, width=i.width, d=d, k=k,
                                     distortion_model="plumb_bob" if config.rectify else i.distortion_model))
            since = (loop.time() - last) * config.rate  # periods since the last picture was due
            if source.live and since < 0.5:
                continue  # a device is read at its own pace, or its buffer would fill with old pictures
            last = last + 1 / config.rate if since < 2 else loop.time()
            if config.rectify:
                picture = await asyncio.to_thread(rectify, picture, str(config.source))
            else:
                require_size(picture, i, str(config.source))
            images.put(array_to_image(picture, "bgr8", header))
            count += 1
            if not source.live:
                await pace.wait()
        return count

    async def use() -> Gone | None:
        source = await asyncio.to_thread(open_source, config.source, (i.width, i.height), config.rate, loop=config.loop)
        sent = 0
        if source is not None:
            # Not closed when this is cancelled: a thread may still be waiting for a picture in there.
            sent = await send(source)
            source.close()
            if not source.live:
                return None
        return Gone(f"camera {config.source} gives no picture", sent)

    await keep_open(use, config, bus.log)
    bus.log.info("%s has come to its end", config.source)
    await asyncio.Event().wait()  # other services still look at the last picture


if __name__ == "__main__":
    main(run, Config)
