"""Finds the balls in the picture and says where they are in the world."""

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
from applications.pick_place.perceived_scene import Place
from applications.pick_place.topics import DETECTED_OBJECTS, DETECTION_IMAGE, DETECTION_MASK
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
from common.transport.bus import Bus

KEPT = 5  # depth images that wait for their pictures
PATIENCE = 0.3  # [s, wall time] for which a picture waits for its depth
WORLD = "world"


class Config(DetectorOptions):
    """How red is told from the rest."""

    world: Surroundings
    depth: bool = Field(False, description="pictures come with depth, on depth_camera/depth/image_raw: balls are where "
                                           "that shows them, on others too")


def markers(
    detections: list[Detection], around: Surroundings, stamp: int, remark: str = "", blind: str = "",
    odd: Sequence[Outlier] = (),
) -> MarkerArray:
    """The message of what was found in the frame that was exposed at `stamp`, or of why that tells nothing.

    What is `odd` is among it with the reason as its text: it stands in the way, and is not to be taken.

    Raises:
        FrameError: that is more, or farther away, than there is room for.
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


@lru_cache(maxsize=64)  # what lies still is described once
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
    """What there is in the last picture that is too small or too large to be a ball; empty without."""
    parts = []
    if count := detector.too_small:
        parts.append(f"{count} red {'blob is' if count == 1 else 'blobs are'} smaller than "
                     f"{service}.min_contour_area_px = {detector.options.min_contour_area_px:g}")
    if count := detector.too_large:
        parts.append(f"{count} round red {'thing looks' if count == 1 else 'things look'} much larger than a ball on "
                     "the table")
    return ", and ".join(parts)


async def run(bus: Bus, config: Config) -> None:
    """Look at every picture as it comes; what cannot be looked at is dropped, counted and told once."""
    images = bus.reader(topics.CAMERA_IMAGE)
    cameras = CameraReader(bus, config.world)
    found, shown = bus.writer(DETECTED_OBJECTS), bus.writer(DETECTION_IMAGE)
    masks = bus.writer(DETECTION_MASK)
    cv2.setNumThreads(1)  # the other cores have other services
    depths = bus.reader(topics.DEPTH_CAMERA_DEPTH) if config.depth else None
    kept: deque[Image] = deque(maxlen=KEPT)
    news = asyncio.Event()
    detector = Detector(config.world, config)
    left_out = SkippedFrames(bus.log, "image")
    await bus.acquire_keys()
    warm_up(config.world, config)
    await bus.ready()

    async def watch_depths() -> None:
        if depths is not None:
            async for depth in depths:
                kept.append(depth)
                news.set()

    async def depth_with(stamp: int, camera: Pinhole) -> Depth:
        with suppress(TimeoutError):
            async with asyncio.timeout(PATIENCE):
                while all(one.header.stamp != stamp for one in kept):
                    news.clear()
                    await news.wait()
        found = next((one for one in kept if one.header.stamp == stamp), None)
        if found is None:
            raise FrameError("depth", "no depth image of the same time came")
        depth = depth_of(found)
        try:
            check_depth(depth, camera.width, camera.height)
        except DepthError as error:
            raise FrameError(error.kind, str(error)) from None
        return depth

    async def look() -> None:
        async for image in images:
            try:
                camera = await cameras.of(image.header)
                picture = decode_image(image, camera)
                depth = await depth_with(image.header.stamp, camera) if config.depth else None
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
        group.create_task(watch_depths())
        group.create_task(look())


if __name__ == "__main__":
    main(run, Config)
