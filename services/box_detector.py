"""Detect boxes of known colors and sizes in depth camera images and publish their positions in world."""

from __future__ import annotations

import asyncio
import math
from collections import deque

import cv2

from applications.pick_place.topics import DETECTED_OBJECTS, DETECTION_IMAGE, DETECTION_MASK
from common import topics
from common.config import Surroundings
from common.messages import Color, Header, Image, Marker, MarkerArray, Pose, Quaternion, Vector3
from common.perception.boxes import BoxDetector, BoxOptions, DetectedBox, draw_boxes
from common.perception.camera_input import (
    FrameError,
    SkippedFrames,
    decode_image,
    require_capacity,
    require_in_range,
)
from common.perception.depth import DepthError, check_depth, depth_of
from common.perception.illumination import blank_image_reason
from common.perception.image import array_to_image
from common.process.camera_reader import CameraReader
from common.process.service import main
from common.transport.bus import Bus

BUFFERED = 5  # depth images that wait for their color images
WORLD = "world"


class Config(BoxOptions):
    """Which boxes are detected."""

    world: Surroundings = Surroundings()


def markers(found: list[DetectedBox], config: Config, stamp: int, blind: str = "") -> MarkerArray:
    """Return the message with the detections in the image with this stamp, or why it is unusable.

    Raises:
        FrameError: more detections, or farther ones, than fit.
    """
    require_capacity(len(found))
    require_in_range([box.position for box in found])
    return MarkerArray(header=Header(stamp=stamp, frame_id=WORLD), blind=blind, markers=[
        _marker(index, box, config) for index, box in enumerate(found)
    ])


def _marker(index: int, box: DetectedBox, config: Config) -> Marker:
    kind = config.kinds[box.kind]
    (x, y, z), (r, g, b), (u, v) = box.position, kind.color, box.corners.mean(axis=0)
    return Marker(
        ns=box.kind, id=index, type="box", scale=Vector3(x=kind.size[0], y=kind.size[1], z=kind.size[2]),
        pose=Pose(position=Vector3(x=x, y=y, z=z),
                  orientation=Quaternion(z=math.sin(box.yaw / 2), w=math.cos(box.yaw / 2))),
        color=Color(r=r, g=g, b=b), pixel=(float(u), float(v)), partial=box.partial,
    )


async def run(bus: Bus, config: Config) -> None:
    """Process every image once its depth has arrived; unusable ones are dropped, counted and reported once."""
    images, depths = bus.reader(topics.DEPTH_CAMERA_IMAGE), bus.reader(topics.DEPTH_CAMERA_DEPTH)
    cameras = CameraReader(bus, config.world, topics.DEPTH_CAMERA_INFO)
    found, shown = bus.writer(DETECTED_OBJECTS), bus.writer(DETECTION_IMAGE)
    masks = bus.writer(DETECTION_MASK)
    cv2.setNumThreads(1)  # other services use the other cores
    detector = BoxDetector(config)
    left_out = SkippedFrames(bus.log, "image")
    buffered: deque[Image] = deque(maxlen=BUFFERED)
    newest, turn = 0, asyncio.Lock()
    await bus.ready()

    async def look(image: Image | None) -> None:
        nonlocal newest
        depth = next((one for one in buffered if image is not None and one.header.stamp == image.header.stamp), None)
        if image is None or depth is None or image.header.stamp == newest:
            return
        newest = image.header.stamp
        try:
            camera = await cameras.of(image.header)
            picture, metres = decode_image(image, camera), depth_of(depth)
            check_depth(metres, camera.width, camera.height)
            detector.options = config.model_copy()
            boxes = await asyncio.to_thread(detector.detect, picture, metres, camera)
        except FrameError as error:
            left_out.note(error)
            return
        except DepthError as error:
            left_out.note(FrameError(error.kind, str(error)))
            return
        try:
            found.put(markers(boxes, config, image.header.stamp, "" if boxes else blank_image_reason(picture)))
        except FrameError as error:
            left_out.note(error)
        if shown.matched:
            shown.put(array_to_image(draw_boxes(picture, boxes), "bgr8", image.header))
        if masks.matched:
            masks.put(array_to_image(detector.mask(picture), "mono8", image.header))

    async def watch_depths() -> None:
        async for depth in depths:
            buffered.append(depth)
            async with turn:
                await look(images.latest)

    async def watch_images() -> None:
        async for image in images:
            async with turn:
                await look(image)

    async with asyncio.TaskGroup() as group:
        group.create_task(cameras.follow())
        group.create_task(watch_depths())
        group.create_task(watch_images())


if __name__ == "__main__":
    main(run, Config)
