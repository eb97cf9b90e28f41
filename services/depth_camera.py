"""Render the simulated world with the arm and publish what a depth camera measures."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence

import numpy as np
from pydantic import Field

from common import topics
from common.config import Arms, RobotConfig, Run, Scenery, Surroundings, Tunable
from common.messages import JointState, WorldObjects
from common.perception.depth import point_cloud
from common.perception.image import array_to_image
from common.process.service import main
from common.process.timing import LoopRate
from common.sim.camera import CameraParameters, SimulatedCamera
from common.sim.ray_caster import View
from common.sim.rendering import add_depth_noise
from common.sim.sensors import DepthSensorParameters, simulate_depth
from common.transport.bus import Bus


class Config(CameraParameters, DepthSensorParameters):
    """Rate, range and noise."""

    ALL_ARMS = True

    world: Surroundings
    scenery: Scenery = Scenery()
    robot: RobotConfig
    arms: Arms = Arms()
    run: Run
    rate: Tunable[float] = Field(1.0, gt=0, le=30, description="frames per second of cell time [Hz]")
    max_rate: Tunable[float] = Field(5.0, gt=0, le=30, description="frames per second of wall time at most [Hz]")
    nearest: Tunable[float] = Field(0.10, gt=0, le=100, description="smallest measured depth [m]")
    farthest: Tunable[float] = Field(2.25, gt=0, le=100, description="largest measured depth [m]")
    depth_noise_std: Tunable[float] = Field(0.0, ge=0, le=0.1, description="standard deviation of Gaussian noise [m]")
    depth_dropout: Tunable[float] = Field(0.0, ge=0, le=1, description="fraction of pixels without depth")


async def run(bus: Bus, config: Config) -> None:
    """Publish images at the rate, from the first world and joint state on.

    Images of a camera on the robot carry the stamp of the joint state from which its pose was computed.
    """
    truth, arms = bus.reader(topics.SCENE_OBJECTS), config.arms.including(config.robot)
    joints = [bus.of_arm(arm).reader(topics.JOINT_STATES) for arm in arms]
    images, depths = bus.writer(topics.DEPTH_CAMERA_IMAGE), bus.writer(topics.DEPTH_CAMERA_DEPTH)
    points, infos = bus.writer(topics.DEPTH_CAMERA_POINTS), bus.writer(topics.DEPTH_CAMERA_INFO)
    frame = config.world.camera.frame
    rng = np.random.default_rng(config.run.seed)
    camera = await asyncio.to_thread(
        lambda: SimulatedCamera(config.world, config.scenery, list(arms.values()), config, rng, plain=False))

    def measure(world: WorldObjects, states: Sequence[JointState | None], now: int) -> View:
        """Return color and measured depth."""
        view = camera.capture(world, states, now)
        return View(view.colour, simulate_depth(view.depth, camera.pinhole, config, rng))

    await bus.ready()
    await truth.next()
    for each in joints:
        await each.next()
    infos.put(camera.info(bus.header(frame)))
    pace = LoopRate(bus, lambda: bus.clock.wall_rate(config.rate, config.max_rate))
    while True:
        header = bus.header(frame)  # the instant of exposure of image, depth and points
        world = truth.latest or WorldObjects()
        states = [each.latest for each in joints]
        if (carrier := states[0]) is not None and camera.is_at(carrier):
            header = header.model_copy(update={"stamp": carrier.header.stamp})
        view = await asyncio.to_thread(measure, world, states, header.stamp)
        depth = view.depth_within(config.nearest, config.farthest)
        depth = add_depth_noise(depth, rng, config.depth_noise_std, config.depth_dropout)
        depths.put(array_to_image(depth, "32FC1", header))  # first: a client with the image has its depth
        images.put(array_to_image(view.colour, "bgr8", header))
        if points.matched:
            points.put(point_cloud(view.colour, depth, camera.pinhole, header))
        await pace.wait()


if __name__ == "__main__":
    main(run, Config)
