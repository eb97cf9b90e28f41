import numpy as np
import pytest

from applications.pick_place.detector import Detector
from applications.pick_place.topics import DETECTED_OBJECTS, DETECTION_IMAGE, DETECTION_MASK
from common import topics
from common.config import Surroundings, check
from common.errors import ConfigError
from common.messages import Header, Image
from common.perception.image import array_to_image, image_to_array
from common.perception.pinhole import Pinhole
from services import vision_detector
from services.vision_detector import Config
from tests.common.sim.spheres import draw_spheres
from tests.services.fake_cell import FakeCell, camera_transform, settle, until

AROUND = Surroundings()
CAMERA = Pinhole.from_config(AROUND.camera)
CONFIG = Config(world=AROUND)
FRAME = AROUND.camera.frame
PLACES = np.array([(0.40, -0.30, 0.03), (0.52, -0.30, 0.03), (0.64, -0.25, 0.03)])


class Cell(FakeCell):
    def __init__(self):
        super().__init__()
        self.found = self.reader(DETECTED_OBJECTS)

    def expose(self, stamp, pixels=None, encoding="bgr8"):
        """Publish an image, by default of the balls at their places."""
        pixels = draw_spheres(PLACES, CAMERA, AROUND) if pixels is None else pixels
        self.put_image(topics.CAMERA_IMAGE, pixels, encoding, stamp, FRAME)

    async def detected(self, stamp, count=3):
        message = await until(self.found)
        assert (message.header.stamp, len(message.markers)) == (stamp, count)
        return message


@pytest.fixture
async def cell():
    made = Cell()
    made.calibrate(CAMERA, FRAME)
    async with made.running(vision_detector, CONFIG):
        yield made


def position(marker):
    return marker.pose.position.x, marker.pose.position.y, marker.pose.position.z


async def test_image_gives_detections_with_its_stamp_and_an_annotated_image(cell):
    annotated = cell.reader(DETECTION_IMAGE)
    cell.expose(123_456_789)
    message = await cell.detected(123_456_789)
    assert message.header.frame_id == "world"
    assert [(mark.ns, mark.id, mark.type, mark.partial) for mark in message.markers] == [
        ("ball", i, "sphere", False) for i in range(3)]
    found = np.array([position(mark) for mark in message.markers])
    for place, mark in zip(PLACES, message.markers, strict=True):
        assert np.linalg.norm(found - place, axis=1).min() < 0.001
        assert mark.scale.x == 0.06 and mark.color.r == 1.0
        np.testing.assert_allclose(mark.pixel, CAMERA.project(position(mark)), atol=1e-6)
    image = await until(annotated)
    assert image.header == Header(stamp=123_456_789, frame_id=FRAME)
    assert (image_to_array(image) != draw_spheres(PLACES, CAMERA, AROUND)).any()
    cell.expose(5, np.ascontiguousarray(draw_spheres(PLACES, CAMERA, AROUND)[..., ::-1]), "rgb8")
    await cell.detected(5)


async def test_camera_pose_comes_from_tf_and_intrinsics_from_camera_info(cell):
    moved = Pinhole(600, 600, 300, 250, 640, 480, CAMERA.T_world_optical.copy())
    moved.T_world_optical[:3, 3] += (0.1, -0.05, 0.0)
    cell.calibrate(moved, FRAME)
    cell.expose(1, draw_spheres([(0.50, -0.35, 0.03)], moved, AROUND))
    (mark,) = (await cell.detected(1, 1)).markers
    assert position(mark)[:2] == pytest.approx((0.50, -0.35), abs=1e-3)


def chequered():
    pixels = np.full((480, 640, 3), 200, np.uint8)
    for v in range(4, 480, 32):
        for u in range(4, 640, 32):
            pixels[v:v + 24, u:u + 24] = (0, 0, 255)
    return array_to_image(pixels, "bgr8", Header(frame_id=FRAME))


def image(width, height, encoding, size, frame=FRAME):
    return Image(header=Header(frame_id=frame), width=width, height=height, encoding=encoding, data=bytes(size))


@pytest.mark.parametrize(("bad", "problem"), [
    (image(1, 1, "bgr8", 3), "image of 1x1"),
    (image(320, 240, "bgr8", 230400), "image of 320x240, but camera_info says 640x480"),
    (image(4000, 900, "mono8", 3_600_000), "4000"),
    (image(640, 480, "yuv", 9), "'yuv'"),
    (image(640, 480, "mono8", 307200), "'mono8'"),
    (image(640, 480, "bgr8", 99), "too few"),
    (chequered(), "more than a planning scene has room"),
    (image(640, 480, "bgr8", 1, "nowhere"), "'nowhere'"),
], ids=lambda value: value if isinstance(value, str) else "")
async def test_unusable_image_is_dropped_and_reported_once(cell, bad, problem, caplog):
    for stamp in (1, 2):
        cell.put(topics.CAMERA_IMAGE, bad)
        await settle()
        cell.expose(stamp)
        await cell.detected(stamp)
    assert caplog.text.count("image skipped") == 1 and problem in caplog.text


async def test_images_before_a_supported_camera_info_are_dropped():
    cell = Cell()
    distorted = CAMERA.info(Header(frame_id=FRAME)).model_copy(update={"d": [0.2, 0.0, 0.0, 0.0, 0.0]})
    async with cell.running(vision_detector, CONFIG):
        cell.expose(1)
        await settle()
        cell.calibrate(CAMERA, FRAME)
        cell.put(topics.CAMERA_INFO, distorted)
        cell.expose(2)
        await settle()
        cell.calibrate(CAMERA, FRAME)
        cell.expose(3)
        await cell.detected(3)


async def test_detections_out_of_message_range_do_not_end_the_service(cell):
    log, far = cell.reader(topics.LOG), CAMERA.T_world_optical.copy()
    far[:3, 3] = (1e7, 1e7, 1e7)
    cell.put(topics.TF_STATIC, camera_transform(Pinhole(520, 520, 320, 240, 640, 480, far), FRAME))
    cell.expose(1)
    await until(log, lambda line: "more than 1e+07 m away" in line.message)
    cell.calibrate(CAMERA, FRAME)
    cell.expose(2)
    await cell.detected(2)


async def test_mask_and_detections_follow_live_parameters_and_the_mask_needs_a_subscriber(monkeypatch):
    cell, calls, masks_of, tuned = Cell(), [], Detector.masks, CONFIG.model_copy()
    cell.calibrate(CAMERA, FRAME)
    monkeypatch.setattr(Detector, "masks", lambda self, *given: calls.append(1) or masks_of(self, *given))
    async with cell.running(vision_detector, tuned):
        calls.clear()  # of the warm-up
        cell.expose(1)
        await cell.detected(1)
        assert len(calls) == 1, "for the detection"
        masks = cell.reader(DETECTION_MASK)
        cell.expose(2)
        message = await until(masks)
        mask = image_to_array(message)
        assert message.header == Header(stamp=2, frame_id=FRAME) and mask.shape == (CAMERA.height, CAMERA.width)
        for u, v in (np.rint(CAMERA.project(place)).astype(int) for place in PLACES):
            assert mask[v, u] == 255
        assert set(np.unique(mask)) == {0, 255} and (mask == 255).mean() < 0.1
        tuned.min_contour_area_px = 9000.0
        cell.expose(3)
        await cell.detected(2)
        await cell.detected(3, 0)  # although the image is unchanged
        tuned.hsv_red_hi1 = tuned.hsv_red_hi2 = (0, 0, 0)  # excludes every color
        cell.expose(4)
        assert not image_to_array(await until(masks, lambda found: found.header.stamp == 4)).any()


@pytest.mark.parametrize(("values", "problem"), [
    ({"hsv_red_lo1": [0, 300, 80]}, "hsv_red_lo1.1"),
    ({"hsv_red_hi1": [10, 100, 255]}, "hsv_red_lo1 s = 120 is above hsv_red_hi1 s = 100"),
    ({"min_contour_area_px": 0}, "min_contour_area_px"),
    ({"hsv_red": [0, 0, 0]}, "choices: depth, hsv_red_hi1, hsv_red_hi2, hsv_red_lo1, hsv_red_lo2"),
])
def test_parameter_out_of_bounds_is_named(values, problem):
    with pytest.raises(ConfigError, match=problem.replace("=", ".")):
        check(Config, {"world": AROUND, **values}, "services.vision_detector")
