"""docs/depth_camera.md: drivers in the service that they are for, with cameras that are not there."""

from __future__ import annotations

import asyncio
import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from common import topics
from common.config import check, load_cell
from common.config.world import Surroundings
from common.errors import ConfigError
from common.messages import Header
from common.perception.depth import depth_of
from common.perception.depth_drivers import RgbdFrame
from common.perception.image import image_to_array
from common.perception.pinhole import Pinhole
from common.planning.camera_obstacles import cloud_points
from common.sim.interface import load_world
from common.sim.rendering import Renderer
from services import real_depth_camera
from tests import pages
from tests.services.depth_camera_sdks import HEIGHT, LENS, SCALE, STEPS, WIDTH, FakeOak, FakeRealSense
from tests.services.fake_cell import FakeCell, until

PAGE = pages.text_of("docs/depth_camera.md")
OWN_DRIVER = "my_pkg.recorded"


@pytest.fixture(scope="module")
def shot() -> RgbdFrame:
    """Images of the objects of a cell from above, without depth in one column."""
    cell = load_cell("ur5", world="w3")
    T = Pinhole.from_config(cell.world.camera).T_world_optical
    camera = Pinhole(*(10 * f for f in LENS[:2]), *LENS[2:], WIDTH, HEIGHT, T)
    objects = load_world(cell.world, cell.world.objects).objects(Header()).objects
    view = Renderer(cell.world, camera=camera).render(objects)
    depth = view.depth_within(0.1, 10.0)
    depth[:, 3] = np.nan
    assert len(np.unique(depth[np.isfinite(depth)])) > 1, "an object is visible"
    return RgbdFrame(view.colour, depth)


@pytest.fixture
def realsense(monkeypatch: pytest.MonkeyPatch) -> FakeRealSense:
    fake = FakeRealSense()
    monkeypatch.setitem(sys.modules, "pyrealsense2", fake.module())
    return fake


@pytest.fixture
def oak(shot: RgbdFrame, monkeypatch: pytest.MonkeyPatch) -> FakeOak:
    fake = FakeOak(shot)
    monkeypatch.setitem(sys.modules, "depthai", fake.module())
    return fake


@pytest.fixture
def own_driver(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the driver of the page importable."""
    for name, text in pages.files(PAGE).items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    for name in ("my_pkg", OWN_DRIVER):
        monkeypatch.delitem(sys.modules, name, raising=False)


def config_of(size: tuple[int, int] = (WIDTH, HEIGHT), **more: Any) -> real_depth_camera.Config:
    """Return the configuration of the page's cell, for small images."""
    cell = next(yaml.safe_load(text) for kind, text in pages.blocks(PAGE) if kind == "yaml")
    camera = {**cell["world"]["camera"], "width": size[0], "height": size[1]}
    quick = {"rate": 90.0, "reopen_after": 0.01, "reopen_at_most": 0.02}
    return check(real_depth_camera.Config, {
        **cell["services"]["real_depth_camera"], **quick, **more,
        "world": check(Surroundings, {**cell["world"], "camera": camera}, "world"),
    }, "services.real_depth_camera")


class Camera(FakeCell):
    """The subscribers of a camera."""

    def __init__(self, **config: Any) -> None:
        super().__init__()
        self.config = config_of(**config)
        self.images, self.depths = self.reader(topics.DEPTH_CAMERA_IMAGE), self.reader(topics.DEPTH_CAMERA_DEPTH)
        self.infos, self.log = self.reader(topics.DEPTH_CAMERA_INFO), self.reader(topics.LOG)

    def on(self) -> Any:
        return self.running(real_depth_camera, self.config)

    async def reported(self, line: str) -> None:
        await until(self.log, lambda logged: logged.message.startswith(line))

    async def frame(self) -> tuple[np.ndarray, np.ndarray, list[float]]:
        """Return color, depth [m] and intrinsics (fx, fy, cx, cy) of a running camera."""
        async with self.on():
            color, depth, info = await until(self.images), await until(self.depths), await until(self.infos)
        return image_to_array(color), depth_of(depth), [info.k[i] for i in (0, 4, 2, 5)]

    async def error(self) -> str:
        """Return the only line of the error that ends the service."""
        with pytest.raises(ConfigError) as caught:
            async with self.on():
                await asyncio.sleep(10)
        assert "\n" not in str(caught.value)
        return str(caught.value)


async def test_color_depth_points_and_intrinsics_are_published(realsense: FakeRealSense) -> None:
    camera = Camera()
    clouds = camera.reader(topics.DEPTH_CAMERA_POINTS)
    async with camera.on():
        info, image, depth, cloud = messages = [
            await until(reader) for reader in (camera.infos, camera.images, camera.depths, clouds)]
        age = (camera.clock.now_ns() - image.header.stamp) * 1e-9
    assert realsense.streams == {"device": ("0123",), "depth": (WIDTH, HEIGHT, "z16", 30),
                                 "color": (WIDTH, HEIGHT, "bgr8", 30)}
    assert (info.k[0], info.k[4], info.k[2], info.k[5]) == realsense.lenses["color"] and not any(info.d)
    assert (info.width, info.height) == (WIDTH, HEIGHT)
    assert {one.header.frame_id for one in messages} == {"depth_camera_optical_frame"}
    assert image_to_array(image)[3, 4].tolist() == [10, 20, 200] and age >= 0.2, "exposed before it arrived"
    metres = depth_of(depth)
    assert np.isnan(metres[:, 5]).all() and np.allclose(np.delete(metres, 5, axis=1), STEPS * SCALE)
    points = cloud_points(cloud)
    assert len(points) == (WIDTH - 1) * HEIGHT and np.allclose(points[:, 2], STEPS * SCALE)
    assert np.isclose(points[:, 0].min(), -31.0 / 40.0 * STEPS * SCALE)


def assert_shows(color: np.ndarray, depth: np.ndarray, shot: RgbdFrame, tolerance: float) -> None:
    np.testing.assert_array_equal(color, shot.colour)
    np.testing.assert_array_equal(np.isnan(depth), np.isnan(shot.depth))
    np.testing.assert_allclose(depth, shot.depth, atol=tolerance)


async def test_realsense_publishes_depth_within_half_a_step(realsense: FakeRealSense, shot: RgbdFrame) -> None:
    realsense.shot = shot
    color, depth, _ = await Camera().frame()
    assert_shows(color, depth, shot, SCALE / 2 + 1e-6)


@pytest.mark.parametrize(("platform", "aligned_by"), [("RVC2", "stereo"), ("RVC4", "align")])
async def test_oak_publishes_depth_within_half_a_millimeter(oak: FakeOak, platform: str, aligned_by: str) -> None:
    oak.platform = platform
    color, depth, lens = await Camera(driver="oak", options={"fps": 20}).frame()
    assert_shows(color, depth, oak.shot, 0.5e-3 + 1e-6)
    assert tuple(lens) == LENS and oak.aligned_by == aligned_by
    assert oak.outputs["color"] == ((WIDTH, HEIGHT), {"type": "bgr", "fps": 20.0, "enableUndistortion": True})


async def test_driver_from_the_docs_plays_recorded_frames(own_driver: None, tmp_path: Path, shot: RgbdFrame) -> None:
    np.savez(tmp_path / "shot_1.npz", colour=shot.colour, depth=shot.depth, lens=np.array(LENS))
    color, depth, lens = await Camera(driver=OWN_DRIVER, options={"folder": str(tmp_path)}).frame()
    assert_shows(color, depth, shot, 0.0)
    assert tuple(lens) == LENS


async def unplug_and_plug_in(camera: Camera, fake: Any, absent: str, lost: str, opened: Callable[[], bool]) -> None:
    """Start without the camera, plug it in, unplug it, and plug it in again; images must follow."""
    fake.plugged = False
    async with camera.on():
        await camera.reported(f"{absent}; opening it again in 0.01 s")
        fake.plugged = True
        first = await until(camera.images)
        fake.plugged = False
        await camera.reported(f"{lost}; opening it again in 0.01 s")
        fake.plugged = True
        await until(camera.images, lambda image: opened() and image.header.stamp > first.header.stamp)


async def test_unplugged_realsense_is_reported_and_reopened(realsense: FakeRealSense) -> None:
    await unplug_and_plug_in(
        Camera(), realsense, "camera realsense: no RealSense is plugged in",
        "camera realsense: Frame didn't arrive within 1000", lambda: (realsense.opened, realsense.stopped) == (2, 1))


async def test_unplugged_oak_is_reported_and_reopened(oak: FakeOak) -> None:
    await unplug_and_plug_in(Camera(driver="oak", options={}), oak, "camera oak: No available devices",
                             "camera oak: queue was closed", lambda: oak.closed == 1)


async def test_distorted_lens_is_rejected_and_depth_lens_is_selectable(realsense: FakeRealSense) -> None:
    realsense.coeffs = [0.1, 0.0, 0.0, 0.0, 0.0]
    error = await Camera().error()
    assert "options.align: 'color' has distortion" in error and "corrected: choose depth" in error
    _, _, lens = await Camera(options={"align": "depth"}).frame()
    assert tuple(lens) == realsense.lenses["depth"]


async def test_unsupported_mode_is_reported_with_the_request(realsense: FakeRealSense) -> None:
    camera = Camera(size=(128, 96))
    async with camera.on():
        await camera.reported("camera realsense: 128x96 at 30 Hz: Couldn't resolve requests; opening it again in")


@pytest.mark.parametrize(("config", "message"), [
    ({"driver": ""}, "driver: '' must be one of oak, realsense, or the dotted name of a module"),
    ({"driver": "my_pkg.nothing"}, "driver: 'my_pkg.nothing' is not a module: there is no"),
    ({"driver": "common.errors"}, "'common.errors' is no camera driver: it lacks Options, open_camera"),
    ({"options": {"fps": 900}}, "options.fps: 900 must be less than or equal to 90"),
    ({"options": {"speed": 3}}, "services.real_depth_camera.options.speed: "),
    ({"driver": "realsense", "options": {}}, "needs the extra `realsense`: pip install 'zencell[realsense]'"),
    ({"driver": "oak", "options": {}}, "needs the extra `oak`: pip install 'zencell[oak]'"),
])
async def test_unknown_driver_or_option_or_missing_package_is_a_one_line_error(
    own_driver: None, monkeypatch: pytest.MonkeyPatch, config: dict[str, Any], message: str,
) -> None:
    for package in ("pyrealsense2", "depthai"):
        monkeypatch.setitem(sys.modules, package, None)
    assert message in await Camera(**config).error()


async def test_frame_of_unexpected_shape_is_a_one_line_error(realsense, monkeypatch):
    monkeypatch.setattr(importlib.import_module("drivers.realsense"), "RgbdFrame",
                        lambda colour, depth, age: RgbdFrame(colour, depth.astype(np.float64), age))
    assert "'realsense' gives depth of shape (48, 64) and type float64" in await Camera().error()
