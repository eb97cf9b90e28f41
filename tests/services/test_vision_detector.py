import asyncio
import logging

import numpy as np
import pytest

from applications.pick_place.detector import Detector
from applications.pick_place.topics import DETECTED_OBJECTS, DETECTION_IMAGE, DETECTION_MASK
from common import topics
from common.config import Surroundings, check
from common.errors import ConfigError
from common.messages import Header, Image, TFMessage, TransformStamped
from common.perception.image import array_to_image, image_to_array
from common.perception.pinhole import Pinhole
from common.process.in_process import running_service
from common.robot.transforms import matrix_to_pose
from common.supervision.wiring import wiring
from common.transport.local import LocalNetwork
from services.vision_detector import Config, run
from tests.common.sim.spheres import draw_spheres

around = Surroundings()
camera = Pinhole.from_config(around.camera)
config = Config(world=around)
FRAME = around.camera.frame
PLACES = np.array([(0.40, -0.30, 0.03), (0.52, -0.30, 0.03), (0.64, -0.25, 0.03)])


def picture(places=PLACES, stamp=1_000):
    return array_to_image(draw_spheres(places, camera, around), "bgr8", Header(stamp=stamp, frame_id=FRAME))


def chequered(side):
    pixels = np.full((480, 640, 3), 200, np.uint8)
    for v in range(4, 480, side + 8):
        for u in range(4, 640, side + 8):
            pixels[v:v + side, u:u + side] = (0, 0, 255)
    return pixels


def tf(T=camera.T_world_optical, child=FRAME):
    header = Header(frame_id="world")
    return TFMessage(transforms=[TransformStamped(header=header, child_frame_id=child, transform=matrix_to_pose(T))])


class Rig:
    """A tester's bus with everything that the detector reads and writes."""

    def __init__(self, net):
        bus = net.bus()
        self.images = bus.writer(topics.CAMERA_IMAGE)
        self.infos = bus.writer(topics.CAMERA_INFO)
        self.statics = bus.writer(topics.TF_STATIC)
        self.found = bus.reader(DETECTED_OBJECTS)
        self.bus = bus

    def calibrate(self):
        self.infos.put(camera.info(Header(frame_id=FRAME)))
        self.statics.put(tf())

    async def next(self):
        return await asyncio.wait_for(self.found.next(), 10)


async def test_one_image_gives_detections_with_its_stamp():
    net = LocalNetwork()
    rig = Rig(net)
    rig.calibrate()
    async with running_service(net, run, config, name="vision_detector"):
        rig.images.put(picture(stamp=123_456_789))
        message = await rig.next()
    assert message.header == Header(stamp=123_456_789, frame_id="world")
    assert [(mark.ns, mark.id, mark.type, mark.partial) for mark in message.markers] == [
        ("ball", i, "sphere", False) for i in range(3)
    ]
    found = np.array([(p.x, p.y, p.z) for p in (mark.pose.position for mark in message.markers)])
    for place, mark in zip(PLACES[[2, 1, 0]], message.markers, strict=False):
        assert np.linalg.norm(found - place, axis=1).min() < 0.001
        assert mark.scale.x == 0.06 and mark.color.r == 1.0
    for position, mark in zip(found, message.markers, strict=True):
        np.testing.assert_allclose(mark.pixel, camera.project(position), atol=1e-6)


async def test_camera_pose_comes_from_tf():
    net = LocalNetwork()
    rig = Rig(net)
    moved = camera.T_world_optical.copy()
    moved[:3, 3] += (0.1, -0.05, 0.0)
    rig.infos.put(camera.info(Header(frame_id=FRAME)))
    rig.statics.put(tf(moved))
    async with running_service(net, run, config):
        rig.images.put(picture(PLACES[:1]))
        (mark,) = (await rig.next()).markers
    assert (mark.pose.position.x, mark.pose.position.y) == pytest.approx((0.50, -0.35), abs=1e-3)


async def test_intrinsics_come_from_camera_info():
    net = LocalNetwork()
    rig = Rig(net)
    other = Pinhole(600, 600, 300, 250, 640, 480, camera.T_world_optical)
    rig.infos.put(other.info(Header(frame_id=FRAME)))
    rig.statics.put(tf())
    async with running_service(net, run, config):
        rig.images.put(array_to_image(draw_spheres(PLACES[:1], other, around), "bgr8", Header(stamp=1, frame_id=FRAME)))
        (mark,) = (await rig.next()).markers
    assert (mark.pose.position.x, mark.pose.position.y) == pytest.approx((0.40, -0.30), abs=1e-3)


@pytest.mark.parametrize(
    ("bad", "problem"),
    [
        (Image(header=Header(frame_id=FRAME), width=1, height=1, encoding="bgr8", data=b"abc"), "image of 1x1"),
        (
            Image(header=Header(frame_id=FRAME), width=320, height=240, encoding="bgr8", data=bytes(230400)),
            "image of 320x240, but camera_info says 640x480",
        ),
        (Image(header=Header(frame_id=FRAME), width=4000, height=900, encoding="mono8", data=bytes(3_600_000)), "4000"),
        (Image(header=Header(frame_id=FRAME), width=640, height=480, encoding="yuv", data=bytes(9)), "'yuv'"),
        (Image(header=Header(frame_id=FRAME), width=640, height=480, encoding="mono8", data=bytes(307200)), "'mono8'"),
        (Image(header=Header(frame_id=FRAME), width=640, height=480, encoding="bgr8", data=bytes(99)), "too few"),
        (array_to_image(chequered(24), "bgr8", Header(frame_id=FRAME)), "more than a planning scene has room"),
        (Image(header=Header(frame_id="nowhere"), width=640, height=480, encoding="bgr8", data=b"x"), "'nowhere'"),
    ],
)
async def test_unusable_image_is_dropped_and_reported_once(bad, problem, caplog):
    net = LocalNetwork()
    rig = Rig(net)
    rig.calibrate()
    with caplog.at_level(logging.WARNING):
        async with running_service(net, run, config, name="vision_detector"):
            for stamp in (1, 2):
                rig.images.put(bad)
                await asyncio.sleep(0)
                rig.images.put(picture(stamp=stamp))
                assert (await rig.next()).header.stamp == stamp
            rig.images.put(bad)
            await asyncio.sleep(0.05)
            rig.images.put(picture(stamp=3))
            while (await rig.next()).header.stamp != 3:
                pass
    lines = [record.getMessage() for record in caplog.records if "image skipped" in record.getMessage()]
    assert len(lines) == 1 and problem in lines[0]


async def test_images_before_camera_info_are_dropped():
    net = LocalNetwork()
    rig = Rig(net)
    async with running_service(net, run, config):
        rig.images.put(picture(stamp=1))
        await asyncio.sleep(0.05)
        rig.calibrate()
        rig.images.put(picture(stamp=2))
        assert (await rig.next()).header.stamp == 2


async def test_unsupported_camera_model_does_not_end_the_service():
    net = LocalNetwork()
    rig = Rig(net)
    bent = camera.info(Header(frame_id=FRAME)).model_copy(update={"d": [0.2, 0.0, 0.0, 0.0, 0.0]})
    rig.infos.put(bent)
    rig.statics.put(tf())
    async with running_service(net, run, config):
        rig.images.put(picture(stamp=1))
        await asyncio.sleep(0.05)
        rig.infos.put(camera.info(Header(frame_id=FRAME)))
        await asyncio.sleep(0)
        rig.images.put(picture(stamp=2))
        assert (await rig.next()).header.stamp == 2


async def test_detections_out_of_message_range_do_not_end_the_service(caplog):
    net = LocalNetwork()
    rig = Rig(net)
    with caplog.at_level(logging.WARNING):
        async with running_service(net, run, config, name="vision_detector"):
            rig.calibrate()
            far = camera.T_world_optical.copy()
            far[:3, 3] = (1e7, 1e7, 1e7)
            rig.statics.put(tf(far))
            rig.images.put(picture(stamp=1))
            with pytest.raises(TimeoutError):
                await asyncio.wait_for(rig.found.next(), 0.5)
            rig.calibrate()
            rig.images.put(picture(stamp=2))
            assert len((await asyncio.wait_for(rig.found.next(), 5)).markers) == 3
    assert "more than 1e+07 m away" in caplog.text


async def test_annotated_image_is_published_for_subscribers():
    net = LocalNetwork()
    rig = Rig(net)
    rig.calibrate()
    shown = rig.bus.reader(DETECTION_IMAGE)
    async with running_service(net, run, config):
        rig.images.put(picture(stamp=7))
        image = await asyncio.wait_for(shown.next(), 10)
    assert image.header == Header(stamp=7, frame_id=FRAME)
    assert (image_to_array(image) != draw_spheres(PLACES, camera, around)).any()


async def test_mask_follows_the_color_windows_and_needs_a_subscriber(monkeypatch):
    net, asked = LocalNetwork(), []
    rig = Rig(net)
    rig.calibrate()
    tuned = config.model_copy()
    look = Detector.masks
    monkeypatch.setattr(Detector, "masks", lambda self, *given: asked.append(1) or look(self, *given))
    async with running_service(net, run, tuned, name="vision_detector"):
        asked.clear()  # what it rehearsed before it was ready
        rig.images.put(picture(stamp=1))
        await rig.next()
        assert len(asked) == 1  # to find what there is
        masks = rig.bus.reader(DETECTION_MASK)
        rig.images.put(picture(stamp=2))
        image = await asyncio.wait_for(masks.next(), 10)
        mask = image_to_array(image)
        assert image.header == Header(stamp=2, frame_id=FRAME) and mask.shape == (camera.height, camera.width)
        for place in PLACES:
            u, v = np.rint(camera.project(place)).astype(int)
            assert mask[v, u] == 255
        assert set(np.unique(mask)) == {0, 255} and (mask == 255).mean() < 0.1
        tuned.hsv_red_hi1 = tuned.hsv_red_hi2 = (0, 0, 0)  # lets nothing through
        rig.images.put(picture(stamp=3))
        while image.header.stamp < 3:
            image = await asyncio.wait_for(masks.next(), 10)
        assert not image_to_array(image).any()


async def test_rgb_image_is_accepted():
    net = LocalNetwork()
    rig = Rig(net)
    rig.calibrate()
    flipped = np.ascontiguousarray(draw_spheres(PLACES, camera, around)[..., ::-1])
    async with running_service(net, run, config):
        rig.images.put(array_to_image(flipped, "rgb8", Header(stamp=5, frame_id=FRAME)))
        assert len((await rig.next()).markers) == 3


async def test_detector_reads_no_ground_truth():
    found = await wiring(run, config)
    assert found.reads == {topics.CAMERA_IMAGE, topics.CAMERA_INFO, topics.TF_STATIC}
    assert found.writes == {DETECTED_OBJECTS, DETECTION_IMAGE, DETECTION_MASK}


@pytest.mark.parametrize(
    ("values", "problem"),
    [
        ({"hsv_red_lo1": [0, 300, 80]}, "hsv_red_lo1.1"),
        ({"hsv_red_hi1": [10, 100, 255]}, "hsv_red_lo1 s = 120 is above hsv_red_hi1 s = 100"),
        ({"min_contour_area_px": 0}, "min_contour_area_px"),
        ({"hsv_red": [0, 0, 0]}, "choices: depth, hsv_red_hi1, hsv_red_hi2, hsv_red_lo1, hsv_red_lo2"),
    ],
)
def test_a_parameter_out_of_bounds_is_named(values, problem):
    with pytest.raises(ConfigError, match=r"hsv_red|min_contour") as caught:
        check(Config, {"world": around, **values}, "services.vision_detector")
    assert problem in str(caught.value)
