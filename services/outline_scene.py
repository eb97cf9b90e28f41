"""Publish the planning scene of the outlining cell: fixtures, and every solid in the newest image without the arm."""

from __future__ import annotations

import asyncio
from collections import deque

from applications.outlining.solids import perceived_solids, planning_scene, require_apart
from applications.outlining.topics import CONTOURS, Contours
from common import topics
from common.config import Parameters, RobotConfig, Surroundings
from common.messages import Image, PlanningScene
from common.perception.camera_input import FrameError, SkippedFrames
from common.perception.depth import DepthError, check_depth, depth_of
from common.perception.pinhole import Pinhole
from common.process.camera_reader import CameraReader
from common.process.planning_scene import SceneWriter
from common.process.service import main
from common.robot.home import HomeMonitor
from common.transport.bus import Bus

BUFFERED = 5  # depth images that wait for their contours


class Config(Parameters):
    """Fixtures of the cell, and the home pose of the arm."""

    robot: RobotConfig
    world: Surroundings


def seen(found: Contours, image: Image, camera: Pinhole, around: Surroundings) -> PlanningScene:
    """Return the planning scene from the contours of an image and its depth.

    Raises:
        FrameError: no pixel has a depth, so free space is unknown; or there are more objects than there is time for.
    """
    require_apart(found)
    depth = depth_of(image)
    try:
        check_depth(depth, found.width, found.height)
    except DepthError as error:
        raise FrameError(error.kind, str(error)) from None
    return planning_scene(around, perceived_solids(found.contours, depth, camera), found.header.stamp)


async def run(bus: Bus, config: Config) -> None:
    """Publish the planning scene for every image that was taken with the arm at home."""
    contours = bus.reader(CONTOURS)
    depths = bus.reader(topics.DEPTH_CAMERA_DEPTH)
    cameras = CameraReader(bus, config.world, topics.DEPTH_CAMERA_INFO)
    joints = bus.reader(topics.JOINT_STATES)
    out = SceneWriter(bus)
    home = HomeMonitor(config.robot.named_poses["home"])
    buffered: deque[Image] = deque(maxlen=BUFFERED)
    left_out = SkippedFrames(bus.log, "image")
    await out.begin(planning_scene(config.world, [], 0))
    await bus.ready()

    async def watch_arm() -> None:
        async for state in joints:
            found = dict(zip(state.name, state.position, strict=True))
            if all(name in found for name in config.robot.joints):
                home.add([found[name] for name in config.robot.joints], state.header.stamp)

    async def watch_depth() -> None:
        async for image in depths:
            buffered.append(image)
            await look(contours.latest)

    async def watch_contours() -> None:
        async for found in contours:
            await look(found)

    newest = 0

    async def look(found: Contours | None) -> None:
        """Publish the scene of an image once its contours and its depth have both arrived."""
        nonlocal newest
        if found is None or found.header.stamp == newest or not home.was_home(found.header.stamp):
            return
        depth = next((image for image in buffered if image.header.stamp == found.header.stamp), None)
        if depth is None:
            return
        newest = found.header.stamp
        try:
            camera = await cameras.of(depth.header)
            scene = await asyncio.to_thread(seen, found, depth, camera, config.world)
        except FrameError as error:
            left_out.note(error)
            return
        out.put(scene)

    async with asyncio.TaskGroup() as group:
        for watch in (cameras.follow(), watch_arm(), watch_depth(), watch_contours()):
            group.create_task(watch)


if __name__ == "__main__":
    main(run, Config)
