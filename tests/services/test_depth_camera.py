"""docs/depth_camera.md: drivers in the service that they are for, with cameras that are not there."""

from __future__ import annotations

import asyncio
import importlib
import sys
import time
import types
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from common import topics
from common.config import check, load_cell, service_config
from common.config.world import Surroundings
from common.errors import ConfigError
from common.messages import Header, LogLine
from common.perception.depth import depth_of
from common.perception.depth_drivers import RgbdFrame
from common.perception.image import image_to_array
from common.perception.pinhole import Pinhole
from common.planning.camera_obstacles import cloud_points
from common.process.in_process import running_service
from common.sim.interface import load_world
from common.sim.rendering import Renderer
from common.supervision.wiring import wiring
from common.transport.local import LocalNetwork
from common.transport.reader import Reader
from services import depth_camera, real_depth_camera
from tests import pages

PAGE = pages.text_of("docs/depth_camera.md")
DRIVER, OWN = "realsense", "my_pkg.recorded"
WIDTH, HEIGHT = 64, 48
SCALE = 0.00025  # [m] of one step: other than the usual one
STEPS = 4000


class FakeCamera:
    """What pyrealsense2 knows of cameras: it may be unplugged. Its colour lens is not its depth lens."""

    def __init__(self) -> None:
        self.plugged, self.coeffs, self.opened, self.stopped = True, [0.0] * 5, 0, 0
        self.streams: dict[str, tuple[Any, ...]] = {}
        self.shot: RgbdFrame | None = None  # what it sees, where that matters
        self.lenses = {"color": (40.0, 41.0, 31.0, 23.0), "depth": (35.0, 35.0, 30.0, 22.0)}

    def module(self) -> types.ModuleType:
        """A module with as much of pyrealsense2 as the page uses."""
        fake = self
        space = types.SimpleNamespace

        def require() -> None:
            if not fake.plugged:
                raise RuntimeError("Frame didn't arrive within 1000")

        class Frame:
            def __init__(self, data: np.ndarray, lens: str) -> None:
                self.data, self.lens = data, lens

            def get_data(self) -> np.ndarray:
                return self.data

            def get_timestamp(self) -> float:
                return 1e3 * (time.time() - 0.2)

            def get_frame_timestamp_domain(self) -> str:
                return "global"

        class Frames:
            """Depth has a column without a measurement, and the first set no colour."""

            def __init__(self, number: int, aligned: str = "") -> None:
                self.number, self.aligned = number, aligned

            def get_depth_frame(self) -> Frame:
                steps = np.full((HEIGHT, WIDTH), STEPS if self.aligned else 1, np.uint16)
                steps[:, 5] = 0
                if fake.shot is not None and self.aligned:
                    steps = np.rint(np.nan_to_num(fake.shot.depth) / SCALE).astype(np.uint16)
                return Frame(steps, self.aligned)

            def get_color_frame(self) -> Frame | None:
                picture = np.full((HEIGHT, WIDTH, 3), (10, 20, 200), np.uint8)
                if fake.shot is not None:
                    picture = fake.shot.colour
                return Frame(picture, "color") if self.number > 1 else None

        class Align:
            def __init__(self, stream: str) -> None:
                self.stream = stream

            def process(self, frames: Frames) -> Frames:
                return Frames(frames.number, self.stream)

        class Config:
            def __init__(self) -> None:
                self.asked: dict[str, tuple[Any, ...]] = {}

            def enable_device(self, serial: str) -> None:
                self.asked["device"] = (serial,)

            def enable_stream(self, stream: str, *mode: Any) -> None:
                self.asked[stream] = mode

        class Profile:
            def get_device(self) -> Any:
                return space(first_depth_sensor=lambda: space(get_depth_scale=lambda: SCALE), is_playback=lambda: False)

            def get_stream(self, stream: str) -> Any:
                fx, fy, ppx, ppy = fake.lenses[stream]
                found = space(width=WIDTH, height=HEIGHT, fx=fx, fy=fy, ppx=ppx, ppy=ppy,
                              coeffs=fake.coeffs if stream == "color" else [0.0] * 5)
                return space(as_video_stream_profile=lambda: space(get_intrinsics=lambda: found), format=lambda: "bgr8")

        class Pipeline:
            def __init__(self) -> None:
                self.count, self.running = 0, False

            def start(self, config: Config) -> Profile:
                if config.asked["color"][0] != WIDTH:
                    raise RuntimeError("Couldn't resolve requests")
                fake.opened, fake.streams, self.running = fake.opened + 1, config.asked, True
                return Profile()

            def wait_for_frames(self, patience: int) -> Frames:
                require()
                time.sleep(0.002)
                self.count += 1
                return Frames(self.count)

            def stop(self) -> None:
                fake.stopped += 1
                require()

        module: Any = types.ModuleType("pyrealsense2")
        module.stream, module.format = space(color="color", depth="depth"), space(z16="z16", bgr8="bgr8", rgb8="rgb8")
        module.camera_info, module.timestamp_domain = space(serial_number="serial"), space(global_time="global")
        module.config, module.pipeline, module.align = Config, Pipeline, Align
        device = space(get_info=lambda what: "0123" if what == "serial" else "")
        module.context = lambda: space(query_devices=lambda: [device] if fake.plugged else [])
        return module


@pytest.fixture
def camera(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeCamera]:
    """A camera that is plugged in, and the page's driver where the service finds it."""
    for name, text in pages.files(PAGE).items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text, encoding="utf-8")
    fake = FakeCamera()
    monkeypatch.setitem(sys.modules, "pyrealsense2", fake.module())
    monkeypatch.syspath_prepend(tmp_path)
    yield fake
    for name in ("my_pkg", OWN):
        sys.modules.pop(name, None)


def config_of(size: tuple[int, int] = (WIDTH, HEIGHT), **more: Any) -> real_depth_camera.Config:
    """As the page's cell says it, for small pictures."""
    said = next(yaml.safe_load(text) for kind, text in pages.blocks(PAGE) if kind == "yaml")
    around = check(Surroundings, said["world"] | {"camera": {**said["world"]["camera"], "width": size[0],
                                                             "height": size[1]}}, "world")
    quick = {"rate": 90.0, "reopen_after": 0.01, "reopen_at_most": 0.02}
    given = {**said["services"]["real_depth_camera"], **quick, **more}
    return check(real_depth_camera.Config, {**given, "world": around}, "services.real_depth_camera")


async def test_color_depth_points_and_intrinsics_are_published(camera: FakeCamera) -> None:
    net = LocalNetwork()
    bus = net.bus()
    images, depths = bus.reader(topics.DEPTH_CAMERA_IMAGE), bus.reader(topics.DEPTH_CAMERA_DEPTH)
    infos, clouds = bus.reader(topics.DEPTH_CAMERA_INFO), bus.reader(topics.DEPTH_CAMERA_POINTS)
    async with running_service(net, real_depth_camera.run, config_of(), name="camera"), asyncio.timeout(30):
        info, image, depth, cloud = (await infos.next(), await images.next(), await depths.next(), await clouds.next())
        age = (bus.clock.now_ns() - image.header.stamp) * 1e-9
    assert camera.streams == {"device": ("0123",), "depth": (WIDTH, HEIGHT, "z16", 30),
                              "color": (WIDTH, HEIGHT, "bgr8", 30)}
    assert (info.k[0], info.k[4], info.k[2], info.k[5]) == camera.lenses["color"] and not any(info.d)
    assert (info.width, info.height) == (WIDTH, HEIGHT)
    assert {one.header.frame_id for one in (info, image, depth, cloud)} == {"depth_camera_optical_frame"}
    assert image_to_array(image)[3, 4].tolist() == [10, 20, 200]
    metres = depth_of(depth)
    assert np.isnan(metres[:, 5]).all() and np.allclose(np.delete(metres, 5, axis=1), STEPS * SCALE)
    points = cloud_points(cloud)
    assert len(points) == (WIDTH - 1) * HEIGHT and np.allclose(points[:, 2], STEPS * SCALE)
    assert np.isclose(points[:, 0].min(), -31.0 / 40.0 * STEPS * SCALE)
    assert age >= 0.2  # it was exposed before it came


async def wait_for_line(log: Reader[LogLine], line: str) -> None:
    """Return when a line of the log begins so."""
    async for message in log:
        if message.message.startswith(line):
            return


async def test_unplugged_realsense_is_reported_and_reopened(camera: FakeCamera) -> None:
    net = LocalNetwork()
    bus = net.bus()
    images, log = bus.reader(topics.DEPTH_CAMERA_IMAGE), bus.reader(topics.LOG)
    camera.plugged = False
    async with running_service(net, real_depth_camera.run, config_of(), name="camera"), asyncio.timeout(30):
        await wait_for_line(log, f"camera {DRIVER}: no RealSense is plugged in; opening it again in 0.01 s")
        camera.plugged = True
        first = await images.next()
        camera.plugged = False
        await wait_for_line(log, f"camera {DRIVER}: Frame didn't arrive within 1000; opening it again in 0.01 s")
        camera.plugged = True
        again = await images.next()
        while camera.opened < 2:  # the newest picture from before may not have been read yet
            again = await images.next()
    assert again.header.stamp > first.header.stamp and (camera.opened, camera.stopped) == (2, 1)


async def test_distorted_lens_is_rejected_and_depth_lens_is_selectable(camera: FakeCamera) -> None:
    camera.coeffs = [0.1, 0.0, 0.0, 0.0, 0.0]
    with pytest.raises(ConfigError, match=r"options\.align: 'color' has distortion .* corrected: choose depth"):
        async with running_service(LocalNetwork(), real_depth_camera.run, config_of(), name="camera"):
            await asyncio.sleep(10)
    net = LocalNetwork()
    infos = net.bus().reader(topics.DEPTH_CAMERA_INFO)
    aligned = config_of(options={"align": "depth"})
    async with running_service(net, real_depth_camera.run, aligned, name="camera"), asyncio.timeout(30):
        assert (await infos.next()).k[0] == camera.lenses["depth"][0]


async def test_unsupported_mode_is_reported_with_the_request(camera: FakeCamera) -> None:
    net = LocalNetwork()
    log = net.bus().reader(topics.LOG)
    asked = config_of((128, 96))
    async with running_service(net, real_depth_camera.run, asked, name="camera"), asyncio.timeout(30):
        await wait_for_line(log, f"camera {DRIVER}: 128x96 at 30 Hz: Couldn't resolve requests; opening it again in")


@pytest.mark.parametrize(("options", "message"), [
    ({"driver": ""}, "services.camera.driver: '' must be one of oak, realsense, or the dotted name of a module"),
    ({"driver": "my_pkg.nothing"}, "services.camera.driver: 'my_pkg.nothing' cannot be imported: No module named"),
    ({"driver": "common.errors"}, "'common.errors' is no camera driver: it lacks Options, open_camera"),
    ({"options": {"fps": 900}}, "services.camera.options.fps: 900 must be less than or equal to 90"),
    ({"options": {"speed": 3}}, "services.camera.options.speed: "),
])
async def test_unknown_driver_or_option_is_a_one_line_error(
    camera: FakeCamera, options: dict[str, Any], message: str,
) -> None:
    with pytest.raises(ConfigError) as refused:
        async with running_service(LocalNetwork(), real_depth_camera.run, config_of(**options), name="camera"):
            await asyncio.sleep(10)
    assert message in str(refused.value) and "\n" not in str(refused.value)


async def test_frame_of_unexpected_shape_is_a_one_line_error(
    camera: FakeCamera, monkeypatch: pytest.MonkeyPatch,
) -> None:
    driver = importlib.import_module(f"drivers.{DRIVER}")
    monkeypatch.setattr(driver, "RgbdFrame",
                        lambda colour, depth, age: RgbdFrame(colour, depth.astype(np.float64), age))
    with pytest.raises(ConfigError, match=r"'realsense' gives depth of shape \(48, 64\) and type float64"):
        async with running_service(LocalNetwork(), real_depth_camera.run, config_of(), name="camera"):
            await asyncio.sleep(10)


async def test_service_writes_the_topics_of_the_simulated_camera(camera: FakeCamera) -> None:
    ur5 = load_cell("ur5")
    simulated = await wiring(depth_camera.run, service_config(ur5, "depth_camera", depth_camera.Config))
    real = await wiring(real_depth_camera.run, config_of())
    assert real.writes == simulated.writes and not real.reads


# --- cameras that see what the project draws -----------------------------------------------------------------------

LENS = (40.0, 40.0, 31.5, 23.5)


def drawn() -> RgbdFrame:
    """What a camera above the objects of a cell sees, and depth of which a part was not measured."""
    cell = load_cell("ur5", world="w3")
    T = Pinhole.from_config(cell.world.camera).T_world_optical
    objects = load_world(cell.world, cell.world.objects).objects(Header()).objects
    camera = Pinhole(*(10 * f for f in LENS[:2]), *LENS[2:], WIDTH, HEIGHT, T)
    view = Renderer(cell.world, camera=camera).render(objects)
    depth = view.depth_within(0.1, 10.0)
    depth[:, 3] = np.nan
    assert len(np.unique(depth[np.isfinite(depth)])) > 1, "an object is visible"
    return RgbdFrame(view.colour, depth)


class FakeOak:
    """What depthai knows of a camera, whose pictures are a shot."""

    def __init__(self, shot: RgbdFrame) -> None:
        self.shot, self.plugged, self.closed, self.aligned_by = shot, True, 0, ""
        self.asked: dict[str, Any] = {}
        self.platform = "RVC2"

    def module(self) -> types.ModuleType:
        """A module with as much of depthai as the driver uses."""
        fake, space = self, types.SimpleNamespace
        k = [[LENS[0], 0, LENS[2]], [0, LENS[1], LENS[3]], [0, 0, 1]]
        frame = space(getTransformation=lambda: space(getIntrinsicMatrix=lambda: k), getWidth=lambda: WIDTH,
                      getHeight=lambda: HEIGHT, getCvFrame=lambda: fake.shot.colour,
                      getTimestamp=lambda: timedelta(seconds=10.0))
        steps = np.rint(np.nan_to_num(self.shot.depth) * 1000).astype(np.uint16)

        def linked(name: str) -> Any:
            def link(to: Any) -> None:
                if to in ("stereo.align", "align.align"):
                    fake.aligned_by = to.partition(".")[0]
            return space(link=link, name=name)

        class Camera:
            def build(self, socket: str) -> Camera:
                self.socket = socket
                return self

            def requestOutput(self, size: tuple[int, int], **how: Any) -> Any:  # noqa: N802
                fake.asked[self.socket] = (size, how)
                return linked(self.socket)

        class Stereo:
            inputAlignTo, depth = "stereo.align", linked("depth")  # noqa: N815

            def build(self, left: Any, right: Any, presetMode: str) -> Stereo:  # noqa: N803
                assert (left.name, right.name) == ("left", "right")
                return self

            def setLeftRightCheck(self, on: bool) -> None: ...  # noqa: N802

            def setSubpixel(self, on: bool) -> None: ...  # noqa: N802

            PresetMode = space(DEFAULT="default")

        class Align:
            input, inputAlignTo, outputAligned = "align.in", "align.align", linked("aligned")  # noqa: N815

        class Queue:
            def get(self, timeout: timedelta) -> Any:
                if not fake.plugged:
                    raise RuntimeError("queue was closed")
                time.sleep(0.002)
                return {"rgb": frame, "depth": space(getFrame=lambda: steps)}

        class Sync:
            inputs = types.MappingProxyType({"rgb": "sync.rgb", "depth": "sync.depth"})
            out = space(createOutputQueue=lambda maxSize, blocking: Queue())

            def setSyncThreshold(self, threshold: timedelta) -> None: ...  # noqa: N802

        def device(*which: Any) -> Any:
            if not fake.plugged:
                raise RuntimeError("No available devices")
            return space(getPlatform=lambda: fake.platform, close=lambda: None)

        def stop() -> None:
            fake.closed += 1

        module: Any = types.ModuleType("depthai")
        module.Device, module.DeviceInfo = device, lambda name: name
        module.Pipeline = lambda device: space(create=lambda kind: kind(), start=lambda: None, stop=stop)
        module.CameraBoardSocket = space(CAM_A="color", CAM_B="left", CAM_C="right")
        module.Platform, module.Clock = space(RVC4="RVC4"), space(now=lambda: timedelta(seconds=10.1))
        module.ImgFrame = space(Type=space(BGR888i="bgr"))
        module.node = space(Camera=Camera, StereoDepth=Stereo, ImageAlign=Align, Sync=Sync)
        return module


async def seen(config: real_depth_camera.Config) -> tuple[np.ndarray, np.ndarray, list[float]]:
    """Picture, depth [m] and intrinsics that are sent."""
    net = LocalNetwork()
    bus = net.bus()
    images, depths = bus.reader(topics.DEPTH_CAMERA_IMAGE), bus.reader(topics.DEPTH_CAMERA_DEPTH)
    infos = bus.reader(topics.DEPTH_CAMERA_INFO)
    async with running_service(net, real_depth_camera.run, config, name="camera"), asyncio.timeout(30):
        return image_to_array(await images.next()), depth_of(await depths.next()), (await infos.next()).k


async def test_realsense_publishes_depth_within_half_a_step(camera: FakeCamera) -> None:
    camera.shot = drawn()
    picture, depth, _ = await seen(config_of())
    np.testing.assert_array_equal(picture, camera.shot.colour)
    np.testing.assert_array_equal(np.isnan(depth), np.isnan(camera.shot.depth))
    np.testing.assert_allclose(depth, camera.shot.depth, atol=SCALE / 2 + 1e-6)


@pytest.mark.parametrize(("platform", "aligned_by"), [("RVC2", "stereo"), ("RVC4", "align")])
async def test_oak_publishes_depth_within_half_a_millimeter(
    monkeypatch: pytest.MonkeyPatch, platform: str, aligned_by: str,
) -> None:
    fake = FakeOak(drawn())
    fake.platform = platform
    monkeypatch.setitem(sys.modules, "depthai", fake.module())
    picture, depth, k = await seen(config_of(driver="oak", options={"fps": 20}))
    np.testing.assert_array_equal(picture, fake.shot.colour)
    np.testing.assert_array_equal(np.isnan(depth), np.isnan(fake.shot.depth))
    np.testing.assert_allclose(depth, fake.shot.depth, atol=0.5e-3 + 1e-6)
    assert (k[0], k[4], k[2], k[5]) == LENS and fake.aligned_by == aligned_by
    assert fake.asked["color"] == ((WIDTH, HEIGHT), {"type": "bgr", "fps": 20.0, "enableUndistortion": True})


async def test_unplugged_oak_is_reported_and_reopened(monkeypatch: pytest.MonkeyPatch) -> None:
    fake = FakeOak(drawn())
    monkeypatch.setitem(sys.modules, "depthai", fake.module())
    net = LocalNetwork()
    bus = net.bus()
    images, log = bus.reader(topics.DEPTH_CAMERA_IMAGE), bus.reader(topics.LOG)
    fake.plugged = False
    async with running_service(net, real_depth_camera.run, config_of(driver="oak", options={}), name="camera"):
        async with asyncio.timeout(30):
            await wait_for_line(log, "camera oak: No available devices; opening it again in")
            fake.plugged = True
            await images.next()
            fake.plugged = False
            await wait_for_line(log, "camera oak: queue was closed; opening it again in")
            fake.plugged = True
            while not fake.closed:
                await images.next()


@pytest.mark.parametrize(("driver", "package"), [("realsense", "pyrealsense2"), ("oak", "depthai")])
async def test_missing_package_is_reported_with_its_extra(
    monkeypatch: pytest.MonkeyPatch, driver: str, package: str,
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ConfigError, match=rf"'{driver}' needs the extra `{driver}`: pip install 'zencell\[{driver}\]'"):
        async with running_service(LocalNetwork(), real_depth_camera.run, config_of(driver=driver, options={}),
                                   name="camera"):
            await asyncio.sleep(10)


async def test_driver_from_the_docs_plays_recorded_frames(camera: FakeCamera, tmp_path: Path) -> None:
    shot = drawn()
    np.savez(tmp_path / "shot_1.npz", colour=shot.colour, depth=shot.depth, lens=np.array(LENS))
    picture, depth, k = await seen(config_of(driver=OWN, options={"folder": str(tmp_path)}))
    np.testing.assert_array_equal(picture, shot.colour)
    np.testing.assert_array_equal(depth, shot.depth)
    assert (k[0], k[4], k[2], k[5]) == LENS
