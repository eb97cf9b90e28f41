import asyncio
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from common import topics
from common.config import Surroundings
from common.errors import ConfigError
from common.perception.camera_file import CameraFile, Rectifier
from common.perception.image import image_to_array
from common.perception.image_sources import Video, open_source
from services import camera_opencv
from services.camera_opencv import Config, calibrated
from tests.services.fake_cell import FakeCell, until

AROUND = Surroundings()
SMALL = {"width": 64, "height": 48, "fx": 50.0, "fy": 51.0, "cx": 32.0, "cy": 24.0}


def plain(value):
    return np.full((48, 64, 3), value, np.uint8)


@pytest.fixture
def intrinsics(tmp_path):
    path = tmp_path / "camera.yaml"
    path.write_text(yaml.safe_dump(SMALL))
    return str(path)


@pytest.fixture
def folder(tmp_path):
    path = tmp_path / "images"
    path.mkdir()
    for value in (10, 20, 100):
        cv2.imwrite(str(path / f"frame{value}.png"), plain(value))
    return str(path)


@pytest.fixture
def clip(tmp_path):
    path = str(tmp_path / "clip.avi")
    writer = cv2.VideoWriter(path, cv2.VideoWriter.fourcc(*"MJPG"), 10, (64, 48))
    assert writer.isOpened()
    for value in (10, 20, 100):
        writer.write(plain(value))
    writer.release()
    return path


def config(**values):
    return Config(world=AROUND, **{"rate": 200.0, **values})


class Cell(FakeCell):
    def __init__(self):
        super().__init__()
        self.images, self.infos = self.reader(topics.CAMERA_IMAGE), self.reader(topics.CAMERA_INFO)

    async def values_until(self, done):
        """Return images once the values of their pixels satisfy a condition."""
        found, values = [], []
        while not done(values):
            found.append(await until(self.images))
            values.append(int(image_to_array(found[-1])[0, 0, 0]))
        return found


@pytest.mark.parametrize("kind", ["folder", "clip"])
async def test_images_of_a_folder_or_video_are_published_in_order_and_repeated(kind, request, intrinsics):
    cell, source = Cell(), request.getfixturevalue(kind)
    async with cell.running(camera_opencv, config(source=source, intrinsics=intrinsics)):
        found = await cell.values_until(lambda values: values[-3:] == pytest.approx([100, 10, 20], abs=4))
        info = await until(cell.infos)
    assert all(image.encoding == "bgr8" and image.header.frame_id == AROUND.camera.frame for image in found)
    stamps = [image.header.stamp for image in found]
    assert stamps == sorted(set(stamps)) and (info.width, info.height) == (64, 48)
    assert info.k == [50, 0, 32, 0, 51, 24, 0, 0, 1] and not any(info.d)


async def test_unrectified_images_are_published_with_their_distortion(folder, tmp_path):
    (path := tmp_path / "distorted.yaml").write_text(yaml.safe_dump(SMALL | {"d": [0.1, -0.02, 0.0, 0.0]}))
    cell = Cell()
    async with cell.running(camera_opencv, config(source=folder, intrinsics=str(path), rectify=False)):
        info, image = await until(cell.infos), await until(cell.images)
    assert info.distortion_model == "plumb_bob" and info.d[:4] == [0.1, -0.02, 0.0, 0.0]
    assert (image_to_array(image) == plain(image_to_array(image)[0, 0, 0])).all(), "as it was read"


async def test_service_stays_after_a_folder_without_loop_ends(folder, intrinsics):
    cell = Cell()
    log = cell.reader(topics.LOG)
    async with cell.running(camera_opencv, config(source=folder, intrinsics=intrinsics, loop=False)):
        await until(log, lambda line: line.message == f"{folder} has ended")
        assert cell.images.received == 3


async def test_image_of_another_size_is_a_one_line_error(folder):
    with pytest.raises(ConfigError) as caught:
        async with Cell().running(camera_opencv, config(source=folder)):
            await asyncio.sleep(10)
    line = str(caught.value)
    assert "640x480" in line and "64x48" in line and folder in line and "\n" not in line


class Flaky:
    """A device that is absent at first and gives two images each time it is opened."""

    live, opened, value, left = True, 0, 0, 1

    def open(self, *_args, **_kwargs):
        self.opened += 1
        self.left = 2
        return self if self.opened > 2 else None

    def read(self):
        self.left -= 1
        self.value += 1
        return plain(self.value) if self.left >= 0 else None

    def close(self):
        pass


async def test_vanished_device_is_reported_and_reopened(monkeypatch, intrinsics):
    device, cell = Flaky(), Cell()
    log = cell.reader(topics.LOG)
    monkeypatch.setattr(camera_opencv, "open_source", device.open)
    quick = config(source=0, intrinsics=intrinsics, reopen_after=0.01, reopen_at_most=0.02)
    async with cell.running(camera_opencv, quick):
        await cell.values_until(lambda values: device.opened >= 5 and len(set(values)) >= 3)
        for seconds in ("0.01", "0.02"):
            line = await until(log)
            assert line.message == f"camera 0 delivers no image; opening it again in {seconds} s"


def test_unknown_source_is_named_with_the_choices_and_a_missing_device_is_none(tmp_path):
    def source_of(path: str | Path):
        return open_source(str(path), (64, 48), 10, loop=True)

    assert source_of("/dev/zencell-has-no-such-camera") is None
    for path, message in ((tmp_path / "nothing.mp4", "is not a device number, /dev path, video file or image folder"),
                          (tmp_path, "contains no image")):
        with pytest.raises(ConfigError, match=message):
            source_of(path)
    for content in (b"not an image", b""):
        (tmp_path / "a.png").write_bytes(content)
        with pytest.raises(ConfigError, match=r"a\.png' is not a readable image"):
            source_of(tmp_path).read()


@pytest.mark.parametrize(("device", "parameter"), [(lambda: None, "reopen_at_most"), (Flaky, "reopen_after")])
async def test_lost_camera_uses_the_timeout_set_live(monkeypatch, intrinsics, device, parameter):
    monkeypatch.setattr(camera_opencv, "open_source", lambda *_, **__: device())
    cell, tuned = Cell(), config(source=0, intrinsics=intrinsics, reopen_after=1e-3, reopen_at_most=1e-2)
    log = cell.reader(topics.LOG)
    async with cell.running(camera_opencv, tuned):
        for seconds in ("0.001", "0.002"):
            setattr(tuned, parameter, float(seconds))
            await until(log, lambda line, s=seconds: line.message.endswith(f"opening it again in {s} s"))


def test_intrinsics_are_those_of_the_worlds_camera_or_of_a_file_with_its_pose(tmp_path):
    i = calibrated(config(source=0))
    assert (i.width, i.height, i.fx, i.fy, i.cx, i.cy, i.d) == (640, 480, 520, 520, 320, 240, [])
    path = tmp_path / "camera.yaml"
    for content, message in (("{width: 64, height: 48, fx: .nan, fy: 50, cx: 32, cy: 24}", "fx"),
                             ("width: [", "does not parse")):
        path.write_text(content)
        with pytest.raises(ConfigError, match=message):
            calibrated(config(source=0, intrinsics=str(path)))
    path.write_text(yaml.safe_dump(SMALL | {"position": [0.1, 0.2, 0.9], "rpy": [3.1, 0.0, 0.0]}))
    with pytest.raises(ConfigError, match=r"another pose than the world's camera: .*--set world\.camera="):
        calibrated(config(source=0, intrinsics=str(path)))
    camera = AROUND.camera
    path.write_text(yaml.safe_dump(SMALL | {"position": list(camera.position), "rpy": list(camera.rpy)}))
    assert calibrated(config(source=0, intrinsics=str(path))).fx == 50


def test_distortion_is_removed():
    i = CameraFile(width=320, height=240, fx=250, fy=250, cx=160, cy=120, d=[-0.3, 0.08])
    spot = np.array([[[0.4, 0.3, 1.0]]])
    (u, v), = cv2.projectPoints(spot, np.zeros(3), np.zeros(3), i.matrix, np.array([-0.3, 0.08, 0, 0]))[0][0]
    image = np.zeros((240, 320, 3), np.uint8)
    cv2.circle(image, (round(u * 16), round(v * 16)), 4 * 16, (255, 255, 255), -1, cv2.LINE_AA, 4)
    straight = Rectifier(i)(image, "a test")
    found = np.average(np.argwhere(straight[..., 0] > 128), axis=0)[::-1]
    np.testing.assert_allclose(found, (160 + 100, 120 + 75), atol=0.7)


def test_grey_image_becomes_a_color_image():
    class Capture:
        def read(self):
            return True, np.full((48, 64), 7, np.uint8)

    assert Video(Capture(), live=True, loop=False).read().shape == (48, 64, 3)
