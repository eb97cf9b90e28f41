"""A cell as a client of Foxglove's protocol sees it."""

import asyncio
import base64
import json
import socket
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from jsonschema import Draft202012Validator
from pydantic import Field

from cli.main import app
from common import messages as m
from common import topics
from common.config import Members, Parameters, Run, Tunable, load_cell, load_robot
from common.errors import ConfigError, Refused
from common.perception.image import array_to_image
from common.process.in_process import running_service
from common.supervision.wiring import wire_service
from common.transport.bus import Bus
from common.transport.local import LocalNetwork
from services import foxglove_bridge
from tests.bridges.client import FoxgloveClient, connected
from tests.cli.conftest import make_folder
from tests.domains import free_port
from tests.harness import Zencell, free_domain

pytest.importorskip("foxglove", reason="the extra `foxglove` is not installed")

from bridges.foxglove.controls import to_parameter  # noqa: E402
from bridges.foxglove.server import may_command  # noqa: E402

STAMP = 1_700_000_000_123_456_789
HEADER = m.Header(stamp=STAMP, frame_id="world")
SOLID = m.CollisionObject(id="box", role="fixture", shape="box", dimensions=[1, 2, 3], pose=m.Pose())
PIXELS = np.full((6, 8, 3), (255, 0, 0), np.uint8)  # blue


class ArmConfig(Parameters):
    speed: Tunable[float] = Field(0.5, gt=0, le=1)
    weights: Tunable[list[float]] = Field([1.0, 2.0])
    file: str = "lens.yaml"


class Arm:
    """A service that writes a stream, a state, events and images, and obeys the task commands."""

    def __init__(self) -> None:
        self.commands: list[m.TaskCommand] = []
        self.config = ArmConfig()
        self.joints: Any = None
        self.scene: Any = None
        self.picture: Any = None
        self.updates: Any = None

    async def run(self, bus: Bus, config: ArmConfig) -> None:
        self.joints, self.scene = bus.writer(topics.JOINT_STATES), bus.writer(topics.PLANNING_SCENE)
        self.picture, self.updates = bus.writer(topics.CAMERA_IMAGE), bus.writer(topics.SCENE_OBJECT_UPDATES)
        bus.serve(topics.TASK_COMMAND, self._obey)
        bus.serve(topics.MOTION_STOP, self._stop)
        await bus.ready()
        self.scene.put(m.PlanningScene(header=HEADER, objects=[SOLID]))
        await asyncio.Event().wait()

    async def _obey(self, command: m.TaskCommand) -> m.TaskStatus:
        self.commands.append(command)
        if command.command == "resume" and not command.override:
            raise Refused("held", "the robot is held by anna")
        return m.TaskStatus(state="IDLE", paused=command.command == "pause")

    async def _stop(self, request: m.StopRequest) -> m.MotionStatus:
        return m.MotionStatus()

    async def publish(self, count: int) -> None:
        for number in range(count):
            self.joints.put(m.JointState(header=HEADER, name=["a"], position=[float(number)]))
            self.picture.put(array_to_image(PIXELS, "bgr8", HEADER))
            await asyncio.sleep(0.01)


class Rig:
    def __init__(self, **options: Any) -> None:
        self.net, self.arm, self.port = LocalNetwork(), Arm(), free_port()
        members = Members(services=["arm", "foxglove_bridge"])
        self.config = foxglove_bridge.Config(
            robot=load_robot("panda"), run=Run(cell="cell"), members=members, port=self.port, rate=1000.0, **options)
        self.probe = self.net.bus("probe")
        self.joints_read = self.probe.raw_publisher(f"{self.probe.cell}/joint_states", "", reliable=False)

    async def enter(self, stack: AsyncExitStack) -> "Rig":
        await stack.enter_async_context(running_service(self.net, self.arm.run, self.arm.config, name="arm"))
        await stack.enter_async_context(
            running_service(self.net, foxglove_bridge.run, self.config, name="foxglove_bridge"))
        return self

    def keep_publishing(self, stack: AsyncExitStack) -> None:
        task = asyncio.create_task(self.arm.publish(1_000_000))
        stack.callback(task.cancel)


@pytest.fixture
async def stack() -> AsyncIterator[AsyncExitStack]:
    async with AsyncExitStack() as stack:
        yield stack


@pytest.fixture
async def rig(stack: AsyncExitStack) -> Rig:
    return await Rig().enter(stack)


@pytest.fixture
async def client(stack: AsyncExitStack, rig: Rig) -> FoxgloveClient:
    rig.keep_publishing(stack)
    return await stack.enter_async_context(connected(rig.port))


async def test_topics_with_a_writer_are_channels_with_their_schemas(client: FoxgloveClient) -> None:
    for topic, schema in {
        "test/joint_states": "foxglove.JointStates", "test/planning_scene": "foxglove.SceneUpdate",
        "test/camera/image_raw": "foxglove.CompressedImage", "test/scene_object_updates": "SceneUpdate",
        "test/log": "foxglove.Log", "test/supervisor/status": "SupervisorStatus",
    }.items():
        channel = await client.channel(topic)
        assert (channel["encoding"], channel["schemaEncoding"]) == ("json", "jsonschema")
        assert channel["schemaName"] == schema
    assert "test/depth_camera/points" not in client.channels, "no service writes it"
    assert client.info["name"] == "zencell test"


async def test_message_has_its_stamp_and_holds_the_advertised_schema(client: FoxgloveClient) -> None:
    await client.subscribe("test/joint_states")
    first, second = await client.data("test/joint_states"), await client.data("test/joint_states")
    assert first["log_time"] == STAMP
    assert first["data"]["timestamp"] == {"sec": 1_700_000_000, "nsec": 123_456_789}
    assert second["data"]["joints"][0]["position"] > first["data"]["joints"][0]["position"]
    Draft202012Validator(json.loads(client.channels["test/joint_states"]["schema"])).validate(first["data"])


async def test_image_arrives_as_jpeg_with_its_colors(client: FoxgloveClient) -> None:
    await client.subscribe("test/camera/image_raw")
    image = (await client.data("test/camera/image_raw"))["data"]
    assert image["format"] == "jpeg"
    pixels = cv2.imdecode(np.frombuffer(base64.b64decode(image["data"]), np.uint8), cv2.IMREAD_COLOR)
    assert pixels is not None and pixels.shape == PIXELS.shape
    assert np.abs(pixels.astype(int) - PIXELS).max() < 12


async def test_each_client_gets_the_current_value_of_a_state(rig: Rig, client: FoxgloveClient) -> None:
    await client.subscribe("test/planning_scene")
    assert (await client.data("test/planning_scene"))["data"]["entities"][0]["id"] == "box"
    async with connected(rig.port) as later:
        await later.subscribe("test/planning_scene")
        assert (await later.data("test/planning_scene"))["data"]["entities"][0]["id"] == "box"


@pytest.mark.slow
async def test_arm_is_drawn_in_the_frames_of_its_links(client: FoxgloveClient) -> None:
    await client.subscribe("test/robot/meshes")
    scene = (await client.data("test/robot/meshes"))["data"]
    Draft202012Validator(json.loads(client.channels["test/robot/meshes"]["schema"])).validate(scene)
    entities = scene["entities"]
    frames = {each["frame_id"] for each in entities}
    assert {f"panda_link{number}" for number in range(8)} | {"panda_hand", "panda_leftfinger"} <= frames
    for (mesh,) in (each["triangles"] for each in entities):
        assert len(mesh["indices"]) % 3 == 0 and max(mesh["indices"]) < len(mesh["points"])
    highest = max(point["z"] for each in entities if each["frame_id"] == "panda_link0"
                  for point in each["triangles"][0]["points"])
    assert highest == pytest.approx(0.14, abs=0.02), "the base of a Panda [m]"


async def test_every_event_arrives_in_order(rig: Rig, client: FoxgloveClient) -> None:
    await client.subscribe("test/scene_object_updates")
    await client.subscribe("test/joint_states")
    await client.data("test/joint_states")  # subscribed
    for number in range(50):
        rig.arm.updates.put(m.SceneUpdate(data=f"add:{number}"))
    arrived = [(await client.data("test/scene_object_updates"))["data"]["data"] for _ in range(50)]
    assert arrived == [f"add:{number}" for number in range(50)]


async def test_topic_is_read_only_while_a_client_is_subscribed(rig: Rig, client: FoxgloveClient) -> None:
    async def until(matched: bool) -> None:
        async with asyncio.timeout(20):
            while rig.joints_read.matched is not matched:  # noqa: ASYNC110 - there is no event for it
                await asyncio.sleep(0.005)

    await client.channel("test/joint_states")
    assert not rig.joints_read.matched
    await client.subscribe("test/joint_states")
    await until(True)
    await client.unsubscribe("test/joint_states")
    await until(False)
    await client.subscribe("test/joint_states")
    await until(True)


@pytest.mark.parametrize(("service", "request_", "sent"), [
    ("task/start", {"override": True}, ("start", True)),
    ("task/pause", {}, ("pause", False)),
    ("task/stop", {}, ("stop", False)),
    ("task/resume", {"override": True}, ("resume", True)),
])
async def test_task_commands_are_services(
    service: str, request_: dict[str, Any], sent: tuple[str, bool], rig: Rig, client: FoxgloveClient
) -> None:
    answer = await client.call(service, request_)
    assert answer["op"] == "serviceCallResponse", answer
    assert answer["data"]["paused"] is (service == "task/pause")
    (command,) = rig.arm.commands
    assert ((command.command, command.override), command.by) == (sent, "foxglove")


@pytest.mark.parametrize(("service", "request_", "why"), [
    ("task/resume", {}, "held by anna"),
    ("task/pause", {"override": True}, "must be an object without fields"),
    ("task/start", {"override": "yes"}, "true or false"),
    ("task/start", [], "must be an object"),
])
async def test_refusal_reaches_the_client(
    service: str, request_: Any, why: str, rig: Rig, client: FoxgloveClient
) -> None:
    answer = await client.call(service, request_)
    assert answer["op"] == "serviceCallFailure"
    assert why in answer["message"]
    assert len(rig.arm.commands) == (why == "held by anna")


async def test_parameters_are_read_and_set(rig: Rig, client: FoxgloveClient) -> None:
    values = await client.parameters()
    assert values["services.arm.speed"] == 0.5 and values["services.arm.weights"] == [1.0, 2.0]
    assert await client.parameters("services.arm.file") == {"services.arm.file": "lens.yaml"}
    assert await client.parameters(services__arm__speed=0.25) == {"services.arm.speed": 0.25}
    assert rig.arm.config.speed == 0.25
    assert await client.parameters(services__arm__weights=[3, 4.5]) == {"services.arm.weights": [3.0, 4.5]}


async def test_refused_parameter_keeps_its_value_and_the_client_gets_why(rig: Rig, client: FoxgloveClient) -> None:
    assert await client.parameters(services__arm__speed=7.0) == {"services.arm.speed": 0.5}
    assert rig.arm.config.speed == 0.5
    assert any("services.arm.speed" in status and "7" in status for status in client.statuses)
    assert await client.parameters(services__arm__sped=0.3) == {}
    assert any("did you mean 'services.arm.speed'" in status for status in client.statuses)


async def test_without_commands_there_are_topics_only(stack: AsyncExitStack) -> None:
    rig = await Rig(commands=False).enter(stack)
    client = await stack.enter_async_context(connected(rig.port))
    await client.channel("test/joint_states")
    assert client.info["capabilities"] == [] and client.services == {}


@pytest.mark.parametrize(("host", "offered", "expected"), [
    ("127.0.0.1", True, True), ("::1", True, True), ("localhost", True, True),
    ("127.0.0.1", False, False), ("0.0.0.0", True, False), ("robot.lan", True, False),
])
def test_only_clients_of_this_host_command_the_cell(host: str, offered: bool, expected: bool) -> None:
    assert may_command(host, offered) is expected


def test_value_without_a_type_of_foxglove_is_json_text() -> None:
    assert to_parameter("a", {"x": [1, None]}).get_value() == '{"x": [1, null]}'
    assert to_parameter("a", {"x": [1, 2.5]}).get_value() == {"x": [1, 2.5]}


def test_bridge_declares_its_topics_and_requests() -> None:
    cell = load_cell("panda", ["services.foxglove_bridge={port: 8799}"])
    wired = wire_service(cell, cell.services["foxglove_bridge"])
    assert {"joint_states", "pick_place_status", "camera/image_raw"} <= set(wired.reads)
    assert {"task/command", "motion/stop"} <= set(wired.calls)
    assert wired.writes == []


@pytest.mark.slow
async def test_killed_bridge_returns_and_no_other_service_notices(tmp_path: Path) -> None:
    port, folder = free_port(), make_folder(tmp_path)
    command = Zencell(folder, free_domain(), "up", "tiny.yaml", "--foxglove", str(port))
    try:
        await asyncio.to_thread(command.until, "zenoh --mode client")
        before = {name: process.pid for name, process in command.children().items()}
        async with connected(port) as client:
            assert client.info["name"] == "zencell tiny"
        command.children()["foxglove_bridge"].kill()
        await asyncio.to_thread(command.until, "foxglove_bridge is ready again")
        async with connected(port) as client:
            await client.channel("tiny/log")
        after = {name: process.pid for name, process in command.children().items()}
        assert {name for name in before if after[name] != before[name]} == {"foxglove_bridge"}
    finally:
        command.interrupt()
        assert command.end() == 0
    assert not command.children()


# --- the option -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("arguments", "expected"), [
    (("--foxglove", "abc"), "--foxglove: 'abc' must be a whole number from 1 to 65535"),
    (("--foxglove", "70000"), "--foxglove: '70000' must be a whole number from 1 to 65535"),
])
def test_bad_port_is_one_line(
    arguments: tuple[str, ...], expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert app.execute(["up", "panda", "--no-viewer", *arguments]) == 2
    assert capsys.readouterr().err.strip() == f"zencell: {expected}"


def test_secured_cell_is_refused(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("bridges.foxglove.option.secure_folder", lambda: tmp_path)
    assert app.execute(["up", "panda", "--no-viewer", "--foxglove"]) == 2
    assert "--foxglove: '8765' needs an open cell" in capsys.readouterr().err
    cell = load_cell("panda", ["services.foxglove_bridge={port: 8799}"])
    with pytest.raises(ConfigError, match="foxglove_bridge: needs an open cell"):
        wire_service(cell, cell.services["foxglove_bridge"])


def test_port_in_use_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert app.execute(["up", "panda", "--no-viewer", "--foxglove", str(port)]) == 2
    assert f"--foxglove: {port} is in use by" in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [("--foxglove",), ("--foxglove", "--no-viewer"), ("--foxglove", "8765")])
def test_missing_package_is_one_line_with_the_extra(
    arguments: tuple[str, ...], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert app.execute(["up", "panda", *arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line == "zencell: --foxglove: '8765' needs the extra `foxglove`: pip install 'zencell[foxglove]'"


def test_unknown_service_is_still_refused_unless_a_complete_entry_adds_it(capsys: pytest.CaptureFixture[str]) -> None:
    for text in ("services.foxglove_bridge.port=8799", "services.foxglove_brige={}"):
        assert app.execute(["up", "panda", "--set", text]) == 2
        assert "unknown service 'foxglove_bri" in capsys.readouterr().err
