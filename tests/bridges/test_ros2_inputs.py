"""A camera and joint states of ROS 2 as inputs of a cell."""

import asyncio
import logging
from contextlib import AsyncExitStack
from itertools import count
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from common import topics
from common.config import Surroundings, load_robot
from common.errors import ConfigError
from common.perception.image import image_to_array
from common.supervision.wiring import wiring
from common.time_source import wall_ns
from services import ros2_camera, ros2_joints
from tests.harness import PATIENCE
from tests.services.fake_cell import FakeCell

pytest.importorskip("rosbags", reason="the extra `ros2` is not installed")
pytest.importorskip("xxhash", reason="the extra `ros2` is not installed")

from bridges.ros2 import convert, inputs, types  # noqa: E402
from bridges.ros2.camera import Camera, Unusable  # noqa: E402
from tests.bridges.ros_client import Ros  # noqa: E402

DOMAIN = 9
FRAME = "camera_optical_frame"
RGB = np.arange(16 * 16 * 3, dtype=np.uint8).reshape(16, 16, 3)
PANDA = load_robot("panda")
STAMP = 1_700_000_000_123_456_789


def header(stamp: int = STAMP) -> Any:
    return types.make("std_msgs/msg/Header", stamp=convert.time_of(stamp), frame_id="elsewhere")


def image(pixels: Any = RGB, encoding: str = "rgb8", stamp: int = STAMP, **fields: Any) -> Any:
    height, width = pixels.shape[:2]
    return types.make("sensor_msgs/msg/Image", **{
        "header": header(stamp), "height": height, "width": width, "encoding": encoding,
        "step": pixels[0].nbytes, "data": np.frombuffer(pixels.tobytes(), np.uint8), **fields})


def calibration(**fields: Any) -> Any:
    k = np.array([20.0, 0, 8, 0, 20, 8, 0, 0, 1])
    p = np.array([18.0, 0, 7, 0, 0, 19, 9, 0, 0, 0, 1, 0])
    return types.make("sensor_msgs/msg/CameraInfo", **{
        "header": header(), "height": 16, "width": 16, "k": k, "p": p, "distortion_model": "plumb_bob",
        "d": np.zeros(5), **fields})


def joints(**fields: Any) -> Any:
    return types.make("sensor_msgs/msg/JointState", **{
        "header": header(), "name": ["finger", *PANDA.joints], "position": np.arange(8.0), "velocity": np.ones(8),
        "effort": np.full(8, np.nan), **fields})


# --- conversion -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("encoding", "pixels", "bgr"), [
    ("rgb8", RGB, RGB[:, :, ::-1]), ("bgr8", RGB, RGB), ("mono8", RGB[:, :, 0], RGB[:, :, [0, 0, 0]]),
])
def test_images_become_bgr8_with_their_stamp(encoding: str, pixels: Any, bgr: Any) -> None:
    camera = Camera(FRAME, rectified=False)
    info = camera.calibrate(calibration())
    assert info is not None and (info.k[0], info.header.frame_id) == (20.0, FRAME)
    converted = camera.convert(image(np.ascontiguousarray(pixels), encoding), "/x")
    assert (converted.header.stamp, converted.header.frame_id, converted.encoding) == (STAMP, FRAME, "bgr8")
    assert np.array_equal(image_to_array(converted), bgr)
    assert camera.calibrate(calibration()) is None  # no news


def test_distortion_is_removed_and_rectified_images_have_the_intrinsics_of_p() -> None:
    d = np.array([-0.3, 0.1, 0, 0, 0])
    camera, rectified = Camera(FRAME, rectified=False), Camera(FRAME, rectified=True)
    infos = [each.calibrate(calibration(d=d)) for each in (camera, rectified)]
    assert [(each.k[0], each.k[2], any(each.d)) for each in infos if each] == [(20.0, 8.0, False), (18.0, 7.0, False)]
    shown = [image_to_array(each.convert(image(encoding="bgr8"), "/x")) for each in (camera, rectified)]
    assert not np.array_equal(shown[0], RGB) and np.array_equal(shown[1], RGB)


@pytest.mark.parametrize(("given", "text"), [
    (image(encoding="yuv422"), "encoding 'yuv422' is not supported; choices: bgr8, rgb8, mono8"),
    (image(stamp=0), "images have no stamp"),
    (image(np.zeros((8, 8, 3), np.uint8)), "8x8"),
    (image(step=10), "step 10 is shorter"),
    (image(data=np.zeros(5, np.uint8)), "5 bytes are too few"),
    (image(height=0), "image.height"),
])
def test_image_that_cannot_be_used_is_left_out_with_a_line(given: Any, text: str) -> None:
    camera = Camera(FRAME, rectified=False)
    camera.calibrate(calibration())
    with pytest.raises(Unusable, match=text) as left_out:
        camera.convert(given, "/x")
    assert "\n" not in str(left_out.value)


@pytest.mark.parametrize(("info", "text"), [
    (calibration(k=np.zeros(9)), "has no calibration"),
    (calibration(d=np.ones(4), distortion_model="equidistant"), "'equidistant' is not supported; choices: plumb_bob"),
    (calibration(width=0), "camera_info.width"),
])
def test_calibration_that_cannot_be_used_is_left_out_with_a_line(info: Any, text: str) -> None:
    camera = Camera(FRAME, rectified=False)
    with pytest.raises(Unusable, match=text):
        camera.calibrate(info)
    with pytest.raises(Unusable, match="no camera_info received yet"):
        camera.convert(image(), "/x")


@pytest.mark.parametrize(("fields", "text"), [
    ({"name": ["a"], "position": np.zeros(1), "velocity": np.zeros(0)}, "no panda_joint1, .* among a: the robot file"),
    ({"header": header(0)}, "no stamp"),
    ({"position": np.full(8, np.nan)}, "position"),
    ({"position": np.zeros(3)}, "position has 3 entries for 8 joints"),
])
def test_joint_states_that_cannot_be_used_are_left_out_with_a_line(fields: Any, text: str) -> None:
    with pytest.raises((ValueError, ConfigError), match=text) as left_out:
        ros2_joints.converted(joints(**fields), PANDA.joints)
    assert "\n" not in str(left_out.value)


# --- services ---------------------------------------------------------------------------------------------------------


async def next_of(reader: Any, publish: Any) -> Any:
    """Publish until a message arrives, and return it."""
    async with asyncio.timeout(PATIENCE):
        while True:
            publish()
            try:
                async with asyncio.timeout(0.1):
                    return await reader.next()
            except TimeoutError:
                continue


async def test_camera_of_ros_is_the_camera_of_a_cell(
    stack: AsyncExitStack, endpoint: str, caplog: pytest.LogCaptureFixture
) -> None:
    cell, ros = FakeCell(), Ros(endpoint, DOMAIN)
    stack.callback(ros.session.close)
    images, infos = cell.reader(topics.CAMERA_IMAGE), cell.reader(topics.CAMERA_INFO)
    config = ros2_camera.Config(world=Surroundings(), topic="/cam/image_raw", domain=DOMAIN, endpoint=endpoint)
    await stack.enter_async_context(cell.running(ros2_camera, config))
    token = await ros.tokens("/MS/%/%test/ros2_camera/%cam%image_raw/sensor_msgs::msg::dds_::Image_/")
    assert token.endswith("/2::,5:,:,:,,")

    def publish(encoding: str = "rgb8", age: int = 0) -> None:
        ros.publish("/cam/camera_info", "sensor_msgs/msg/CameraInfo", calibration())
        ros.publish("/cam/image_raw", "sensor_msgs/msg/Image", image(encoding=encoding, stamp=wall_ns() - age))

    before = wall_ns()
    shown = await next_of(images, publish)
    assert before <= shown.header.stamp <= wall_ns() and np.array_equal(image_to_array(shown), RGB[:, :, ::-1])
    assert infos.latest is not None and infos.latest.k[0] == 20.0
    for number in count():
        if number >= 5 and "bayer_rggb8" in caplog.text:
            break
        publish("bayer_rggb8")
        await asyncio.sleep(0.05)
    while "messages are used" not in caplog.text:
        await next_of(images, publish)
    while "stamps are 1000" not in caplog.text:  # the delay of a busy machine is added
        await next_of(images, publish)
        await next_of(images, lambda: publish(age=100_000_000_000_000))
    warnings = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
    assert len([line for line in warnings if "encoding 'bayer_rggb8' is not supported" in line]) == 1
    assert [line for line in warnings if "stamps are 1000" in line and "behind cell time" in line]


async def test_joint_states_of_ros_are_those_of_a_cell(stack: AsyncExitStack, endpoint: str) -> None:
    cell, ros = FakeCell(), Ros(endpoint, DOMAIN)
    stack.callback(ros.session.close)
    states = cell.reader(topics.JOINT_STATES)
    config = ros2_joints.Config(robot=PANDA, domain=DOMAIN, endpoint=endpoint)
    await stack.enter_async_context(cell.running(ros2_joints, config))
    state = await next_of(states, lambda: ros.publish("/joint_states", "sensor_msgs/msg/JointState", joints()))
    assert (state.header.stamp, state.name[1:], state.position[1]) == (STAMP, PANDA.joints, 1.0)
    assert (len(state.velocity), state.effort) == (8, [])  # NaN is no effort


@pytest.mark.parametrize(("module", "fields", "text"), [
    (ros2_camera, {}, "services.recorded.topic: '' must name a topic of ROS, such as /camera/image_raw"),
    (ros2_joints, {"topic": "joint_states"}, "services.recorded.topic: 'joint_states' must name a topic"),
    (ros2_joints, {"endpoint": "ros:1"}, "must be an endpoint such as tcp/"),
])
async def test_bad_configuration_is_one_line(module: ModuleType, fields: dict[str, Any], text: str) -> None:
    base = {"world": Surroundings()} if module is ros2_camera else {"robot": PANDA}
    with pytest.raises(ConfigError, match=text):
        await wiring(module.run, module.Config(**base, **fields))


async def test_secured_cell_needs_a_router_of_the_nodes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(inputs, "secure_folder", lambda: tmp_path)
    bus, endpoint = FakeCell().bus, "tcp/192.168.1.5:7447"
    assert inputs.usable_endpoint(bus, ros2_joints.Config(robot=PANDA, endpoint=endpoint), "/joint_states") == endpoint
    with pytest.raises(ConfigError, match=r"services\.tester\.endpoint: '' needs an open cell"):
        inputs.usable_endpoint(bus, ros2_joints.Config(robot=PANDA), "/joint_states")


async def test_missing_package_is_one_line_with_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"needs the extra `ros2`"):
        await wiring(ros2_joints.run, ros2_joints.Config(robot=PANDA))
