"""Publishes images of noise, which no compression makes smaller."""

import asyncio
import os

from common import topics
from common.config import Parameters
from common.messages import Image
from common.process.service import main
from common.transport.bus import Bus


async def run(bus: Bus, config: Parameters) -> None:
    images = bus.writer(topics.CAMERA_IMAGE)
    await bus.ready()
    while True:
        data = os.urandom(64 * 64 * 3)
        images.put(Image(header=bus.header("camera"), height=64, width=64, encoding="bgr8", data=data))
        await asyncio.sleep(0.02)


if __name__ == "__main__":
    main(run, Parameters)
