"""Draws what a camera would see of the simulated world and sends it as a camera does."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from common import topics
from common.applications.pick_place.topics import SCENE_BALLS
from common.config import Parameters, Run, Surroundings, Tunable
from common.messages import PoseArray
from common.perception.image import array_to_image
from common.perception.pinhole import Pinhole
from common.process.pace import Pace
from common.process.service import main
from common.sim.drawing import draw
from common.transport.bus import Bus

UNSEEN = ("held", "elsewhere")  # hidden by the hand; off the table


class Config(Parameters):
    """Rate and quality of the picture."""

    world: Surroundings
    run: Run
    rate: Tunable[float] = Field(10.0, gt=0, le=250, description="frames per second of cell time [Hz]")
    max_rate: Tunable[float] = Field(50.0, gt=0, le=250, description="frames per second of wall time at most [Hz]")
    noise_std: Tunable[float] = Field(0.0, ge=0, le=100, description="standard deviation of Gaussian noise [0..255]")
    brightness: Tunable[float] = Field(0.0, ge=-255, le=255, description="added to every channel [0..255]")


def seen(balls: PoseArray) -> list[tuple[float, float, float]]:
    """Centres of the balls that the camera can see (x, y, z) [m], world."""
    labels = balls.labels or [""] * len(balls.poses)
    return [
        (pose.position.x, pose.position.y, pose.position.z)
        for pose, label in zip(balls.poses, labels, strict=True)
        if label not in UNSEEN
    ]


async def run(bus: Bus, config: Config) -> None:
    """Send a picture at the rate, from the first time on that the world says where its balls are."""
    truth = bus.reader(SCENE_BALLS)
    images, infos = bus.writer(topics.CAMERA_IMAGE), bus.writer(topics.CAMERA_INFO)
    frame = config.world.camera.frame
    camera = Pinhole.from_config(config.world.camera)
    rng = np.random.default_rng(config.run.seed)
    await bus.ready()
    await truth.next()
    infos.put(camera.info(bus.header(frame)))
    pace = Pace(bus, lambda: bus.clock.wall_rate(config.rate, config.max_rate))
    drawn, picture = None, draw([], camera, config.world)
    while True:
        header = bus.header(frame)  # the instant of exposure: what is drawn is where the balls are now
        balls = seen(truth.latest or PoseArray())
        shown = (balls, config.noise_std, config.brightness)
        if shown != drawn or config.noise_std:  # without noise, pictures of the same thing are the same
            picture = draw(
                balls, camera, config.world, noise_std=config.noise_std, brightness=config.brightness, rng=rng
            )
            drawn = shown
        images.put(array_to_image(picture, "bgr8", header))
        await pace.wait()


if __name__ == "__main__":
    main(run, Config)
