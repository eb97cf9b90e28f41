"""Draws what a camera would see of the simulated world and sends it as a camera does."""

from __future__ import annotations

import asyncio

import numpy as np
from pydantic import Field

from common import topics
from common.config import RobotConfig, Run, Scenery, Surroundings, Tunable
from common.messages import Image, WorldObjects
from common.perception.image import array_to_image
from common.process.pace import Pace
from common.process.service import main
from common.sim.camera import CameraParameters, Lens, SimulatedCamera
from common.sim.rendering import Picture, add_image_noise
from common.transport.bus import Bus


class Config(CameraParameters):
    """Rate and quality of the picture."""

    world: Surroundings
    scenery: Scenery = Scenery()
    robot: RobotConfig
    run: Run
    rate: Tunable[float] = Field(10.0, gt=0, le=250, description="frames per second of cell time [Hz]")
    max_rate: Tunable[float] = Field(50.0, gt=0, le=250, description="frames per second of wall time at most [Hz]")
    noise_std: Tunable[float] = Field(0.0, ge=0, le=100, description="standard deviation of Gaussian noise [0..255]")
    brightness: Tunable[float] = Field(0.0, ge=-255, le=255, description="added to every channel [0..255]")
    distorted: bool = Field(False, description="see through the lens of the world's camera, with its distortion d")
    rectify: bool = Field(True, description="with distorted: take it out again, as camera_opencv does; false sends "
                                            "pictures as they come, and d in camera_info: the detectors refuse them")
    draw_robot: bool = Field(False, description="the arm stands before what lies behind it, as in a real picture")


async def run(bus: Bus, config: Config) -> None:
    """Send a picture at the rate, from the first time on that the world says where everything is.

    A camera on the robot is where the joints have it, and its pictures have the time at which they were there.
    """
    truth = bus.reader(topics.SCENE_OBJECTS)
    images, infos = bus.writer(topics.CAMERA_IMAGE), bus.writer(topics.CAMERA_INFO)
    frame = config.world.camera.frame
    rng = np.random.default_rng(config.run.seed)
    lens = Lens(config.world.camera, distorted=config.distorted, rectify=config.rectify)
    camera = SimulatedCamera(config.world, config.scenery, config.robot, config, rng, plain=True, lens=lens,
                             arm=config.draw_robot)
    joints = bus.reader(topics.JOINT_STATES) if camera.needs_joints else None
    await bus.ready()
    await truth.next()
    if joints is not None:
        await joints.next()
    infos.put(camera.info(bus.header(frame)))
    pace = Pace(bus, lambda: bus.clock.wall_rate(config.rate, config.max_rate))
    sent: Image | None = None
    shown: Picture | None = None
    while True:
        header = bus.header(frame)  # the instant of exposure: what is drawn is where everything is now
        world = truth.latest or WorldObjects()
        state = joints.latest if joints is not None else None
        if state is not None and camera.is_at(state):
            header = header.model_copy(update={"stamp": state.header.stamp})
        view = (await asyncio.to_thread(camera.capture, world, state, header.stamp) if camera.takes_long(world)
                else camera.capture(world, state, header.stamp))
        picture = add_image_noise(view.colour, config.noise_std, config.brightness, rng)
        if sent is None or picture is not shown:
            sent, shown = array_to_image(picture, "bgr8", header), picture
        else:
            sent = sent.model_copy(update={"header": header})  # with the pixels as they are
        images.put(sent)
        await pace.wait()


if __name__ == "__main__":
    main(run, Config)
