from __future__ import annotations

import math
from collections.abc import AsyncIterator

import numpy as np
import pytest

from applications.pick_place.topics import DETECTED_OBJECTS, DETECTION_IMAGE, DETECTION_MASK
from common import topics
from common.config import CameraConfig
from common.perception.boxes import BoxKind, DetectedBox
from common.perception.camera_input import MAX_DETECTIONS, FrameError
from common.perception.image import image_to_array
from common.perception.pinhole import Pinhole
from services import box_detector
from tests.services.fake_cell import FakeCell, until

CAMERA = Pinhole.from_config(CameraConfig(width=320, height=240, fx=500, fy=500, cx=160, cy=120,
                                          position=(0.5, 0.0, 1.04)))
CONFIG = box_detector.Config(kinds={"red": BoxKind(color=(0.9, 0.1, 0.1), size=(0.04, 0.04, 0.04))})
FRAME = "depth_camera_optical_frame"


class DepthCamera(FakeCell):
    """A depth camera that looks down at one red cube in the middle of its image."""

    def __init__(self) -> None:
        super().__init__()
        self.found = self.reader(DETECTED_OBJECTS)
        self.calibrate(CAMERA, FRAME, topics.DEPTH_CAMERA_INFO)

    def depth(self, stamp: int, *, rows: int = 240, encoding: str = "32FC1") -> None:
        depth = np.full((rows, 320), 1.04, np.float32)
        depth[110:130, 150:170] = 1.0  # 20 pixels of 2 mm
        pixels = depth if encoding == "32FC1" else np.rint(1000 * depth).astype(np.uint16)
        self.put_image(topics.DEPTH_CAMERA_DEPTH, pixels, encoding, stamp, FRAME)

    def color(self, stamp: int, *, light: float = 1.0) -> None:
        image = np.full((240, 320, 3), 120, np.uint8)
        image[110:130, 150:170] = (25, 25, 230)
        self.put_image(topics.DEPTH_CAMERA_IMAGE, (light * image).astype(np.uint8), "bgr8", stamp, FRAME)


@pytest.fixture
async def camera() -> AsyncIterator[DepthCamera]:
    cell = DepthCamera()
    async with cell.running(box_detector, CONFIG):
        yield cell


async def test_cube_is_detected_in_any_order_of_its_images(camera: DepthCamera) -> None:
    images, masks = camera.reader(DETECTION_IMAGE), camera.reader(DETECTION_MASK)
    for stamp, order in ((5, (camera.depth, camera.color)), (6, (camera.color, camera.depth))):
        for publish in order:
            publish(stamp)
        frame = await until(camera.found)
        marker, = frame.markers
        assert (frame.header.stamp, frame.header.frame_id, marker.ns, marker.type) == (stamp, "world", "red", "box")
        assert (marker.scale.x, marker.scale.y, marker.scale.z, marker.partial) == (0.04, 0.04, 0.04, False)
        position = marker.pose.position
        assert math.dist((position.x, position.y, position.z), (0.5, 0.0, 0.02)) < 2e-3
        assert math.dist(marker.pixel, (159.5, 119.5)) < 1
    image, mask = await until(images), image_to_array(await until(masks))
    assert (image.width, image.height) == (320, 240)
    assert (mask[110:130, 150:170] == 255).all() and (mask == 255).sum() == 400


async def test_depth_in_millimeters_and_dark_images_are_recognized(camera: DepthCamera) -> None:
    camera.depth(5, encoding="16UC1")
    camera.color(5)
    marker, = (await until(camera.found)).markers
    assert abs(marker.pose.position.z - 0.02) < 2e-3
    camera.depth(6)
    camera.color(6, light=0.02)
    frame = await until(camera.found)
    assert not frame.markers and frame.blind


async def test_future_image_does_not_block_later_ones(camera: DepthCamera) -> None:
    for stamp in (2**63 - 1, 5, 6):
        camera.depth(stamp)
        camera.color(stamp)
        assert (await until(camera.found)).header.stamp == stamp


async def test_image_without_matching_depth_is_dropped(camera: DepthCamera) -> None:
    camera.depth(5)
    camera.color(6)
    camera.depth(7, rows=120)
    camera.color(7)
    camera.depth(8)
    camera.color(8)
    assert (await until(camera.found)).header.stamp == 8


def test_too_many_boxes_are_rejected_completely() -> None:
    box = DetectedBox("red", (0.5, 0.0, 0.02), 0.0, np.zeros((4, 2)), False)
    assert len(box_detector.markers([box] * MAX_DETECTIONS, CONFIG, 0).markers) == MAX_DETECTIONS
    with pytest.raises(FrameError, match=f"{MAX_DETECTIONS + 1} objects in it are more than"):
        box_detector.markers([box] * (MAX_DETECTIONS + 1), CONFIG, 0)


@pytest.mark.parametrize("x", [1.1e7, -math.inf, math.nan])
def test_box_out_of_message_range_is_rejected(x: float) -> None:
    with pytest.raises(FrameError, match=r"more than 1e\+07 m away"):
        box_detector.markers([DetectedBox("red", (x, 0.0, 0.02), 0.0, np.zeros((4, 2)), False)], CONFIG, 0)
