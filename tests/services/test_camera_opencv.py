import asyncio
import logging

import cv2
import numpy as np
import pytest
import yaml

from common import topics
from common.config import Surroundings
from common.errors import ConfigError
from common.perception import image_sources as sources
from common.perception.camera_file import CameraFile, Rectifier
from common.perception.image import image_to_array
from common.perception.image_sources import Video, open_source
from common.process.in_process import running_service
from common.supervision.wiring import wiring
from common.transport.local import LocalNetwork
from services import camera_opencv
from services.camera_opencv import Config, calibrated, run

around = Surroundings()
SMALL = {"width": 64, "height": 48, "fx": 50.0, "fy": 51.0, "cx": 32.0, "cy": 24.0}


def plain(value, width=64, height=48):
    return np.full((height, width, 3), value, np.uint8)


@pytest.fixture
def intrinsics(tmp_path):
    path = tmp_path / "camera.yaml"
    path.write_text(yaml.safe_dump(SMALL))
    return str(path)


@pytest.fixture
def folder(tmp_path):
    path = tmp_path / "pictures"
    path.mkdir()
    for value in (10, 20, 100):
        cv2.imwrite(str(path / f"frame{value}.png"), plain(value))
    return str(path)


def config(**values):
    return Config(world=around, **{"rate": 200.0, **values})


def value_of(image):
    return int(image_to_array(image)[0, 0, 0])


async def read_until(images, done):
    """Pictures as they come, until their values are enough; a stream may leave some out."""
    found = []
    while not done([value_of(image) for image in found]):
        found.append(await asyncio.wait_for(images.next(), 10))
    return found


async def test_folder_images_are_published_in_order_and_repeated(folder, intrinsics):
    net = LocalNetwork()
    bus = net.bus()
    images, infos = bus.reader(topics.CAMERA_IMAGE), bus.reader(topics.CAMERA_INFO)
    async with running_service(net, run, config(source=folder, intrinsics=intrinsics, rate=50.0), name="camera_opencv"):
        found = await read_until(images, lambda values: values[-3:] == [100, 10, 20])
        info = await asyncio.wait_for(infos.next(), 10)
    assert all(image.encoding == "bgr8" and image.header.frame_id == around.camera.frame for image in found)
    stamps = [image.header.stamp for image in found]
    assert stamps == sorted(set(stamps))
    assert (info.width, info.height) == (64, 48)
    assert info.k == [50, 0, 32, 0, 51, 24, 0, 0, 1] and not any(info.d)


async def test_service_stays_after_a_folder_without_loop_ends(folder, intrinsics):
    net = LocalNetwork()
    images = net.bus().reader(topics.CAMERA_IMAGE)
    async with running_service(net, run, config(source=folder, intrinsics=intrinsics, loop=False)):
        await read_until(images, lambda values: values[-1:] == [100])
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(images.next(), 0.1)


async def test_video_file_is_published(tmp_path, intrinsics):
    path = str(tmp_path / "clip.avi")
    writer = cv2.VideoWriter(path, cv2.VideoWriter.fourcc(*"MJPG"), 10, (64, 48))
    if not writer.isOpened():
        pytest.skip("this OpenCV cannot write a video")
    for value in (40, 80, 160):
        writer.write(plain(value))
    writer.release()
    net = LocalNetwork()
    images = net.bus().reader(topics.CAMERA_IMAGE)
    async with running_service(net, run, config(source=path, intrinsics=intrinsics, rate=50.0)):
        await read_until(images, lambda values: values[-3:] == pytest.approx([80, 160, 40], abs=4))


async def test_image_of_another_size_is_a_one_line_error(folder):
    net = LocalNetwork()
    with pytest.raises(ConfigError) as caught:
        async with running_service(net, run, config(source=folder)):
            await asyncio.sleep(10)
    line = str(caught.value)
    assert "640x480" in line and "64x48" in line and folder in line and "\n" not in line


class Flaky:
    """A device that gives two pictures each time it is opened, and is gone at first."""

    def __init__(self):
        self.opened = 0
        self.value = 0
        self.left = 0

    def open(self, *_args, **_kwargs):
        self.opened += 1
        self.left = 2
        return self if self.opened > 2 else None

    live = True

    def read(self):
        self.left -= 1
        self.value += 1
        return plain(self.value) if self.left >= 0 else None

    def close(self):
        pass


async def test_vanished_device_is_reported_and_reopened(monkeypatch, intrinsics, caplog):
    device = Flaky()
    monkeypatch.setattr(camera_opencv, "open_source", device.open)
    net = LocalNetwork()
    images = net.bus().reader(topics.CAMERA_IMAGE)
    quick = config(source=0, intrinsics=intrinsics, reopen_after=0.01, reopen_at_most=0.02)
    with caplog.at_level(logging.ERROR):
        async with running_service(net, run, quick, name="camera_opencv"):
            seen = set()
            while device.opened < 5 or len(seen) < 3:
                seen.add(value_of(await asyncio.wait_for(images.next(), 10)))
    lines = [record.getMessage() for record in caplog.records]
    assert lines[0] == "camera 0 delivers no image; opening it again in 0.01 s"
    assert lines[1].endswith("in 0.02 s")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda p: p / "nothing.mp4", "is not a device number, /dev path, video file or image folder"),
        (lambda p: p, "contains no image"),
    ],
)
def test_unknown_source_is_named_with_the_choices(tmp_path, make, message):
    with pytest.raises(ConfigError, match=message):
        open_source(str(make(tmp_path)), (64, 48), 10, loop=True)


@pytest.mark.parametrize("content", [b"not a picture", b""])
def test_non_image_file_in_a_folder_is_named(tmp_path, content):
    (tmp_path / "a.png").write_bytes(content)
    source = open_source(str(tmp_path), (64, 48), 10, loop=True)
    with pytest.raises(ConfigError, match=r"a\.png' is not a readable image"):
        source.read()


def test_missing_device_is_none():
    assert open_source("/dev/zencell-has-no-such-camera", (64, 48), 10, loop=True) is None


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("width: 64", "height"),
        ("{width: 64, height: 48, fx: -1, fy: 50, cx: 32, cy: 24}", "fx"),
        ("{width: 64, height: 48, fx: .nan, fy: 50, cx: 32, cy: 24}", "fx"),
        ("{width: 64, height: 48, fx: 50, fy: 50, cx: 32, cy: 24, skew: 1}", "skew"),
        ("width: [", "does not parse"),
    ],
)
def test_invalid_intrinsics_are_named(tmp_path, content, message):
    path = tmp_path / "camera.yaml"
    path.write_text(content)
    with pytest.raises(ConfigError, match=message):
        CameraFile.load(str(path))


def test_default_intrinsics_are_those_of_the_worlds_camera():
    i = calibrated(config(source=0))
    assert (i.width, i.height, i.fx, i.fy, i.cx, i.cy, i.d) == (640, 480, 520, 520, 320, 240, [])


def test_intrinsics_with_another_pose_than_the_world_are_rejected(tmp_path):
    path = tmp_path / "camera.yaml"
    path.write_text(yaml.safe_dump(SMALL | {"position": [0.1, 0.2, 0.9], "rpy": [3.1, 0.0, 0.0]}))
    with pytest.raises(ConfigError, match=r"another pose than the world's camera: .*--set world\.camera="):
        calibrated(config(source=0, intrinsics=str(path)))
    camera = around.camera
    path.write_text(yaml.safe_dump(SMALL | {"position": list(camera.position), "rpy": list(camera.rpy)}))
    assert calibrated(config(source=0, intrinsics=str(path))).fx == 50


def test_distortion_is_removed():
    i = CameraFile(width=320, height=240, fx=250, fy=250, cx=160, cy=120, d=[-0.3, 0.08])
    k = np.array([[250, 0, 160], [0, 250, 120], [0, 0, 1.0]])
    spot = np.array([[[0.4, 0.3, 1.0]]])
    (u, v), = cv2.projectPoints(spot, np.zeros(3), np.zeros(3), k, np.array([-0.3, 0.08, 0, 0]))[0][0]
    picture = np.zeros((240, 320, 3), np.uint8)
    cv2.circle(picture, (round(u * 16), round(v * 16)), 4 * 16, (255, 255, 255), -1, cv2.LINE_AA, 4)
    straight = Rectifier(i)(picture, "a test")
    found = np.average(np.argwhere(straight[..., 0] > 128), axis=0)[::-1]
    np.testing.assert_allclose(found, (160 + 100, 120 + 75), atol=0.7)


def test_grey_image_becomes_a_color_image():
    class Capture:
        def read(self):
            return True, np.full((48, 64), 7, np.uint8)

    assert Video(Capture(), live=True, loop=False).read().shape == (48, 64, 3)
    assert sources.IMAGE_SUFFIXES[0] == ".png"


async def test_service_writes_the_topics_of_the_simulated_camera():
    found = await wiring(run, config(source="/dev/null"))
    assert found.writes == {topics.CAMERA_IMAGE, topics.CAMERA_INFO}
    assert not found.reads
