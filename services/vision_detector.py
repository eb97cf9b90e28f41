"""Detect balls in camera images and publish their positions in world."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from functools import lru_cache

import cv2
from pydantic import Field

from applications.pick_place.detector import Detection, Detector, DetectorOptions, annotate, warm_up
from applications.pick_place.outliers import Outlier
from applications.pick_place.topics import DETECTED_OBJECTS, DETECTION_IMAGE, DETECTION_MASK
from applications.pick_place.tracks import Place
from common import topics
from common.config import Surroundings
from common.config.basics import Rgb
from common.messages import Color, Header, Image, Marker, MarkerArray, Pose, Vector3
from common.perception.camera_input import (
    FrameError,
    SkippedFrames,
    decode_image,
    require_capacity,
    require_in_range,
)
from common.perception.depth import Depth, DepthError, check_depth, depth_of
from common.perception.image import array_to_image
from common.perception.pinhole import Pinhole
from common.process.camera_reader import CameraReader
from common.process.service import main
from common.transport.bus import Bus, Reader

BUFFERED = 5  # depth images that wait for their color images
DEPTH_WAIT = 0.3  # [s, wall time] for which a color image waits for its depth image
WORLD = "world"


class Config(DetectorOptions):
    """How red is separated from other colors."""

    world: Surroundings
    depth: bool = Field(False, description="pictures come with depth, on depth_camera/depth/image_raw: balls are where "
                                           "that shows them, on others too")


def markers(
    detections: list[Detection], around: Surroundings, stamp: int, remark: str = "", blind: str = "",
    odd: Sequence[Outlier] = (),
) -> MarkerArray:
    """Return the message with the detections in the image with this stamp, or why it is unusable.

    An `odd` object is included with the reason as its text: an obstacle, and no target.

    Raises:
        FrameError: more detections, or farther ones, than fit.
    """
    require_capacity(len(detections) + len(odd))
    require_in_range([*(one.position for one in detections), *(one.position for one in odd)])
    return MarkerArray(
        header=Header(stamp=stamp, frame_id=WORLD),
        remark=remark,
        blind=blind,
        markers=[
            _marker(index, d.position, d.pixel, d.partial, around.ball_radius, around.ball_color)
            for index, d in enumerate(detections)
        ] + [
            _marker(len(detections) + index, one.position, one.pixel, False, around.ball_radius, around.ball_color,
                    one.reason)
            for index, one in enumerate(odd)
        ],
    )


@lru_cache(maxsize=64)  # a marker of an object at rest is created once
def _marker(
    index: int, position: Place, pixel: tuple[float, float], partial: bool, radius: float, color: Rgb, odd: str = "",
) -> Marker:
    x, y, z = position
    return Marker(
        ns="ball", id=index, type="sphere", pose=Pose(position=Vector3(x=x, y=y, z=z)),
        scale=Vector3(x=2 * radius, y=2 * radius, z=2 * radius), color=Color(r=color[0], g=color[1], b=color[2]),
        pixel=pixel, partial=partial, text=odd,
    )


def _remark(detector: Detector, service: str) -> str:
    """Describe red blobs of the last image that are too small or too large for a ball; empty without any."""
    parts = []
    if count := detector.too_small:
        parts.append(f"{count} red {'blob is' if count == 1 else 'blobs are'} smaller than "
                     f"{service}.min_contour_area_px = {detector.options.min_contour_area_px:g}")
    if count := detector.too_large:
        parts.append(f"{count} round red {'thing looks' if count == 1 else 'things look'} much larger than a ball on "
                     "the table")
    return ", and ".join(parts)


class DepthBuffer:
    """The newest depth images, found by the stamps of their color images."""

    def __init__(self, reader: Reader[Image]) -> None:
        """Buffer what a reader receives."""
        self._reader = reader
        self._images: deque[Image] = deque(maxlen=BUFFERED)
        self._arrived = asyncio.Event()

    async def collect(self) -> None:
        """Receive depth images; never returns."""
        async for image in self._reader:
            self._images.append(image)
            self._arrived.set()

    async def at(self, stamp: int, camera: Pinhole) -> Depth:
        """Return the depth image with a stamp; wait for it up to `DEPTH_WAIT`.

        Raises:
            FrameError: it did not arrive, or does not fit the camera.
        """
        with suppress(TimeoutError):
            async with asyncio.timeout(DEPTH_WAIT):
                while all(image.header.stamp != stamp for image in self._images):
                    self._arrived.clear()
                    await self._arrived.wait()
        found = next((image for image in self._images if image.header.stamp == stamp), None)
        if found is None:
            raise FrameError("depth", "no depth image with the same stamp received")
        depth = depth_of(found)
        try:
            check_depth(depth, camera.width, camera.height)
        except DepthError as error:
            raise FrameError(error.kind, str(error)) from None
        return depth


async def run(bus: Bus, config: Config) -> None:
    """Process every image; unusable ones are dropped, counted and reported once."""
    images = bus.reader(topics.CAMERA_IMAGE)
    cameras = CameraReader(bus, config.world)
    found, shown = bus.writer(DETECTED_OBJECTS), bus.writer(DETECTION_IMAGE)
    masks = bus.writer(DETECTION_MASK)
    cv2.setNumThreads(1)  # other services use the other cores
    depths = DepthBuffer(bus.reader(topics.DEPTH_CAMERA_DEPTH)) if config.depth else None
    detector = Detector(config.world, config)
    left_out = SkippedFrames(bus.log, "image")
    await bus.acquire_keys()
    warm_up(config.world, config)
    await bus.ready()

    async def look() -> None:
        async for image in images:
            try:
                camera = await cameras.of(image.header)
                picture = decode_image(image, camera)
                depth = await depths.at(image.header.stamp, camera) if depths is not None else None
            except FrameError as error:
                left_out.note(error)
                continue
            if depth is None:
                detections = detector.detect(picture, camera)
            else:
                detections = await asyncio.to_thread(detector.detect_in_depth, picture, depth, camera)
            remark = _remark(detector, bus.service)
            try:
                found.put(markers(
                    detections, config.world, image.header.stamp, remark, detector.blind, detector.outliers))
            except FrameError as error:
                left_out.note(error)
            if shown.matched:
                shown.put(array_to_image(annotate(picture, detections), "bgr8", image.header))
            if masks.matched:
                masks.put(array_to_image(detector.masks(picture, camera).closed, "mono8", image.header))

    async with asyncio.TaskGroup() as group:
        group.create_task(cameras.follow())
        if depths is not None:
            group.create_task(depths.collect())
        group.create_task(look())


if __name__ == "__main__":
    main(run, Config)
