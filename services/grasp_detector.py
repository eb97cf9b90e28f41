"""See objects in a tray and how to grasp them, in the images of depth cameras, and foreign bodies."""

from __future__ import annotations

import asyncio
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import cv2
from pydantic import Field, field_validator, model_validator

from applications.sorting.detector import HeapDetector, Seen
from applications.sorting.drawing import annotate_heap
from applications.sorting.foreign import ForeignOptions
from applications.sorting.grasp_finder import GraspFinder
from applications.sorting.grasps.candidates import Options
from applications.sorting.grasps.proof import ProofOptions
from applications.sorting.learning.learned import NUMBERS
from applications.sorting.learning.network import SHIPPED, Network
from applications.sorting.seeing import View
from applications.sorting.topics import HEAP, HEAP_IMAGE, Heap
from common import topics
from common.config import Parameters, RobotConfig, Surroundings, Tunable
from common.messages import Image
from common.perception.camera_input import FrameError, SkippedFrames, decode_image
from common.perception.depth import DepthError, check_depth, depth_of
from common.perception.image import array_to_image
from common.process.camera_reader import CameraReader
from common.process.service import main
from common.robot.home import HomeMonitor
from common.transport.bus import Bus

BUFFERED = 5  # depth images that wait for their color images
DEPTH_WAIT = 0.3  # [s, wall time] for which a color image waits for its depth image
TOGETHER = 0.5  # [s] between images of different cameras that are used together

ViewName = Annotated[str, Field(pattern=r"^[A-Za-z_]\w*$")]


class Config(Parameters):
    """What is looked for and where."""

    robot: RobotConfig
    world: Surroundings
    tray: str = Field("tray", description="id of the container with the objects; all others are destinations")
    views: list[ViewName] = Field([], max_length=4, description="names of several cameras, the main one first, as "
                                                                "left: left/depth_camera/image_raw")
    scorer: Literal["geometric", "learned"] = Field("geometric", description="what ranks grasps: weighted features, or "
                                                                             "a network that learned from tries")
    network: str = Field("", max_length=1000, description="with learned: .onnx file of `zencell grasp train`; empty: "
                                                          "the included one")
    grasps: Options | None = Field(None, description="limits of grasps: depth, slack, spares, tilts, ...")
    proof: ProofOptions | None = Field(None, description="how many grasps are proved and for how long: wanted, "
                                                         "for_each, seconds, approach, ...")
    rises: Tunable[float] = Field(0.04, gt=0, le=0.5, description="a foreign body is this much higher than all that is "
                                                                  "known there [m]")
    ceiling: Tunable[float] = Field(0.20, gt=0, le=2, description="height above the table from which on everything "
                                                                  "but the robot is foreign [m]")

    @field_validator("views")
    @classmethod
    def _require_distinct_views(cls, views: list[str]) -> list[str]:
        if len(set(views)) < len(views):
            raise ValueError(f"{next(name for name in views if views.count(name) > 1)!r} is listed twice")
        return views

    @model_validator(mode="after")
    def _require_scorer_of_network(self) -> Config:
        if self.network and self.scorer != "learned":
            raise ValueError(f"network {self.network!r} has no effect with scorer {self.scorer!r}; choose learned")
        return self


@dataclass(frozen=True, eq=False)
class Shot:
    """Images of one camera at one instant; `received` is a reading of `time.perf_counter` [s]."""

    view: View
    image: Image
    received: float


class DepthCamera:
    """Pairs color and depth images of one camera by their stamps."""

    def __init__(self, bus: Bus, world: Surroundings, name: str = "") -> None:
        """Subscribe to the topics of a view, by default those without a prefix."""
        at = f"{name}/" if name else ""

        def reader(topic: topics.Topic[Image]) -> topics.Topic[Image]:
            return replace(topic, key=f"{at}{topic.key}")

        self.images = bus.reader(reader(topics.DEPTH_CAMERA_IMAGE))
        self._depths = bus.reader(reader(topics.DEPTH_CAMERA_DEPTH))
        info = topics.DEPTH_CAMERA_INFO
        self.cameras = CameraReader(bus, world, replace(info, key=f"{at}{info.key}"))
        self._buffered: deque[Image] = deque(maxlen=BUFFERED)
        self._arrived = asyncio.Event()
        self.newest: Image | None = None

    async def follow(self) -> None:
        """Receive depth images; never returns."""
        async for depth in self._depths:
            self._buffered.append(depth)
            self._arrived.set()

    async def shot(self, image: Image) -> Shot:
        """Return an image with its depth and camera.

        Raises:
            FrameError: it is unusable, or its depth did not arrive.
        """
        received, stamp = time.perf_counter(), image.header.stamp
        with suppress(TimeoutError):
            async with asyncio.timeout(DEPTH_WAIT):
                while all(depth.header.stamp != stamp for depth in self._buffered):
                    self._arrived.clear()
                    await self._arrived.wait()
        depth = next((each for each in self._buffered if each.header.stamp == stamp), None)
        if depth is None:
            raise FrameError("depth", "no depth image with the same stamp received")
        camera = await self.cameras.of(image.header)
        pixels, metres = decode_image(image, camera), depth_of(depth)
        try:
            check_depth(metres, camera.width, camera.height)
        except DepthError as error:
            raise FrameError(error.kind, str(error)) from None
        return Shot((metres, pixels, camera), image, received)


async def run(bus: Bus, config: Config) -> None:
    """Publish what every image shows; unusable ones are dropped, counted and reported once."""
    cameras = [DepthCamera(bus, config.world, name) for name in config.views or [""]]
    states, gripper = bus.reader(topics.JOINT_STATES), bus.reader(topics.GRIPPER_STATE)
    heaps, shown = bus.writer(HEAP), bus.writer(HEAP_IMAGE)
    cv2.setNumThreads(1)  # other services use the other cores
    skipped = SkippedFrames(bus.log, "image")
    home = HomeMonitor(config.robot.named_poses["home"])
    detector = await asyncio.to_thread(
        HeapDetector, config.world, config.robot, tray=config.tray, field_name=f"services.{bus.service}.tray")
    network = Network.load(Path(config.network) if config.network else SHIPPED, NUMBERS) \
        if config.scorer == "learned" else None
    finder = await asyncio.to_thread(
        GraspFinder, config.world, config.robot, config.tray, options=config.grasps, proof=config.proof,
        network=network)
    await bus.ready()

    async def watch_arm() -> None:
        async for state in states:
            detector.joints.add(state)
            q = detector.robot.order(state.name, state.position)
            if q is not None:
                home.add(q.tolist(), state.header.stamp)

    async def others(stamp: int) -> list[Shot]:
        """Return shots of the other cameras taken about the same time."""
        found = []
        for camera in cameras[1:]:
            image = camera.images.latest
            if image is not None and abs(image.header.stamp - stamp) <= TOGETHER * 1e9:
                try:
                    found.append(await camera.shot(image))
                except FrameError as error:
                    skipped.note(error)
        return found

    async def look() -> None:
        async for image in cameras[0].images:
            try:
                first = await cameras[0].shot(image)
            except FrameError as error:
                skipped.note(error)
                continue
            stamp, state = image.header.stamp, gripper.latest
            at_home = home.was_home(stamp)
            shots = [first, *(await others(stamp) if at_home else [])]
            detector.options = ForeignOptions(rises=config.rises, ceiling=config.ceiling)
            seen = await asyncio.to_thread(
                detector.look, [shot.view for shot in shots], stamp, at_home=at_home,
                gripping=state is not None and (state.holding or state.moving))
            if seen is None:
                skipped.note(FrameError("no_state", "no joint state at the time of the image"))
                continue
            await publish(first, await asyncio.to_thread(with_grasps, seen))

    def with_grasps(seen: Seen) -> Heap:
        if seen.surface is None:
            return seen.heap
        found = finder.find(seen.surface, seen.labels, seen.heap.objects)
        return seen.heap.model_copy(update={"grasps": found.grasps, "left": found.left, "scorer": found.scorer})

    async def publish(shot: Shot, found: Heap) -> None:
        heap = found.model_copy(update={"seconds": time.perf_counter() - shot.received})
        heaps.put(heap)
        if shown.matched:
            _, pixels, camera = detector.registration.apply([shot.view])[0]
            picture = await asyncio.to_thread(annotate_heap, pixels, camera, heap, finder.closing)
            shown.put(array_to_image(picture, "bgr8", shot.image.header))

    async with asyncio.TaskGroup() as group:
        group.create_task(watch_arm())
        for camera in cameras:
            group.create_task(camera.cameras.follow())
            group.create_task(camera.follow())
        group.create_task(look())


if __name__ == "__main__":
    main(run, Config)
