"""An arm that stops in one pose after another, and its camera; joints and images are in the working directory."""

import asyncio
from pathlib import Path

import cv2
import yaml

from common import topics
from common.config import Parameters
from common.messages import JointState
from common.perception.image import array_to_image
from common.process.service import main
from common.transport.bus import Bus

SHOTS = "shots.yaml"


async def run(bus: Bus, config: Parameters) -> None:
    joints, images = bus.writer(topics.JOINT_STATES), bus.writer(topics.CAMERA_IMAGE)
    shots = await asyncio.to_thread(lambda: yaml.safe_load(Path(SHOTS).read_text()))
    await bus.ready()
    while True:
        for name, q in shots["poses"].items():
            for _ in range(30):
                state = JointState(header=bus.header(), name=shots["names"], position=q, velocity=[0.0] * 7)
                joints.put(state)
                await asyncio.sleep(0.02)
            images.put(array_to_image(cv2.imread(name), "bgr8", bus.header("camera")))


if __name__ == "__main__":
    main(run, Parameters)
