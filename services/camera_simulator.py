"""Render the simulated world and publish images as a camera does."""

from __future__ import annotations

import asyncio

import numpy as np
from pydantic import Field

from common import topics
from common.config import Arms, RobotConfig, Run, Scenery, Surroundings, Tunable
from common.messages import Image, WorldObjects
from common.perception.image import array_to_image
from common.process.service import main
from common.process.timing import LoopRate
from common.sim.camera import CameraParameters, Lens, SimulatedCamera
from common.sim.rendering import Pixels, add_image_noise
from common.transport.bus import Bus


class Config(CameraParameters):
    """Rate and quality of the images."""

    ALL_ARMS = True

    world: Surroundings
    scenery: Scenery = Scenery()
    robot: RobotConfig
    arms: Arms = Arms()
    run: Run
    rate: Tunable[float] = Field(10.0, gt=0, le=250, description="frames per second of cell time [Hz]")
    max_rate: Tunable[float] = Field(50.0, gt=0, le=250, description="frames per second of wall time at most [Hz]")
    noise_std: Tunable[float] = Field(0.0, ge=0, le=100, description="standard deviation of Gaussian noise [0..255]")
    brightness: Tunable[float] = Field(0.0, ge=-255, le=255, description="added to every channel [0..255]")
    distorted: bool = Field(False, description="apply the distortion d of the world's camera")
    rectify: bool = Field(True, description="with distorted: rectify as camera_opencv does; false publishes distorted "
                                            "images, and d in camera_info: the detectors reject them")
    draw_robot: bool = Field(False, description="show the arms, which occlude objects as in a real image")


async def run(bus: Bus, config: Config) -> None:
    """Publish images at the rate, from the first world state on.

    Images of a camera on the robot carry the stamp of the joint state from which its pose was computed.
    """
    truth = bus.reader(topics.SCENE_OBJECTS)
    images, infos = bus.writer(topics.CAMERA_IMAGE), bus.writer(topics.CAMERA_INFO)
    frame = config.world.camera.frame
    rng = np.random.default_rng(config.run.seed)
    lens = Lens(config.world.camera, distorted=config.distorted, rectify=config.rectify)
    arms = config.arms.including(config.robot)
    camera = SimulatedCamera(config.world, config.scenery, list(arms.values()), config, rng, plain=True, lens=lens,
                             arm=config.draw_robot)
    # Declared in every case: access rules come from the declarations, with whatever simulator they are made.
    joints = [bus.of_arm(arm).reader(topics.JOINT_STATES, listening=camera.needs_joints) for arm in arms]
    await bus.ready()
    await truth.next()
    for each in joints if camera.needs_joints else ():
        await each.next()
    infos.put(camera.info(bus.header(frame)))
    pace = LoopRate(bus, lambda: bus.clock.wall_rate(config.rate, config.max_rate))
    message: Image | None = None
    last_image: Pixels | None = None
    while True:
        header = bus.header(frame)  # the instant of exposure: the latest state is rendered
        world = truth.latest or WorldObjects()
        states = [each.latest for each in joints]
        if (carrier := states[0]) is not None and camera.is_at(carrier):
            header = header.model_copy(update={"stamp": carrier.header.stamp})
        view = (await asyncio.to_thread(camera.capture, world, states, header.stamp) if camera.takes_long(world)
                else camera.capture(world, states, header.stamp))
        image = add_image_noise(view.colour, config.noise_std, config.brightness, rng)
        if message is None or image is not last_image:
            message, last_image = array_to_image(image, "bgr8", header), image
        else:
            message = message.model_copy(update={"header": header})  # same pixels, new stamp
        images.put(message)
        await pace.wait()


if __name__ == "__main__":
    main(run, Config)
