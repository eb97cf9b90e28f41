"""Recordings of rendered images in the format of RealSense, played by the vendor's package."""

import asyncio
import time
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from common import topics
from common.config import check, load_cell
from common.errors import ConfigError
from common.messages import Header
from common.perception.depth import depth_of
from common.perception.depth_drivers import RgbdFrame
from common.perception.image import image_to_array
from common.perception.pinhole import Pinhole
from common.process.in_process import running_service
from common.sim.interface import load_world
from common.sim.rendering import Renderer
from common.transport.local import LocalNetwork
from services import real_depth_camera

rs = pytest.importorskip("pyrealsense2", reason="make setup EXTRAS=realsense", exc_type=ImportError)

WIDTH, HEIGHT, FOCAL = 320, 240, 300.0
SCALE = 0.001  # [m] of one step of depth
PERIOD = 33.0  # [ms] between two frames
HOLE = np.s_[100:140, 20:60]  # without depth
WORLD = load_cell("ur5", world="w3").world


def rendered(number: int) -> RgbdFrame:
    """Render the objects of a cell from above with a hole in the depth, 1 cm further away for each number."""
    objects = load_world(WORLD, WORLD.objects).objects(Header()).objects
    T = Pinhole.from_config(WORLD.camera).T_world_optical
    view = Renderer(WORLD, camera=Pinhole(FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT, T)).render(objects)
    depth = view.depth_within(0.1, 10.0) + np.float32(0.01 * number)
    depth[HOLE] = np.nan
    assert len(np.unique(depth[np.isfinite(depth)])) > 1, "an object is visible"
    return RgbdFrame(view.colour, depth)


def record(file: Path, shots: Sequence[RgbdFrame], colours: str = "rgb8", *, depth_too: bool = True) -> None:
    """Record shots of a software device, as the vendor's viewer does of a camera."""
    device = rs.software_device()
    lens = rs.intrinsics()
    lens.width, lens.height, lens.fx, lens.fy, lens.ppx, lens.ppy = WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2
    lens.model, lens.coeffs = rs.distortion.none, [0.0] * 5
    sensors: list[tuple[Any, Any, int]] = []
    streams = [("Depth", rs.stream.depth, rs.format.z16, 2), ("Color", rs.stream.color, getattr(rs.format, colours), 3)]
    for uid, (name, kind, form, size) in enumerate(streams[0 if depth_too else 1:]):
        stream = rs.video_stream()
        stream.type, stream.fmt, stream.bpp, stream.uid, stream.index, stream.fps = kind, form, size, uid, 0, 30
        stream.width, stream.height, stream.intrinsics = WIDTH, HEIGHT, lens
        sensor = device.add_sensor(name)
        sensors.append((sensor, sensor.add_video_stream(stream).as_video_stream_profile(), size))
        if kind == rs.stream.depth:
            sensor.add_read_only_option(rs.option.depth_units, SCALE)
    same = rs.extrinsics()
    same.rotation, same.translation = np.eye(3).ravel().tolist(), [0.0] * 3
    sensors[0][1].register_extrinsics_to(sensors[-1][1], same)
    device.create_matcher(rs.matchers.dlr_c)
    recorder = rs.recorder(str(file), device)
    queue = rs.frame_queue(2 * len(shots) + 2)
    recorded = recorder.query_sensors()
    for sensor in recorded:
        sensor.open(sensor.get_stream_profiles()[0])
        sensor.start(queue)
    for number, shot in enumerate(shots):
        steps = np.rint(np.nan_to_num(shot.depth) / SCALE).astype(np.uint16)
        colour = shot.colour if colours == "bgr8" else np.ascontiguousarray(shot.colour[:, :, ::-1])
        for (sensor, profile, size), pixels in zip(sensors, [steps, colour][0 if depth_too else 1:], strict=True):
            frame = rs.software_video_frame()
            frame.pixels, frame.stride, frame.bpp, frame.profile = pixels, WIDTH * size, size, profile
            frame.timestamp, frame.domain = PERIOD * number, rs.timestamp_domain.global_time
            frame.frame_number = number
            sensor.on_video_frame(frame)
    for _ in range(len(sensors) * len(shots)):
        queue.wait_for_frame(5000)  # then the recorder has it, too
    for sensor in recorded:
        sensor.stop()
        sensor.close()


@asynccontextmanager
async def played(net: LocalNetwork, **options: Any) -> AsyncIterator[None]:
    """Run the camera service with options of the driver."""
    given = {"driver": "realsense", "options": options, "rate": 90.0, "world": WORLD}
    config = check(real_depth_camera.Config, given, "services.real_depth_camera")
    async with running_service(net, real_depth_camera.run, config, name="camera"), asyncio.timeout(30):
        yield


@pytest.mark.parametrize("colours", ["rgb8", "bgr8"])
async def test_recording_is_played_as_it_was_rendered_in_a_loop_with_current_stamps(
    tmp_path: Path, colours: str
) -> None:
    shots = [rendered(number) for number in range(3)]
    record(tmp_path / "table.db3", shots, colours)
    net = LocalNetwork()
    bus, before = net.bus(), time.time_ns()
    infos, images = bus.reader(topics.DEPTH_CAMERA_INFO), bus.reader(topics.DEPTH_CAMERA_IMAGE)
    depths = bus.reader(topics.DEPTH_CAMERA_DEPTH)
    async with played(net, file=str(tmp_path / "table.db3")):
        info = await infos.next()
        for _ in range(3 * len(shots)):  # longer than the recording
            image, depth = await images.next(), depth_of(await depths.next())
            assert image.header.stamp > before
            np.testing.assert_array_equal(image_to_array(image), shots[0].colour)
            # The alignment of depth to color assigns each measurement to all pixels that it touches: edges differ.
            assert np.isnan(depth[HOLE][2:-2, 2:-2]).all()
            same = max((np.abs(depth - shot.depth) <= SCALE / 2 + 1e-6).sum() for shot in shots)
            assert same > 0.97 * np.isfinite(shots[0].depth).sum()
    assert (info.k[0], info.k[4], info.k[2], info.k[5]) == (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)


@pytest.mark.parametrize(("options", "error"), [
    ({"file": "/nowhere/table.db3"}, "options.file: '/nowhere/table.db3' is no file"),
    ({"file": __file__, "serial": "0123"}, "options.serial: '0123' selects a camera, but options.file "),
])
async def test_invalid_recording_option_ends_the_start_with_one_line(options: dict[str, str], error: str) -> None:
    with pytest.raises(ConfigError) as rejected:
        async with played(LocalNetwork(), **options):
            await asyncio.sleep(10)
    assert error in str(rejected.value) and "\n" not in str(rejected.value)


@pytest.mark.parametrize("content", ["text", "without depth"])
async def test_file_that_is_no_recording_or_lacks_depth_is_logged_and_retried(tmp_path: Path, content: str) -> None:
    file = tmp_path / "table.db3"
    if content == "text":
        file.write_text("colours and depth", encoding="utf-8")
    else:
        record(file, [rendered(0)], depth_too=False)
    net = LocalNetwork()
    log = net.bus().reader(topics.LOG)
    async with played(net, file=str(file)):
        line = (await log.next()).message
    assert line.startswith(f"camera realsense: {file}: ") and "opening it again in" in line and "\n" not in line
