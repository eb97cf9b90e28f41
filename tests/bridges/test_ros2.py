"""A cell as ROS 2 nodes with rmw_zenoh see it: plain Zenoh sessions, and messages of rosbags, take their place."""

import asyncio
import struct
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cli.main import app
from common import messages as m
from common import topics
from common.config import Members, Parameters, Run, load_robot
from common.errors import Refused
from common.perception.image import array_to_image
from common.process.in_process import running_service
from common.transport.bus import Bus
from common.transport.local import LocalNetwork

pytest.importorskip("rosbags", reason="the extra `ros2` is not installed")
pytest.importorskip("xxhash", reason="the extra `ros2` is not installed")

from rosbags.typesys import Stores, get_typestore  # noqa: E402
from zenoh import ext  # noqa: E402

from bridges.ros2 import convert, keys, types  # noqa: E402
from bridges.ros2.server import description_of, serve  # noqa: E402
from services import ros2_bridge  # noqa: E402
from tests.bridges.ros_client import Ros  # noqa: E402

STAMP = 1_700_000_000_123_456_789
HEADER = m.Header(stamp=STAMP, frame_id="world")
SOLID = m.CollisionObject(id="box", role="fixture", shape="box", dimensions=[1, 2, 3], pose=m.Pose())
PIXELS = np.full((6, 8, 3), (255, 0, 0), np.uint8)
CALIBRATION = m.CameraInfo(header=HEADER, height=6, width=8, k=[5, 0, 4, 0, 5, 3, 0, 0, 1])
DOMAIN = 7


# --- formats ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "published"), [  # as other projects on GitHub quote them from ROS 2
    ("std_msgs/msg/String", "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"),
    ("std_srvs/srv/Trigger", "RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f"),
])
def test_hashes_are_the_published_ones(name: str, published: str) -> None:
    assert types.type_hash(name) == published


@pytest.mark.parametrize("distribution", [Stores.ROS2_JAZZY, Stores.ROS2_KILTED])
def test_hashes_of_topics_are_equal_in_both_distributions(distribution: Stores) -> None:
    store = get_typestore(distribution)
    for _, name, _ in convert.CONVERSIONS:
        assert types.type_hash(name) == store.hash_rihs01(name)


def test_token_and_key_have_the_parts_of_rmw_zenoh() -> None:
    node = keys.Node(3, "abc", "/panda", "zencell")
    assert node.token() == "@ros2_lv/3/abc/0/0/NN/%/%panda/zencell"
    token = node.entity_token(4, "MP", "/panda/joint_states", types.dds_name("sensor_msgs/msg/JointState"), "RIHS01_x",
                              keys.LATCHED)
    assert token == ("@ros2_lv/3/abc/0/4/MP/%/%panda/zencell/%panda%joint_states/sensor_msgs::msg::dds_::JointState_/"
                     "RIHS01_x/:1:,1:,:,:,,")
    assert keys.data_key(3, "/panda/joint_states", "T_", "H") == "3/panda/joint_states/T_/H"


@pytest.mark.parametrize(("qos", "text"), [
    (keys.Qos(depth=10), "::,10:,:,:,,"), (keys.Qos(depth=42), "::,:,:,:,,"),
    (keys.Qos(depth=5, reliability=keys.BEST_EFFORT), "2::,5:,:,:,,"),
])
def test_profile_leaves_out_defaults(qos: keys.Qos, text: str) -> None:
    assert qos.text == text


def test_attachment_is_what_zenoh_serializes() -> None:
    gid = bytes(range(16))
    data = keys.Attachment(5, STAMP, gid).encoded()
    assert data == ext.z_serialize((ext.Int64(5), ext.Int64(STAMP))).to_bytes() + ext.z_serialize(gid).to_bytes()
    assert keys.Attachment.decoded(data) == keys.Attachment(5, STAMP, gid)
    for wrong in (b"", data[:-1], data + b"x"):
        with pytest.raises(ValueError, match="attachment has"):
            keys.Attachment.decoded(wrong)


def test_joint_states_are_the_bytes_of_cdr() -> None:
    message = m.JointState(header=m.Header(stamp=2_000_000_003, frame_id="w"), name=["a"], position=[1.5])
    expected = b"\x00\x01\x00\x00" + struct.pack("<iI", 2, 3) + struct.pack("<I", 2) + b"w\0" + b"\0\0"
    expected += struct.pack("<II", 1, 2) + b"a\0" + b"\0\0" + struct.pack("<I", 1)
    expected += b"\0" * (-(len(expected) - 4) % 8) + struct.pack("<dII", 1.5, 0, 0)
    assert types.encode(convert.joints(message)) == expected


@pytest.mark.parametrize(("text", "name"), [
    ("my-cell", "my_cell"), ("2nd", "_2nd"), ("camera/image_raw", "camera/image_raw"), ("a//b.c", "a/b_c"),
])
def test_names_become_valid_in_ros(text: str, name: str) -> None:
    assert keys.ros_name(text) == name


def test_description_is_one_urdf_with_urls_of_meshes() -> None:
    urdf = description_of(load_robot("panda"))
    assert urdf.startswith("<robot") and 'name="world"' in urdf
    assert 'filename="/' not in urdf


# --- a cell on a router -----------------------------------------------------------------------------------------------


class Arm:
    """A service that writes a stream, states and images, and obeys the task commands."""

    def __init__(self) -> None:
        self.commands: list[m.TaskCommand] = []
        self.writers: dict[str, Any] = {}

    async def run(self, bus: Bus, config: Parameters) -> None:
        for topic in (topics.JOINT_STATES, topics.CAMERA_IMAGE, topics.CAMERA_INFO, topics.PLANNING_SCENE,
                      topics.TF_STATIC):
            self.writers[topic.key] = bus.writer(topic)
        bus.serve(topics.TASK_COMMAND, self._obey)
        bus.serve(topics.MOTION_STOP, self._stop)
        await bus.ready()
        self.writers["planning_scene"].put(m.PlanningScene(header=HEADER, objects=[SOLID]))
        self.writers["camera/camera_info"].put(CALIBRATION)
        pose = m.TransformStamped(header=HEADER, child_frame_id="base", transform=m.Pose())
        self.writers["tf_static"].put(m.TFMessage(transforms=[pose]))
        for number in range(1_000_000):
            self.writers["joint_states"].put(m.JointState(header=HEADER, name=["a"], position=[float(number)]))
            self.writers["camera/image_raw"].put(array_to_image(PIXELS, "bgr8", HEADER))
            await asyncio.sleep(0.01)

    async def _obey(self, command: m.TaskCommand) -> m.TaskStatus:
        self.commands.append(command)
        if command.command == "resume":
            raise Refused("held", "the robot is held by anna")
        return m.TaskStatus(state="IDLE", paused=command.command == "pause")

    async def _stop(self, request: m.StopRequest) -> m.MotionStatus:
        return m.MotionStatus()


@pytest.fixture
async def arm(stack: AsyncExitStack, endpoint: str) -> Arm:
    net, arm = LocalNetwork(), Arm()
    config = ros2_bridge.Config(robot=load_robot("panda"), run=Run(cell="cell"), domain=DOMAIN,
                                members=Members(services=["arm", "ros2_bridge"]), rate=1000.0)

    async def bridge(bus: Bus, config: ros2_bridge.Config) -> None:
        from common.application import find_application

        await serve(bus, config, find_application(""), endpoint)

    await stack.enter_async_context(running_service(net, arm.run, Parameters(), name="arm"))
    await stack.enter_async_context(running_service(net, bridge, config, name="ros2_bridge"))
    return arm


@pytest.fixture
def ros(stack: AsyncExitStack, arm: Arm, endpoint: str) -> Ros:
    ros = Ros(endpoint, DOMAIN)
    stack.callback(ros.session.close)
    return ros


async def test_topics_reach_a_subscription_of_ros(ros: Ros) -> None:
    message, attachment = await ros.next("/test/joint_states", "sensor_msgs/msg/JointState")
    assert message.name == ["a"] and message.header.frame_id == "world"
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1_700_000_000, 123_456_789)
    token = await ros.tokens("/MP/%/%test/zencell/%test%joint_states/")
    assert attachment.gid == keys.gid_of(token) and attachment.sequence >= 1
    image, _ = await ros.next("/test/camera/image_raw", "sensor_msgs/msg/Image")
    assert (image.width, image.height, image.step, image.encoding) == (8, 6, 24, "bgr8")
    assert bytes(image.data) == PIXELS.tobytes()
    info, _ = await ros.next("/test/camera/camera_info", "sensor_msgs/msg/CameraInfo")
    assert list(info.k) == CALIBRATION.k and list(info.p[:4]) == [5, 0, 4, 0]


async def test_late_subscription_gets_what_is_transient_local(ros: Ros) -> None:
    description, _ = await ros.next("/test/robot_description", "std_msgs/msg/String")
    assert description.data.startswith("<robot")
    static, _ = await ros.next("/tf_static", "tf2_msgs/msg/TFMessage")
    assert static.transforms[0].child_frame_id == "base"
    scene, _ = await ros.next("/test/planning_scene", "visualization_msgs/msg/MarkerArray")
    assert [each.action for each in scene.markers] == [convert.DELETE_ALL, convert.ADD]
    assert scene.markers[1].scale.z == 3
    assert (await ros.tokens("%robot_description/")).endswith("/:1:,1:,:,:,,")


async def test_clock_is_cell_time(ros: Ros) -> None:
    first, _ = await ros.next("/clock", "rosgraph_msgs/msg/Clock")
    second, _ = await ros.next("/clock", "rosgraph_msgs/msg/Clock")
    assert (second.clock.sec, second.clock.nanosec) > (first.clock.sec, first.clock.nanosec) > (STAMP // 10**9, 0)


@pytest.mark.parametrize(("command", "success", "text"), [
    ("start", True, "start: IDLE"), ("pause", True, "pause: IDLE, paused"), ("stop", True, "stop: IDLE"),
    ("resume", False, "the robot is held by anna"),
])
async def test_trigger_commands_the_task(ros: Ros, arm: Arm, command: str, success: bool, text: str) -> None:
    response = await ros.call(f"/test/task/{command}", types.TRIGGER, types.make(f"{types.TRIGGER}_Request"))
    assert response.success is success
    assert text in response.message
    assert [(each.command, each.by, each.override) for each in arm.commands][-1] == (command, "ros2", False)


# --- the option -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("domain", ["abc", "233", "1.5"])
def test_bad_domain_is_one_line(domain: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert app.execute(["up", "panda", "--no-viewer", "--ros2", domain]) == 2
    assert capsys.readouterr().err.strip() == f"zencell: --ros2: '{domain}' must be a whole number from 0 to 232"


@pytest.mark.parametrize("arguments", [("--ros2",), ("--ros2", "--no-viewer"), ("--ros2", "0")])
def test_missing_package_is_one_line_with_the_extra(
    arguments: tuple[str, ...], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert app.execute(["up", "panda", *arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line == "zencell: --ros2: '0' needs the extra `ros2`: pip install 'zencell[ros2]'"


def test_secured_cell_is_refused(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("bridges.ros2.option.secure_folder", lambda: tmp_path)
    assert app.execute(["up", "panda", "--no-viewer", "--ros2"]) == 2
    assert "--ros2: '0' needs an open cell" in capsys.readouterr().err
