"""Every topic and parameter that the page reads, with extreme values that its message allows: pages stay connected."""

import asyncio
import json
import math
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import msgspec
import pytest
import viser
import zstandard
from pydantic import ValidationError

from applications.outlining.topics import Contour, Contours, OutlinePoints, OutlineStatus
from applications.pick_place.topics import PickPlaceStatus
from common import messages as m
from common import topics
from common.application import find_application
from common.client.operator_motion import OperatorMotion
from common.config import Io, Members
from common.topics import Topic
from common.transport.codec import decode, encode
from common.transport.local import LocalNetwork
from page.access import Permissions
from page.browser_values import to_json
from page.console import ActionQueue, Console
from page.control_socket import ControlSocket, Loss, PageStatus
from page.feeds import Feeds, Schedule, Topics
from page.layers import find_layers
from page.layout import Layout
from page.page import Page
from page.scene import Scene
from page.server import close_server, make_server
from page.tuning import TuningPanel
from tests.page.fake_browser import CAMERA
from tests.page.scene_cell import WORLD, around_of, at, ball, cell_of, robot_of, rough_of
from tests.page.test_server import open_page

PATIENCE = 60.0  # [s]
NUMBERS = (0, 1, -1, 2**31, 2**53 + 1, 2**63 - 1, -(2**63), 2**64, 0.5, -1.0, 5e-324, 1e7, 1e12, -1e12, 1e300, math.inf,
           math.nan)
TEXTS = ("", 120 * "x", 4000 * "\U0001f916", "</div><script>", "\ud800", 'a"b', "nan", "1e400")
OBJECT = m.WorldObject(id="a", shape="prism", size=m.Vector3(x=1.0, y=1.0, z=1.0), polygon=[(0, 0), (1, 0), (0, 1)],
                       outline=[(0, 0), (1, 0), (0, 1)], height=1.0)
SOLIDS = [ball("a", at(0, 0, 0)), m.CollisionObject(id="b", role="fixture", shape="box", dimensions=[1.0, 1.0, 1.0],
                                                   pose=at(0, 0, 0))]
MARKERS = [m.Marker(ns="a", id=1, type=kind, pose=m.Pose(), scale=m.Vector3(x=1.0, y=1.0, z=1.0), text="a",
                    pixel=(1.0, 1.0)) for kind in ("sphere", "cylinder", "box", "text")]
POINT = {"positions": [0.1], "velocities": [0.1], "accelerations": [0.1]}


def examples(joints: list[str]) -> dict[type[m.Message], m.Message]:
    """A message of each kind that the page reads, with all parts."""
    n = len(joints)
    rejection = m.Rejection(position=m.Vector3(), reason="far")
    task = {"started": True, "stage": "a", "subject": "b", "message": "c", "figures": {"a": 1}, "total": 1,
            "plans": [m.PlanFigure(planner="a", seconds=1.0, fraction=1.0, attempts=1)], "skipped": [rejection]}
    lock = m.Interlock(kind="held", by="anna", reason="a", since=1)
    found: list[m.Message] = [
        m.JointState(header=WORLD, name=joints, position=[0.1] * n, velocity=[0.1] * n, effort=[0.1] * n),
        m.MotionStatus(header=WORLD, state="active", progress=0.5, message="a", interlocks=[lock], fault="b"),
        m.MotionOwner(header=WORLD, owner="anna", kind="operator", since=1, asked=True),
        m.RobotStatus(header=WORLD, mode="fault", message="a", controller=True),
        m.GripperState(header=WORLD, width=0.1, message="a"),
        m.Wrench(header=WORLD, force=m.Vector3(x=1.0), torque=m.Vector3(y=0.1), reason="a"),
        m.SupervisorStatus(header=WORLD, cell="a", notices=[m.Notice(message="a")], services=[
            m.ServiceStatus(name="a", state="ready", pid=1, restarts=1, ready_seconds=1.0, message="a")]),
        m.ServiceCounters(header=WORLD, service="tester", writes=["b"], received={"b": 1}, dropped={"b": 1},
                          invalid={"b": 1}),
        m.LogLine(header=WORLD, service="tester", level="error", message="b"),
        m.PlanningScene(header=WORLD, objects=SOLIDS),
        m.JointTrajectory(header=WORLD, joint_names=joints[:1], points=[
            m.JointTrajectoryPoint(time_from_start=t, **POINT) for t in (0.0, 1.0)]),
        PickPlaceStatus.model_validate(task), OutlineStatus.model_validate(task),
        m.Rejections(header=WORLD, rejected=[rejection]), m.MarkerArray(header=WORLD, markers=MARKERS, remark="a"),
        m.PoseArray(header=WORLD, poses=[at(0.1, 0.1, 0.1)], ids=["a"], labels=["b"], remark="c"),
        m.Image(header=WORLD, height=2, width=2, encoding="bgr8", step=6, data=bytes(12)),
        m.WorldObjects(header=WORLD, objects=[OBJECT]),
        m.PointCloud2(header=WORLD, height=1, width=1, row_step=16, data=bytes(16)),
        m.CameraInfo(header=WORLD, height=2, width=2, d=[0.1], k=[1.0, 0.0, 1.0, 0.0, 1.0, 1.0, 0.0, 0.0, 1.0]),
        m.TFMessage(transforms=[m.TransformStamped(header=WORLD, child_frame_id="camera", transform=m.Pose())]),
        OutlinePoints(header=WORLD, poses=[at(0.1, 0.1, 0.1)] * 3, object="a", message="b"),
        Contours(header=WORLD, width=2, height=2, contours=[
            Contour(index=0, label="a", pixels=[(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)], area=1.0)], message="a"),
    ]
    return {type(each): each for each in found}


def changed(value: Any) -> Iterator[Any]:
    """Yield copies of a plain value, each with an extreme value in one place."""
    if isinstance(value, dict):
        for name, each in value.items():
            yield from ({**value, name: other} for other in changed(each))
    elif isinstance(value, list | tuple):
        for index, each in enumerate(value):
            yield from ([*value[:index], other, *value[index + 1:]] for other in changed(each))
    elif isinstance(value, str):
        yield from TEXTS
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield from NUMBERS


def extremes(example: m.Message) -> list[m.Message]:
    """Return the valid ones of these messages, as a reader decodes them."""
    found = []
    for fields in changed(example.model_dump()):
        try:
            found.append(decode(type(example), encode(type(example).model_validate(fields))))
        except (ValidationError, OverflowError):
            continue
    assert found
    return found


class Browser:
    """Receives viser's messages; `texts` are the contents of HTML elements that were shown."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server

    @asynccontextmanager
    async def opened(self) -> AsyncIterator[Any]:
        async with open_page(self._server) as connection:
            await connection.send(msgspec.msgpack.encode(CAMERA))
            yield connection

    async def receive(self, connection: Any, text: str) -> None:
        """Receive until a text is shown; fails if the connection is closed."""
        async with asyncio.timeout(PATIENCE):
            while True:
                data = await connection.recv()
                size = int.from_bytes(data[8:16], "little")
                if text.encode() in zstandard.decompress(data[16:16 + size]):
                    return


@pytest.fixture
def own_server() -> Iterator[viser.ViserServer]:
    server = make_server("127.0.0.1", 0)
    yield server
    close_server(server)


async def shown_to_all(server: viser.ViserServer, connection: Any, text: str) -> None:
    """Show a text; an open page and one that opens now receive it."""
    browser = Browser(server)
    server.gui.add_html(text)
    await browser.receive(connection, text)
    async with browser.opened() as later:
        await browser.receive(later, text)


def serve(bus: Any) -> None:
    """Answer the requests without which parts of the page are hidden."""
    async def answer(_request: Any) -> Any:
        raise NotImplementedError

    for request in (topics.TASK_COMMAND, topics.MOTION_STOP, topics.WORLD_EDIT):
        bus.serve(request, answer)


@pytest.mark.slow
@pytest.mark.parametrize("cell", ["panda", "ur5"])
async def test_no_message_closes_pages(
    own_server: viser.ViserServer, cell: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ZENCELL_STATE", str(tmp_path))
    members, robot, server = cell_of(cell).section(Members), robot_of(cell), own_server
    application = find_application(members.application)
    kinds = find_layers(application, [], members.keys)
    read = Topics(application, kinds.values(), members.keys)
    net = LocalNetwork()
    bus, tester = net.bus("viewer"), net.bus("tester")
    feeds = Feeds(bus, read.always, read.on_demand)
    console = Console(bus, members, feeds, read.requests, Permissions())
    control = ControlSocket(console)
    serve(tester)
    page = Page(server, feeds, console, OperatorMotion(bus, []), members, application, kinds, control, cell=cell,
                layout=Layout(edit_world=True, layers=dict.fromkeys(kinds, True)), layout_file="",
                robot=cell_of(cell).robot, recordings=tmp_path, schedule=Schedule(), io=Io())
    rough = {"visual_pieces": lambda _robot: rough_of(cell), "coarse": lambda pieces, _share: pieces}
    with patch.multiple("page.scene", **rough):
        scene = Scene(server, robot, around_of(cell), kinds, console, page.timeline.latest, shown=page.shown)
    page.complete(scene, robot, ["ompl"])
    page.pages, now = 1, 100.0
    example = examples(list(robot.joint_names))
    browser = Browser(server)
    async with browser.opened() as connection, asyncio.timeout(10 * PATIENCE):
        tasks = [asyncio.create_task(task) for task in page.tasks(lambda stamp: 1.0 - stamp * 1e-6)]
        for topic in {topic.key: topic for topic in feeds.topics}.values():
            feeds.select(feeds.topics)
            own: Topic[Any] = topics.of_service(topic, "tester") if "<" in topic.key else topic
            writer = tester.writer(own)
            for message in extremes(example[topic.message]):
                writer.put(message)
                for _ in range(3):
                    await asyncio.sleep(0)
                now += 10.0
                try:
                    page.refresh(now, frozenset({"a"}))
                except Exception as error:
                    pytest.fail(f"{topic.key}: {error!r} for {message!r:.1000}")
                assert not any(task.done() for task in tasks), (topic.key, message)
            await shown_to_all(server, connection, f"after {topic.key.replace('<', '').replace('>', '')}")
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def test_no_parameter_closes_pages(own_server: viser.ViserServer) -> None:
    console: Any = ActionQueue()
    panel = TuningPanel(own_server.gui, own_server.gui.add_folder("Tuning"), console)
    async with Browser(own_server).opened() as connection:
        for example in (
            {"type": "number", "value": 0.5, "minimum": 0.0, "maximum": 1.0}, {"type": "integer", "value": 3},
            {"type": "integer", "value": 3, "minimum": 1.0, "maximum": 9.0}, {"type": "boolean", "value": True},
            {"type": "string", "value": "a", "choices": ["a", "b"]}, {"type": "mapping", "value": {"a": [1, 0.5, "b"]}},
        ):
            parameter = m.Parameter.model_validate(
                {"path": "services.a.b", "unit": "m", "description": "c", "default": 1, "runtime": True, **example})
            for number, other in enumerate(extremes(parameter)):
                panel.show({"a": [other]})
                panel.show({"a": [other]})
                if number % 10 == 0:
                    await asyncio.sleep(0)
            await shown_to_all(own_server, connection, f"after {example['type']} {example['value']}")


@pytest.mark.parametrize(("value", "shown"), [
    (1e300, "1.0e+300"), (math.inf, "invalid"), (math.nan, "invalid"), (2**63 - 1, "9223372036854775807")])
async def test_number_that_no_field_can_show_is_shown_as_text(
    own_server: viser.ViserServer, value: float, shown: str
) -> None:
    parameter = m.Parameter(path="services.a.b", value=1, type="integer", runtime=True)
    console: Any = ActionQueue()
    panel = TuningPanel(own_server.gui, own_server.gui.add_folder("Tuning"), console)
    panel.show({"a": [parameter]})
    panel.show({"a": [parameter.model_copy(update={"value": value})]})
    async with Browser(own_server).opened() as connection:
        await shown_to_all(own_server, connection, shown)


@pytest.mark.parametrize("value", [10**30, -(10**400), math.inf, math.nan, "\ud800", 5 * 2**20 * "x"])
async def test_value_that_cannot_be_sent_closes_no_page(own_server: viser.ViserServer, value: Any) -> None:
    gui, scene = own_server.gui, own_server.scene
    number: Any = gui.add_number("Number", 1.0 if isinstance(value, float) else 1)
    text, label = gui.add_text("Text", ""), scene.add_label("/label", "")
    async with Browser(own_server).opened() as connection:
        if isinstance(value, str):
            text.value = label.text = value
            gui.add_html(value)
            await Browser(own_server).receive(connection, "invalid")
        else:
            number.value = number.max = value
            gui.add_dropdown("Choice", ["a"]).options = [value, "b"]
        await shown_to_all(own_server, connection, "it is open")


def test_json_for_a_browser_shows_values_without_a_form_as_invalid() -> None:
    def reject(constant: str) -> None:
        raise AssertionError(f"no browser parses {constant}")

    bad = [math.nan, -math.inf, 10**30, "\ud800", b"a", object(), 5 * 2**20 * "x"]
    good = {"time": 1.5, "lost": [["a", 0.1]], "past": "", "on": True, "none": None}
    assert json.loads(to_json({"bad": bad, **good}), parse_constant=reject) == {"bad": ["invalid"] * len(bad), **good}


async def test_status_with_invalid_numbers_reaches_the_page() -> None:
    sent: asyncio.Queue[str] = asyncio.Queue()

    class Connection:
        async def __aiter__(self) -> AsyncIterator[str]:
            await asyncio.Event().wait()
            yield ""

        async def send(self, data: str) -> None:
            sent.put_nowait(data)

    control = ControlSocket(ActionQueue())
    control.publish(PageStatus(live={"a": math.nan}, summary=(("\ud800", "good"),), lost=(Loss("a", math.nan),)))  # type: ignore[dict-item]
    serving = asyncio.create_task(control.serve(Connection()))  # type: ignore[arg-type]
    async with asyncio.timeout(PATIENCE):
        status = json.loads(await sent.get())["status"]
    serving.cancel()
    assert status["live"]["a"] == "invalid" and status["summary"][0] == ["invalid", "good"]
