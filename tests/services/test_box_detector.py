from __future__ import annotations

import asyncio
import math

import numpy as np
import pytest

from applications.pick_place.topics import DETECTED_OBJECTS, DETECTION_IMAGE, DETECTION_MASK
from common import messages as m
from common import topics
from common.clock import Clock
from common.config import CameraConfig
from common.perception.boxes import BoxKind, DetectedBox
from common.perception.camera_input import MAX_DETECTIONS, FrameError
from common.perception.image import array_to_image, image_to_array
from common.perception.pinhole import Pinhole
from common.process.in_process import running_service
from common.robot.transforms import matrix_to_pose
from common.transport.local import LocalNetwork
from services import box_detector

CAMERA = Pinhole.from_config(CameraConfig(width=320, height=240, fx=500, fy=500, cx=160, cy=120,
                                          position=(0.5, 0.0, 1.04)))
CONFIG = box_detector.Config(kinds={"red": BoxKind(color=(0.9, 0.1, 0.1), size=(0.04, 0.04, 0.04))})
FRAME = "depth_camera_optical_frame"


class Camera:
    """Says what a depth camera says that looks down at one cube in the middle of its picture, or at none."""

    def __init__(self, net: LocalNetwork) -> None:
        bus = net.bus("tester", cell="test", clock=Clock())
        self.images, self.depths = bus.writer(topics.DEPTH_CAMERA_IMAGE), bus.writer(topics.DEPTH_CAMERA_DEPTH)
        self.found, self.shown = bus.reader(DETECTED_OBJECTS), bus.reader(DETECTION_IMAGE)
        self.masks = bus.reader(DETECTION_MASK)
        bus.writer(topics.DEPTH_CAMERA_INFO).put(CAMERA.info(m.Header(frame_id=FRAME)))
        bus.writer(topics.TF_STATIC).put(m.TFMessage(transforms=[m.TransformStamped(
            header=m.Header(frame_id="world"), child_frame_id=FRAME, transform=matrix_to_pose(CAMERA.T_world_optical),
        )]))

    def depth(self, stamp: int, *, rows: int = 240, encoding: str = "32FC1") -> None:
        depth = np.full((rows, 320), 1.04, np.float32)
        depth[110:130, 150:170] = 1.0  # 20 pixels of 2 mm
        pixels = depth if encoding == "32FC1" else np.rint(1000 * depth).astype(np.uint16)
        self.depths.put(array_to_image(pixels, encoding, m.Header(stamp=stamp, frame_id=FRAME)))

    def picture(self, stamp: int, *, light: float = 1.0) -> None:
        picture = np.full((240, 320, 3), 120, np.uint8)
        picture[110:130, 150:170] = (25, 25, 230)
        picture = (light * picture).astype(np.uint8)
        self.images.put(array_to_image(picture, "bgr8", m.Header(stamp=stamp, frame_id=FRAME)))


async def test_cube_is_detected_whichever_image_arrives_first() -> None:
    net = LocalNetwork()
    camera = Camera(net)
    async with running_service(net, box_detector.run, CONFIG):
        for stamp, order in ((5, (camera.depth, camera.picture)), (6, (camera.picture, camera.depth))):
            for say in order:
                say(stamp)
            frame = await camera.found.next()
            marker, = frame.markers
            assert (frame.header.stamp, frame.header.frame_id, marker.ns, marker.type) == (stamp, "world", "red", "box")
            assert (marker.scale.x, marker.scale.y, marker.scale.z, marker.partial) == (0.04, 0.04, 0.04, False)
            at = marker.pose.position
            assert math.dist((at.x, at.y, at.z), (0.5, 0.0, 0.02)) < 2e-3
            assert marker.pixel is not None and math.dist(marker.pixel, (159.5, 119.5)) < 1
        shown = await camera.shown.next()
        assert (shown.width, shown.height) == (320, 240)
        mask = image_to_array(await camera.masks.next())
        assert (mask[110:130, 150:170] == 255).all() and (mask == 255).sum() == 400


async def test_future_image_does_not_block_later_ones() -> None:
    net = LocalNetwork()
    camera = Camera(net)
    async with running_service(net, box_detector.run, CONFIG):
        for stamp in (2**63 - 1, 5, 6):
            camera.depth(stamp)
            camera.picture(stamp)
            assert (await asyncio.wait_for(camera.found.next(), 20)).header.stamp == stamp


async def test_encoding_identifies_depth_in_millimeters() -> None:
    net = LocalNetwork()
    camera = Camera(net)
    async with running_service(net, box_detector.run, CONFIG):
        camera.depth(5, encoding="16UC1")
        camera.picture(5)
        marker, = (await camera.found.next()).markers
        assert abs(marker.pose.position.z - 0.02) < 2e-3


async def test_dark_image_is_unusable_despite_valid_depth() -> None:
    net = LocalNetwork()
    camera = Camera(net)
    async with running_service(net, box_detector.run, CONFIG):
        for stamp, light in ((5, 1.0), (6, 0.02)):
            camera.depth(stamp)
            camera.picture(stamp, light=light)
            frame = await camera.found.next()
            assert (len(frame.markers), bool(frame.blind)) == ((1, False) if light == 1.0 else (0, True))


def test_too_many_boxes_are_rejected_completely() -> None:
    box = DetectedBox("red", (0.5, 0.0, 0.02), 0.0, np.zeros((4, 2)), False)
    assert len(box_detector.markers([box] * MAX_DETECTIONS, CONFIG, 0).markers) == MAX_DETECTIONS
    with pytest.raises(FrameError, match=f"{MAX_DETECTIONS + 1} objects in it are more than"):
        box_detector.markers([box] * (MAX_DETECTIONS + 1), CONFIG, 0)


@pytest.mark.parametrize("x", [1.1e7, -math.inf, math.nan])
def test_box_out_of_message_range_is_rejected(x: float) -> None:
    with pytest.raises(FrameError, match=r"more than 1e\+07 m away"):
        box_detector.markers([DetectedBox("red", (x, 0.0, 0.02), 0.0, np.zeros((4, 2)), False)], CONFIG, 0)


async def test_image_without_matching_depth_is_dropped() -> None:
    net = LocalNetwork()
    camera = Camera(net)
    async with running_service(net, box_detector.run, CONFIG):
        camera.depth(5)
        camera.picture(6)
        camera.depth(7, rows=120)
        camera.picture(7)
        camera.depth(8)
        camera.picture(8)
        assert (await camera.found.next()).header.stamp == 8
