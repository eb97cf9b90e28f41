"""Recordings in the format of a camera's maker, of what the project draws, played by the maker's own package."""

import asyncio
import time
from collections.abc import Sequence
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
BETWEEN = 33.0  # [ms] two shots
HOLE = np.s_[100:140, 20:60]  # that was not measured


def drawn(number: int) -> RgbdFrame:
    """What a camera above the objects of a cell sees, of which a part was not measured, from 1 cm further away each."""
    cell = load_cell("ur5", world="w3")
    T = Pinhole.from_config(cell.world.camera).T_world_optical
    objects = load_world(cell.world, cell.world.objects).objects(Header()).objects
    lens = Pinhole(FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT, T)
    view = Renderer(cell.world, camera=lens).render(objects)
    depth = view.depth_within(0.1, 10.0) + np.float32(0.01 * number)
    depth[HOLE] = np.nan
    assert len(np.unique(depth[np.isfinite(depth)])) > 1, "something stands there"
    return RgbdFrame(view.colour, depth)


def record(file: Path, shots: Sequence[RgbdFrame], colours: str = "rgb8", *, depth_too: bool = True) -> None:
    """Write shots as the maker's viewer does of a camera: a device made of software, and its recorder."""
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
            frame.timestamp, frame.domain = BETWEEN * number, rs.timestamp_domain.global_time
            frame.frame_number = number
            sensor.on_video_frame(frame)
    for _ in range(len(sensors) * len(shots)):
        queue.wait_for_frame(5000)  # the recorder has had it, too
    for sensor in recorded:
        sensor.stop()
        sensor.close()


def config_of(**options: Any) -> real_depth_camera.Config:
    world = load_cell("ur5", world="w3").world
    given = {"driver": "realsense", "options": options, "rate": 90.0, "world": world}
    return check(real_depth_camera.Config, given, "services.real_depth_camera")


@pytest.mark.parametrize("colours", ["rgb8", "bgr8"])
async def test_recording_is_played_as_it_was_rendered_in_a_loop(tmp_path: Path, colours: str) -> None:
    shots = [drawn(number) for number in range(3)]
    record(tmp_path / "table.db3", shots, colours)
    net = LocalNetwork()
    bus = net.bus()
    infos, images = bus.reader(topics.DEPTH_CAMERA_INFO), bus.reader(topics.DEPTH_CAMERA_IMAGE)
    depths = bus.reader(topics.DEPTH_CAMERA_DEPTH)
    seen = []
    async with running_service(net, real_depth_camera.run, config_of(file=str(tmp_path / "table.db3")), name="camera"):
        async with asyncio.timeout(30):
            info = await infos.next()
            while len(seen) < 3 * len(shots):  # longer than it is
                image, depth = await images.next(), depth_of(await depths.next())
                np.testing.assert_array_equal(image_to_array(image), shots[0].colour)
                # What fits one picture to the other gives each measurement the pixels that it touches: edges differ.
                assert np.isnan(depth[HOLE][2:-2, 2:-2]).all()
                away = [np.abs(depth - shot.depth) <= SCALE / 2 + 1e-6 for shot in shots]
                seen.append(int(np.argmax([one.sum() for one in away])))
                assert away[seen[-1]].sum() > 0.97 * np.isfinite(shots[0].depth).sum()
    assert (info.k[0], info.k[4], info.k[2], info.k[5]) == (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)


async def test_stamps_of_a_recording_are_current(tmp_path: Path) -> None:
    record(tmp_path / "table.db3", [drawn(0)])
    net = LocalNetwork()
    images = net.bus().reader(topics.DEPTH_CAMERA_IMAGE)
    before = time.time_ns()
    async with running_service(net, real_depth_camera.run, config_of(file=str(tmp_path / "table.db3")), name="camera"):
        async with asyncio.timeout(30):
            assert (await images.next()).header.stamp > before


@pytest.mark.parametrize(("options", "told"), [
    ({"file": "/nowhere/table.db3"}, "options.file: '/nowhere/table.db3' is no file"),
    ({"file": __file__, "serial": "0123"}, "options.serial: '0123' selects a camera, but options.file "),
])
async def test_invalid_recording_option_ends_the_start_with_one_line(options: dict[str, str], told: str) -> None:
    with pytest.raises(ConfigError) as refused:
        async with running_service(LocalNetwork(), real_depth_camera.run, config_of(**options), name="camera"):
            await asyncio.sleep(10)
    assert told in str(refused.value) and "\n" not in str(refused.value)


@pytest.mark.parametrize("made", ["text", "without depth"])
async def test_file_that_is_no_recording_or_lacks_depth_is_logged_and_retried(tmp_path: Path, made: str) -> None:
    file = tmp_path / "table.db3"
    if made == "text":
        file.write_text("colours and depth", encoding="utf-8")
    else:
        record(file, [drawn(0)], depth_too=False)
    net = LocalNetwork()
    log = net.bus().reader(topics.LOG)
    async with running_service(net, real_depth_camera.run, config_of(file=str(file)), name="camera"):
        async with asyncio.timeout(30):
            line = (await log.next()).message
    assert line.startswith(f"camera realsense: {file}: ") and "opening it again in" in line and "\n" not in line
