"""The page as its browser sees it, with services that are played."""

from __future__ import annotations

import asyncio
import re
import threading
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import pytest
import yaml
from websockets.asyncio.client import connect
from websockets.exceptions import InvalidStatus

from common import messages as m
from common import topics
from common.application import find_application
from common.applications.outlining.messages import (
    Contour,
    Contours,
    OutlinePoints,
    OutlineSelect,
    OutlineSelection,
    OutlineStatus,
)
from common.applications.outlining.page import choose
from common.applications.outlining.topics import CONTOUR_PATH, CONTOURS, OUTLINE_SELECT, OUTLINE_STATUS
from common.applications.pick_place.messages import PickPlaceStatus
from common.applications.pick_place.topics import (
    DETECTED_OBJECTS,
    DETECTION_IMAGE,
    PICK_PLACE_STATUS,
    REJECTED_TARGETS,
    WORKSPACE_MARKERS,
)
from common.clock import Clock
from common.config import Cell, Members, load_cell, service_config
from common.errors import Refused
from common.process.in_process import running_service
from common.transport.bus import Bus
from common.transport.local import LocalNetwork
from common.transport.reader import Reader
from common.viewer.layout import Layout
from services import viewer
from tests.common.viewer.browser_double import PATIENCE, BrowserDouble, opened

TOKEN = "a-token-that-is-long-enough"
MIN_AREA = "services.vision_detector.min_area"


async def until(condition: Callable[[], object]) -> None:
    async with asyncio.timeout(PATIENCE):
        while not condition():  # noqa: ASYNC110  # nobody tells
            await asyncio.sleep(0.005)


class SceneDouble:
    """Stands for the 3D scene, whose meshes take seconds to read."""

    made: ClassVar[list[SceneDouble]] = []

    def __init__(self, *arguments: Any, shown: Mapping[str, bool]) -> None:
        self.layers, self.console, self.latest = arguments[3:6]
        self.goal_pose = m.Pose(position=m.Vector3(x=0.4, z=0.5))
        self.calls: list[tuple[str, tuple[Any, ...]]] = []
        self.visible = dict(shown)
        self.begun = False  # is fed, and heard
        SceneDouble.made.append(self)

    def __getattr__(self, name: str) -> Callable[..., None]:
        return lambda *arguments: self.calls.append((name, arguments))

    def set_shown(self, layer: str, on: bool) -> None:
        self.visible[layer] = on
        self.begun = True

    def told(self, name: str) -> list[tuple[Any, ...]]:
        return [arguments for called, arguments in self.calls if called == name]


@pytest.fixture(autouse=True)
def scenes(monkeypatch: pytest.MonkeyPatch) -> list[SceneDouble]:
    monkeypatch.setattr("common.viewer.scene.Scene", SceneDouble)
    monkeypatch.setattr(viewer, "START_PATIENCE", 0.0)
    monkeypatch.setattr(SceneDouble, "made", [])
    return SceneDouble.made


@dataclass
class Played:
    """The services that the page asks, and what they were asked."""

    net: LocalNetwork
    bus: Bus
    port: int = 0
    commands: list[str] = field(default_factory=list)
    holder: str = ""
    stops: list[str] = field(default_factory=list)
    orders: list[tuple[str, str]] = field(default_factory=list)
    sets: list[tuple[dict[str, object], str]] = field(default_factory=list)
    selects: list[OutlineSelect] = field(default_factory=list)
    area: float = 60.0

    async def command(self, request: m.TaskCommand) -> m.TaskStatus:
        self.commands.append(request.command)
        if self.holder and not request.override:
            raise Refused("held", f"the robot is held by {self.holder}")
        return m.TaskStatus()

    async def stop(self, request: m.StopRequest) -> m.MotionStatus:
        self.stops.append(request.reason)
        return m.MotionStatus()

    async def order(self, request: m.RobotCommand) -> m.RobotStatus:
        self.orders.append((request.act, request.owner))
        if request.act == "enable":
            raise Refused("robot", "enable: the emergency stop is pressed")
        return m.RobotStatus(mode="running", controller=True)

    async def select(self, request: OutlineSelect) -> OutlineSelection:
        self.selects.append(request)
        return OutlineSelection(index=request.index or 0, label=f"Object_{request.index or 0}")

    async def parameters(self, request: m.ParameterRequest) -> m.ParameterReply:
        for path, value in request.set.items():
            self.sets.append((request.set, request.by))
            if not isinstance(value, int | float) or value > 500:
                raise Refused("bad_value", f"{path}: {value!r} must be less than or equal to 500")
            self.area = value
        return m.ParameterReply(service="vision_detector", parameters=[
            m.Parameter(path=MIN_AREA, value=self.area, default=60.0, type="number", minimum=0, maximum=1000,
                        unit="px^2", description="least area [px^2]", runtime=True),
            m.Parameter(path="services.vision_detector.fixed", value=1, type="integer"),
        ])

    def serve(self) -> None:
        self.bus.serve(topics.TASK_COMMAND, self.command)
        self.bus.serve(topics.MOTION_STOP, self.stop)
        self.bus.serve(topics.ROBOT_COMMAND, self.order)
        self.bus.serve(OUTLINE_SELECT, self.select)
        self.bus.serve(topics.parameters_of("vision_detector"), self.parameters)


def config_of(cell: Cell, **changes: object) -> viewer.Config:
    return service_config(cell, "viewer", viewer.Config).model_copy(update={"port": 0, **changes})


@asynccontextmanager
async def page_of(cell: str, serve: bool = True, **changes: object) -> AsyncIterator[Played]:
    """A viewer among played services."""
    net = LocalNetwork()
    played = Played(net, net.bus("played", cell="test", clock=Clock()))
    if serve:
        played.serve()
    await played.bus.ready()
    lines = played.bus.reader(topics.LOG)
    async with running_service(net, viewer.run, config_of(load_cell(cell), **changes), name="viewer"):
        async with asyncio.timeout(PATIENCE):
            while (found := re.search(r"page is at http://127\.0\.0\.1:(\d+)", (await lines.next()).message)) is None:
                pass
        played.port = int(found[1])
        yield played


@pytest.fixture
async def panda() -> AsyncIterator[Played]:
    async with page_of("panda") as played:
        yield played


@pytest.fixture
async def page(panda: Played) -> AsyncIterator[BrowserDouble]:
    async with opened(panda.port) as browser:
        yield browser


async def test_stop_stops_the_arm_and_the_task(panda: Played, page: BrowserDouble) -> None:
    await page.speak(do="stop", n=3)
    await until(lambda: panda.stops and panda.commands)
    assert (panda.stops, panda.commands) == (["stopped on the page"], ["stop"])
    await page.until(lambda: ">Stopped by page<" in page.text and page.said == [(3, "Stopped by page", "good")])
    await page.until(lambda: page.news["note"]["line"] == "Stopped by page")


async def test_arm_is_stopped_though_no_task_answers_and_that_is_told(panda: Played) -> None:
    async with page_of("panda", serve=False) as alone:
        alone.bus.serve(topics.MOTION_STOP, alone.stop)
        async with opened(alone.port) as page:
            await page.speak(do="stop", n=1)
            await until(lambda: alone.stops)
            line = "Arm stopped by page; not the task: nobody answers task/command now"
            await page.until(lambda: line in page.text and page.said == [(1, line, "good")])


async def test_stop_that_reaches_nobody_says_so() -> None:
    async with page_of("panda", serve=False) as played, opened(played.port) as page:
        await page.speak(do="stop", n=7)
        line = "NOT stopped: nobody answers motion/stop now"
        await page.until(lambda: line in page.text and page.said == [(7, line, "bad")])


@pytest.mark.parametrize(("command", "state", "others"), [
    ("Start", {"state": "IDLE"}, {"Pause": "nothing runs", "Resume": "nothing is paused"}),
    ("Pause", {"state": "GRASPING", "started": True}, {"Start": "it runs already", "Resume": "nothing is paused"}),
    ("Resume", {"state": "GRASPING", "started": True, "paused": True},
     {"Start": "it is paused: Resume goes on", "Pause": "it is paused already"}),
    ("Start", {"state": "DONE", "started": True}, {"Pause": "nothing runs", "Resume": "nothing is paused"}),
])
async def test_task_is_told_what_is_clicked_and_only_what_does_something_is_on(
    panda: Played, page: BrowserDouble, command: str, state: dict[str, Any], others: dict[str, str]
) -> None:
    panda.bus.writer(topics.MOTION_STATUS).put(m.MotionStatus())
    panda.bus.writer(PICK_PLACE_STATUS).put(PickPlaceStatus(**state))
    await page.press(command)
    await until(lambda: panda.commands)
    assert panda.commands == [command.lower()]
    assert {label: page.button(label)[1] for label in others} == others


async def test_nothing_is_on_before_task_and_arm_say_how_they_are(panda: Played, page: BrowserDouble) -> None:
    await page.until(lambda: "does not say how it is" in page.button("Start")[1])
    assert "the arm does not say" in page.button("Go home")[1]


async def test_robot_that_another_holds_goes_on_when_that_is_said_twice(panda: Played, page: BrowserDouble) -> None:
    panda.holder = "anna"
    panda.bus.writer(PICK_PLACE_STATUS).put(PickPlaceStatus())
    panda.bus.writer(topics.MOTION_STATUS).put(m.MotionStatus(held=True))
    await page.press("Resume")
    await page.until(lambda: "the robot is held by anna: press Resume again for that" in page.text)
    await page.press("Start")
    await page.until(lambda: "press Start again" in page.text)
    await page.press("Start")
    await page.until(lambda: "press Start again" not in page.text)
    assert panda.commands == ["resume", "start", "start"]


async def test_who_stopped_the_robot_is_shown_though_no_task_says_so(panda: Played, page: BrowserDouble) -> None:
    stop = m.Inhibit(kind="stopped", by="anna", reason="smoke", since=0)
    panda.bus.writer(topics.MOTION_STATUS).put(m.MotionStatus(inhibits=[stop]))
    await page.until(lambda: "stopped since 1970-01-01 00:00:00 UTC by anna (smoke)" in page.text)


async def test_an_arm_with_a_controller_says_why_it_cannot_be_moved_and_recovers_when_it_is_asked(
    panda: Played, page: BrowserDouble
) -> None:
    robot = panda.bus.writer(topics.ROBOT_STATUS)
    robot.put(m.RobotStatus(mode="fault", message="the bus is off"))
    panda.bus.writer(topics.MOTION_STATUS).put(m.MotionStatus(held=True))
    await page.until(lambda: "held on its path" in page.text)
    folder = page.label("Controller of the arm")
    assert "the bus is off" not in page.text and not page.parts[folder]["visible"], "it has none"
    robot.put(m.RobotStatus(mode="protective_stop", message="look <why>", speed=0.3, late=0.012, controller=True))
    await page.until(lambda: "Stopped for protection" in page.text and page.parts[folder]["visible"])
    for told in ("look &lt;why&gt;", "<b>30%</b>", "<b>12 ms</b>", 'data-mode="protective_stop"'):
        assert told in page.text
    await page.click("Recover")
    await page.until(lambda: "Recover: can be moved" in page.text)
    await page.click("Enable")
    await page.until(lambda: "enable: the emergency stop is pressed" in page.text)
    assert [act for act, _ in panda.orders] == ["recover", "enable"] and all(owner for _, owner in panda.orders)


async def test_state_and_counters_are_shown_in_words(panda: Played, page: BrowserDouble) -> None:
    status = PickPlaceStatus(state="GRASPING", started=True, target="track_4", placed=2, targets=7, stage="pre_grasp")
    panda.bus.writer(PICK_PLACE_STATUS).put(status)
    panda.bus.writer(topics.MOTION_STATUS).put(m.MotionStatus(state="active", progress=0.5, held=True))
    await page.until(lambda: "Taking track_4" in page.text and "pre grasp" in page.text)
    await page.until(lambda: 'data-held="True"' in page.text and "held on its path" in page.text)
    assert '<div data-field="placed"><b>2</b>' in page.text and '<div data-field="targets"><b>7</b>' in page.text


async def test_pictures_and_truth_are_read_only_while_a_page_that_shows_them_is_open(panda: Played) -> None:
    writers = {topic: panda.bus.writer(topic) for topic in (topics.CAMERA_IMAGE, DETECTION_IMAGE)}
    objects = panda.bus.writer(topics.SCENE_OBJECTS)
    assert not any(writer.matched for writer in writers.values()) and not objects.matched
    async with opened(panda.port) as page:
        await until(lambda: all(writer.matched for writer in writers.values()))
        assert not objects.matched
        await page.set("Truth (simulated hardware)", True)
        await until(lambda: objects.matched)
        await page.set("With what was found", False)
        await until(lambda: not writers[DETECTION_IMAGE].matched)
        assert writers[topics.CAMERA_IMAGE].matched
    await until(lambda: not writers[topics.CAMERA_IMAGE].matched and not objects.matched)


async def test_parameter_changed_on_the_page_is_changed_by_the_page(panda: Played, page: BrowserDouble) -> None:
    await page.set("min area [px^2]", 300.0)
    await until(lambda: panda.sets)
    assert panda.sets == [({MIN_AREA: 300.0}, "page")]
    await page.until(lambda: f"{MIN_AREA} is 300.0 now" in page.text)
    with pytest.raises(LookupError):
        page.label("fixed")


async def test_parameter_changed_elsewhere_is_shown(panda: Played, page: BrowserDouble) -> None:
    await page.until(lambda: page.values[page.label("min area [px^2]")] == 60.0)
    panda.area = 120.0
    await page.until(lambda: page.values[page.label("min area [px^2]")] == 120.0)


async def test_refused_parameter_is_told_and_goes_back(panda: Played, page: BrowserDouble) -> None:
    await page.set("min area [px^2]", 900.0)
    await page.until(lambda: "900.0 must be less than or equal to 500" in page.text)
    await page.until(lambda: page.values[page.label("min area [px^2]")] == 60.0)
    assert panda.area == 60.0


async def test_dead_service_is_red_and_its_return_is_green(panda: Played, page: BrowserDouble) -> None:
    supervisor = panda.bus.writer(topics.SUPERVISOR_STATUS)

    def say(**status: object) -> None:
        service = m.ServiceStatus.model_validate({"name": "vision_detector", **status})
        supervisor.put(m.SupervisorStatus(cell="test", services=[service]))

    say(state="ready", pid=41)
    await page.until(lambda: 'data-service="vision_detector" data-state="ready" data-pid="41"' in page.text)
    say(state="restarting", restarts=1, message="killed by SIGKILL")
    await page.until(lambda: 'class="bad">● died' in page.text and "killed by SIGKILL" in page.text)
    say(state="starting", pid=42, restarts=1)
    await page.until(lambda: 'class="bad">● starts again' in page.text)
    say(state="ready", pid=42, restarts=1)
    await page.until(lambda: 'data-state="ready" data-pid="42" data-restarts="1"' in page.text)


async def test_log_lines_are_text_whatever_is_in_them(panda: Played, page: BrowserDouble) -> None:
    odd, log = (panda.bus.writer(topics.of_service(topics.LOG, name)) for name in ("<b>x", "y"))
    await until(lambda: log.matched)
    odd.put(m.LogLine(service="<b>x", level="warning", message="<script>alert(1)</script>"))
    await page.until(lambda: "&lt;script&gt;alert(1)&lt;/script&gt;" in page.text and "&lt;b&gt;x" in page.text)
    assert "<script>" not in page.text
    log.put(m.LogLine(service="y", level="info", message="a quiet line"))
    await page.until(lambda: "a quiet line" in page.text)
    await page.set("Show", "warning")
    await page.until(lambda: "a quiet line" not in page.text)


async def test_odd_messages_leave_the_page_and_the_service_as_they_are(
    panda: Played, page: BrowserDouble, capfd: pytest.CaptureFixture[str]
) -> None:
    await page.until(lambda: page.label("Planner") and page.label("Speed [%]"))
    speed = page.label("Speed [%]")
    for value in ("fast", None, [1], float("nan"), 1e300):
        await page.say({"type": "GuiUpdateMessage", "uuid": speed, "updates": {"value": value}})
    await page.say({"type": "GuiUpdateMessage", "uuid": page.label("Planner"), "updates": {"value": "Explode"}})
    await page.say({"type": "GuiUpdateMessage", "uuid": page.label("Show"), "updates": {"value": "nothing"}})
    for updates in ({"update_cb": []}, {"removed": True}, {"value": 20.0, "label": "Speed"}):
        await page.say({"type": "GuiUpdateMessage", "uuid": speed, "updates": updates})
    panda.bus.writer(DETECTION_IMAGE).put(m.Image(
        header=m.Header(), height=4, width=4, encoding="bgr8", data=b"short"))
    for words in ({}, {"do": "explode"}, {"do": "press"}, {"do": "press", "what": 2000 * "x"}, {"do": "hold", "at": 1}):
        await page.speak(**words)
    await page.speak(do="press", what="pause")
    await until(lambda: panda.commands)
    assert panda.commands == ["pause"]
    capfd.readouterr()  # viser prints what it could not convert


async def test_goal_that_is_nowhere_is_told_and_the_service_goes_on(panda: Played, page: BrowserDouble) -> None:
    await page.set("Goal", "tool: numbers")
    await page.until(lambda: page.parts[page.label("Tool at [mm]")]["visible"])
    await page.set("Tool at [mm]", [1e11, 0.0, 400.0])
    async with asyncio.timeout(PATIENCE):
        while "position.x" not in page.news["note"]["line"]:
            await page.speak(do="press", what="move:plan")  # over another connection than the numbers
            await asyncio.sleep(0.05)


async def test_light_comes_before_what_it_falls_on() -> None:
    """Else a browser makes the shaders of everything twice, which takes it seconds without a graphics card."""
    async with page_of("panda") as played, opened(played.port) as page:
        await page.until(lambda: page.label("Speed [%]"))
        first = next(number for number, kind in enumerate(page.kinds) if kind in ("GuiSliderMessage", "MeshMessage"))
        lights = ("EnableLightsMessage", "EnvironmentMapMessage", "HemisphereLightMessage")
        assert max(map(page.kinds.index, lights)) < first


async def test_saved_layout_opens_with_what_was_on(tmp_path: Path) -> None:
    file = tmp_path / "layout.yaml"
    file.write_text("tabs: [Log, View]\n")
    async with page_of("panda", layout=str(file)) as played, opened(played.port) as page:
        await page.set("Frames", True)
        await page.set("Show", "error")
        await page.click("Save layout")
        await page.until(lambda: f"Saved in {file}" in page.text)
        saved = Layout.model_validate(yaml.safe_load(file.read_text()))
        assert saved.layers == {"frames": True} and saved.log_level == "error" and saved.tabs == ["Log", "View"]
        assert saved.viewpoint("panda").position == (1.0, 2.0, 3.0)
        file.chmod(0o444)
        await page.click("Save layout")
        await page.until(lambda: f"{file} cannot be written: it is read-only" in page.text)
        assert [path.name for path in tmp_path.iterdir()] == [file.name]  # noqa: ASYNC240


async def test_chosen_object_is_traced_once_its_path_is_known() -> None:
    async with page_of("ur5") as played, opened(played.port) as page:
        played.bus.writer(OUTLINE_STATUS).put(OutlineStatus(state="DONE", started=True))
        contours = [Contour(index=i, label=f"Object_{i}", pixels=[(1.0, 1.0), (2.0, 1.0), (2.0, 2.0)])
                    for i in range(2)]
        played.bus.writer(CONTOURS).put(
            Contours(header=m.Header(), width=4, height=4, contours=contours, selected=0))
        await page.until(lambda: page.label("● Object_0"))
        await page.click("Object_1")
        await until(lambda: played.selects)
        assert played.selects == [OutlineSelect(rule="index", index=1, at=(5 / 3, 4 / 3))] and played.commands == []
        played.bus.writer(CONTOUR_PATH).put(OutlinePoints(object="Object_1"))
        await until(lambda: played.commands)
        assert played.commands == ["start"]
        await page.until(lambda: "Object_1 is chosen" in page.text)


async def test_contour_that_is_clicked_in_the_scene_is_chosen(scenes: list[SceneDouble]) -> None:
    async with page_of("ur5") as played:
        await until(lambda: scenes and scenes[0].begun)
        console, wanted = scenes[0].console, OutlineSelect(rule="index", index=1)
        await asyncio.to_thread(lambda: console.put(lambda: choose(console, wanted)))  # as viser does
        await until(lambda: played.selects)
        assert played.selects == [OutlineSelect(rule="index", index=1)]


async def test_object_that_is_dragged_is_moved_in_the_world_and_a_refusal_is_told(
    panda: Played, page: BrowserDouble, scenes: list[SceneDouble]
) -> None:
    moved: list[m.WorldEdit] = []

    async def edit(request: m.WorldEdit) -> m.WorldEditReply:
        moved.append(request)
        raise Refused("not_free", "ball_1 lies there")

    panda.bus.serve(topics.WORLD_EDIT, edit)
    await page.set("Edit the simulated world", True)
    await until(lambda: scenes and scenes[0].told("set_editing"))
    console = scenes[0].console
    await asyncio.to_thread(lambda: console.put(lambda: console.move("ball_2", 0.5, 0.1)))
    await page.until(lambda: "ball_1 lies there" in page.text)
    assert moved == [m.WorldEdit(op="move", id="ball_2", position=m.Vector3(x=0.5, y=0.1))]


async def test_layers_are_shown_as_ticked_also_before_the_scene_is_there(
    panda: Played, page: BrowserDouble, scenes: list[SceneDouble]
) -> None:
    await until(lambda: scenes and scenes[0].begun)
    assert scenes[0].visible["targets"] and not scenes[0].visible["truth"]
    await page.set("Targets", False)
    await until(lambda: not scenes[0].visible["targets"])


async def test_scene_is_told_what_the_cell_says_while_somebody_looks(panda: Played, scenes: list[SceneDouble]) -> None:
    told = m.MarkerArray(header=m.Header(), markers=[])
    panda.bus.writer(WORKSPACE_MARKERS).put(told)
    await until(lambda: scenes)
    assert not scenes[0].told("refresh") and scenes[0].latest(WORKSPACE_MARKERS) is None
    async with opened(panda.port):
        await until(lambda: scenes[0].told("refresh") and scenes[0].latest(WORKSPACE_MARKERS) == told)


async def test_plan_to_the_marker_tells_what_is_in_the_way(
    panda: Played, page: BrowserDouble, scenes: list[SceneDouble]
) -> None:
    asked: list[m.PlanRequest] = []

    async def plan(request: m.PlanRequest) -> m.PlanResponse:
        asked.append(request)
        return m.PlanResponse(id=request.id, ok=False, error="collision", message="operator: the goal collides",
                              colliding=("panda_hand", "table"))

    panda.bus.serve(topics.MOTION_PLAN, plan)
    await until(lambda: scenes)
    await page.press("Plan")
    await page.until(lambda: "Drag the goal marker" in page.text)
    await until(lambda: scenes[0].told("goal_marker") == [(True,)])
    await page.set("Planner", "chomp")
    await page.press("Plan")
    await page.until(lambda: "the goal collides; panda_hand would touch table" in page.text)
    assert (asked[0].planner, asked[0].goal) == ("chomp", m.PoseGoal(pose=scenes[0].goal_pose))


async def test_rejection_that_came_before_the_scene_is_shown_in_it(
    scenes: list[SceneDouble], monkeypatch: pytest.MonkeyPatch
) -> None:
    go = threading.Event()

    def slow(*arguments: object, **options: Any) -> SceneDouble:
        assert go.wait(PATIENCE)
        return SceneDouble(*arguments, **options)

    monkeypatch.setattr("common.viewer.scene.Scene", slow)
    async with page_of("panda") as played, opened(played.port) as page:
        rejected = m.Rejections(header=m.Header(), rejected=[m.Rejection(position=m.Vector3(x=1.0), reason="too far")])
        played.bus.writer(REJECTED_TARGETS).put(rejected)
        await page.speak(do="press", what="pause")  # the page is there before the scene is
        await until(lambda: played.commands)
        go.set()
        await until(lambda: scenes and scenes[0].told("happened") == [(REJECTED_TARGETS, rejected)])


async def test_meshes_are_read_when_the_cell_is_up_or_somebody_looks(
    scenes: list[SceneDouble], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(viewer, "START_PATIENCE", 1e6)
    cell = load_cell("panda")
    async with page_of("panda") as played:
        await played.bus.alive.wait("viewer")
        assert not scenes
        async with opened(played.port):
            await until(lambda: scenes)
    scenes.clear()
    async with page_of("panda") as played:
        for name in cell.services.keys() - {"viewer"}:  # which is there already
            assert not scenes
            await played.net.bus(name, cell="test").ready()
        await until(lambda: scenes)


async def jogs_of(reader: Reader[m.JogCommand], count: int) -> list[m.JogCommand]:
    async with asyncio.timeout(PATIENCE):
        return [await reader.next() for _ in range(count)]


async def ready_to_jog(panda: Played, page: BrowserDouble) -> Reader[m.JogCommand]:
    reader = panda.bus.reader(topics.MOTION_JOG)
    panda.bus.writer(topics.MOTION_STATUS).put(m.MotionStatus())
    await page.until(lambda: not page.button("Open")[1])
    return reader


async def test_arm_is_jogged_by_each_word_that_a_button_is_held_and_by_nothing_else(
    panda: Played, page: BrowserDouble
) -> None:
    reader = await ready_to_jog(panda, page)
    held = []
    for _ in range(3):
        await page.hold("joint:panda_joint2:-")
        held += await jogs_of(reader, 1)
    assert {tuple(jog.joints) for jog in held} == {("panda_joint2",)} and held[0].joints["panda_joint2"] < 0
    assert {jog.owner for jog in held} == {"page"} and all(jog.header.stamp for jog in held)
    await page.speak(do="release")
    (rest,) = await jogs_of(reader, 1)
    assert not rest.joints and rest.linear == m.Vector3()
    await page.set("Jogged", "tool, its own axes")
    await page.until(lambda: "move:tool:z:+" in page.text)
    await page.hold("move:tool:z:+", press=2)
    (jog,) = await jogs_of(reader, 1)
    assert jog.frame == "tool" and jog.linear.z == pytest.approx(0.2 * 0.25) and not jog.joints
    for odd in ("move:moon:z:+", "joint:elbow:+", "joint:panda_joint2:", "move:tool:w:-", ""):
        await page.hold(odd)
    await page.speak(do="release")
    (rest,) = await jogs_of(reader, 1)
    assert rest.linear == m.Vector3()


async def test_arm_comes_to_rest_when_the_page_that_jogs_it_is_closed(panda: Played) -> None:
    async with opened(panda.port) as page:
        reader = await ready_to_jog(panda, page)
        await page.hold("joint:panda_joint1:+")
        (jog,) = await jogs_of(reader, 1)
        assert jog.joints
    (rest,) = await jogs_of(reader, 1)
    assert not rest.joints


async def test_stop_ends_jogging_until_the_button_is_let_go(panda: Played, page: BrowserDouble) -> None:
    reader, status = await ready_to_jog(panda, page), panda.bus.writer(topics.MOTION_STATUS)
    await page.hold("joint:panda_joint1:+")
    await jogs_of(reader, 1)
    stop = m.Inhibit(kind="stopped", by="page", since=7)
    status.put(m.MotionStatus(inhibits=[stop]))
    await page.until(lambda: "stopped since" in page.text)
    await page.hold("joint:panda_joint1:+")
    assert not (await jogs_of(reader, 1))[0].joints
    for _ in range(3):
        await page.hold("joint:panda_joint1:+")  # goes on: that press never counts again
    await page.until(lambda: page.said and "is not jogged: it is stopped" in page.said[-1][1])
    async with asyncio.timeout(PATIENCE):
        while reader.latest is None or not reader.latest.joints:  # pressed anew: one's own stop
            await page.hold("joint:panda_joint1:+", press=2)
            await asyncio.sleep(0.04)
    assert reader.latest.heard == 7
    status.put(m.MotionStatus(inhibits=[stop.model_copy(update={"by": "anna", "since": 8})]))
    await page.until(lambda: "by anna" in page.text)
    await page.speak(do="release")
    await page.hold("joint:panda_joint1:+", press=3)
    await page.until(lambda: "by anna" in page.said[-1][1])


async def test_arm_that_a_task_has_is_not_jogged_and_the_buttons_say_why(panda: Played, page: BrowserDouble) -> None:
    reader = await ready_to_jog(panda, page)
    panda.bus.writer(PICK_PLACE_STATUS).put(PickPlaceStatus(state="GRASPING", started=True))
    await page.until(lambda: "the task has the arm" in page.button("Open")[1])
    await page.hold("joint:panda_joint1:+")
    await page.until(lambda: page.said and "not jogged: the task has the arm" in page.said[-1][1])
    assert reader.latest is None


async def test_of_two_operators_one_operates_and_the_other_sees_whom_and_takes_over() -> None:
    async with (
        page_of("panda", token=TOKEN) as played,
        opened(played.port, TOKEN) as first, opened(played.port, TOKEN) as second,
    ):
        reader = await ready_to_jog(played, first)
        await first.hold("joint:panda_joint1:+")
        await jogs_of(reader, 1)
        await second.until(lambda: "operates: Take over, or wait" in second.news["kept"])
        assert first.news["kept"] == "", "its two connections are one page"
        await second.hold("joint:panda_joint1:-")
        await second.until(lambda: second.said and "operates: Take over" in second.said[-1][1])
        await second.speak(do="stop", n=1)
        await until(lambda: played.stops)
        await second.press("Take over")
        await first.until(lambda: "operates: Take over" in first.news["kept"] and second.news["kept"] == "")
        assert all(not jog.joints or jog.joints["panda_joint1"] > 0 for jog in [reader.latest] if jog)


async def test_line_is_closed_to_other_pages_and_to_who_has_no_token() -> None:
    async with page_of("panda", token=TOKEN) as played:
        address = f"ws://127.0.0.1:{played.port}/line"
        for status, headers in ((401, {}), (403, {"Cookie": f"zencell-{played.port}={TOKEN}", "Origin": "http://a.b"})):
            with pytest.raises(InvalidStatus) as refused:
                async with connect(address, proxy=None, additional_headers=headers):
                    pass
            assert refused.value.response.status_code == status


async def test_fingers_open_by_the_gripper_that_there_is(panda: Played, page: BrowserDouble) -> None:
    asked: list[m.GripperCommand] = []

    async def grip(request: m.GripperCommand) -> m.GripperState:
        asked.append(request)
        return m.GripperState(id=request.id, state="active")

    panda.bus.serve(topics.GRIPPER_COMMAND, grip)
    await ready_to_jog(panda, page)
    await page.set("Width [mm]", 30.0)
    await page.set("Force [N]", 12.0)
    for button in ("To width", "Open", "Close"):
        await page.press(button)
        await until(lambda button=button: len(asked) == 1 + ("To width", "Open", "Close").index(button))
    assert [(round(one.width, 4), one.effort) for one in asked] == [(0.03, 12.0), (0.08, 12.0), (0.0, 12.0)]
    assert all(one.header.stamp for one in asked), "one that comes late is refused by when it was decided"


async def test_taught_pose_is_a_goal_and_is_kept_for_the_next_page(panda: Played, page: BrowserDouble) -> None:
    asked: list[m.PlanRequest] = []

    async def plan(request: m.PlanRequest) -> m.PlanResponse:
        asked.append(request)
        return m.PlanResponse(id=request.id, ok=False, error="unreachable", message="not today")

    panda.bus.serve(topics.MOTION_PLAN, plan)
    names = [f"panda_joint{k}" for k in range(1, 8)]
    q = [0.1, -0.7, 0.0, -2.0, 0.0, 1.5, 0.7]
    panda.bus.writer(topics.JOINT_STATES).put(m.JointState(header=m.Header(stamp=1), name=names, position=q))
    await ready_to_jog(panda, page)
    await page.until(lambda: page.news.get("live", {}).get("j:panda_joint1") == "5.7 °")
    assert page.button("Teach")[1] == "give it a name first"
    await page.set("Name", "over, there")
    await page.press("Teach")
    await page.until(lambda: "'over, there'" in page.text or "over, there" in page.news["note"]["line"])
    await page.set("Name", "bin")
    await page.set("Waypoints", "bin")  # comes after the name; a press comes over another connection
    await page.until(lambda: not page.button("Go through")[1])
    await page.press("Teach")
    await page.until(lambda: "bin" in page.parts[page.label("Goal")]["options"])
    await page.set("Goal", "bin")
    await page.press("Plan")
    await until(lambda: asked)
    assert asked[0].goal == m.JointGoal(positions=q)
    async with page_of("panda") as again, opened(again.port) as later:
        await later.until(lambda: "bin" in later.parts[later.label("Goal")]["options"])


async def test_plan_that_was_found_is_executed_once(panda: Played, page: BrowserDouble) -> None:
    found = m.JointTrajectory(header=m.Header(stamp=5), joint_names=["a"], points=[
        m.JointTrajectoryPoint(positions=[float(k)], velocities=[0.0], accelerations=[0.0], time_from_start=float(k))
        for k in range(2)])
    asked: list[m.ExecuteRequest] = []

    async def plan(request: m.PlanRequest) -> m.PlanResponse:
        return m.PlanResponse(id=request.id, ok=True, planner="ompl", trajectory=found)

    async def execute(request: m.ExecuteRequest) -> m.MotionStatus:
        asked.append(request)
        return m.MotionStatus(id=request.id, state="succeeded")

    panda.bus.serve(topics.MOTION_PLAN, plan)
    panda.bus.serve(topics.MOTION_EXECUTE, execute)
    panda.bus.writer(PICK_PLACE_STATUS).put(PickPlaceStatus())
    await ready_to_jog(panda, page)
    assert page.button("Execute")[1] == "plan first"
    await page.set("Goal", "home")
    await page.press("Plan")
    await page.press("Execute")
    await until(lambda: asked)
    assert asked[0].trajectory == found and asked[0].plan
    await page.until(lambda: page.button("Execute")[1] == "plan first")


async def test_plans_of_two_planners_are_shown_beside_each_other_and_either_is_executed(
    panda: Played, page: BrowserDouble, scenes: list[SceneDouble]
) -> None:
    asked: list[m.ExecuteRequest] = []

    def found(seconds: float) -> m.JointTrajectory:
        return m.JointTrajectory(joint_names=["panda_joint1"], points=[
            m.JointTrajectoryPoint(time_from_start=at, positions=[at], velocities=[0.0], accelerations=[0.0])
            for at in (0.0, seconds)])

    async def plan(request: m.PlanRequest) -> m.PlanResponse:
        return m.PlanResponse(id=request.id, ok=True, planner=request.planner or "first", seconds=0.1,
                              trajectory=found(2.0 if request.planner else 1.0))

    async def execute(request: m.ExecuteRequest) -> m.MotionStatus:
        asked.append(request)
        return m.MotionStatus(id=request.id, state="active")

    panda.bus.serve(topics.MOTION_PLAN, plan)
    panda.bus.serve(topics.MOTION_EXECUTE, execute)
    panda.bus.writer(PICK_PLACE_STATUS).put(PickPlaceStatus())
    await ready_to_jog(panda, page)
    await page.set("Goal", "home")
    await page.set("Compare with", "ptp")
    await page.until(lambda: page.button("Execute the other")[1] == "plan first")
    await page.press("Plan")
    await page.until(lambda: "a motion of 1.0 s" in page.text and "ptp: Planned by ptp" in page.text)
    assert scenes[0].told("play") == [(found(1.0),)] and scenes[0].told("compare")[-1] == (found(2.0),)
    await page.press("Execute the other")
    await until(lambda: asked)
    assert asked[0].trajectory == found(2.0)
    await page.until(lambda: page.button("Execute")[1] == page.button("Execute the other")[1] == "plan first")


async def test_whose_the_motion_is_is_told_and_it_is_taken_over_when_that_is_said_twice(
    panda: Played, page: BrowserDouble
) -> None:
    asked: list[m.OwnRequest] = []
    anna = m.MotionOwner(owner="anna", kind="operator", asked=True, since=1)

    async def own(request: m.OwnRequest) -> m.MotionOwner:
        asked.append(request)
        if not request.over:
            raise Refused("not_owner", f"the motion is {anna.told}")
        return m.MotionOwner(owner=request.owner, kind="operator", asked=True)

    panda.bus.serve(topics.MOTION_OWN, own)
    panda.bus.writer(topics.MOTION_OWNER).put(anna)
    await page.until(lambda: "anna&#x27;s (operator)" in page.text and "anna's (operator)" in page.news["kept"])
    await page.press("Take")
    await page.until(lambda: "press Take again for that" in page.text)
    await page.press("Take")
    await page.until(lambda: "The motion is page" in page.text)
    assert [(one.act, one.over, one.owner) for one in asked] == [("take", False, "page"), ("take", True, "page")]


async def test_plan_that_was_found_is_played(
    panda: Played, page: BrowserDouble, scenes: list[SceneDouble]
) -> None:
    found = m.JointTrajectory(header=m.Header(stamp=5), joint_names=["a"], points=[])

    async def plan(request: m.PlanRequest) -> m.PlanResponse:
        return m.PlanResponse(id=request.id, ok=True, planner="ompl", trajectory=found)

    panda.bus.serve(topics.MOTION_PLAN, plan)
    await page.set("Goal marker", True)
    await until(lambda: scenes and scenes[0].told("goal_marker"))
    await page.press("Plan")
    await page.until(lambda: "Planned by ompl" in page.text)
    await until(lambda: scenes[0].told("play") == [(found,)])


async def test_layer_of_a_persons_own_has_a_tick_and_reads_its_topics_while_it_is_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "viewer_pkg").mkdir()
    (tmp_path / "viewer_pkg" / "noise.py").write_text("""
from common import topics
LABEL, ON, TOPICS = "My noise", False, (topics.DEPTH_CAMERA_DEPTH,)
def show(layer, topic, message): ...
""")
    monkeypatch.syspath_prepend(tmp_path)
    async with page_of("ur5", layers=["viewer_pkg.noise"]) as played, opened(played.port) as page:
        depth = played.bus.writer(topics.DEPTH_CAMERA_DEPTH)
        await page.until(lambda: page.values[page.label("My noise")] is False)
        assert not depth.matched
        await page.set("My noise", True)
        await until(lambda: depth.matched)


async def test_pictures_of_two_cameras_are_shown_beside_each_other() -> None:
    members = Members(services=["left_camera", "right_camera"], task="", application="pick_place",
                      keys=[{"camera/*": "left_camera/*"}, {"camera/*": "right_camera/*"}])
    async with page_of("panda", members=members) as played, opened(played.port) as page:
        keys = [f"{side}_camera/image_raw" for side in ("left", "right")]
        writers = [played.bus.writer(replace(topics.CAMERA_IMAGE, key=key)) for key in keys]
        await until(lambda: all(writer.matched for writer in writers))
        for writer, grey in zip(writers, (10, 200), strict=True):
            writer.put(m.Image(header=m.Header(), height=4, width=4, encoding="mono8", data=bytes([grey] * 16)))
        await page.until(lambda: all(page.label(key) for key in keys))


async def test_application_without_a_page_gets_the_buttons_and_words_of_every_task(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "apps").mkdir()
    (tmp_path / "apps" / "moving.py").write_text("""
from common.messages import TaskStatus
from common.topics import Topic
class MovingStatus(TaskStatus):
    pass
STATUS = Topic("moving_status", MovingStatus, "state", "how far the moving is")
""")
    monkeypatch.syspath_prepend(tmp_path)
    members = Members(services=["trajectory_executor", "viewer", "mover"], task="mover", application="apps.moving")
    async with page_of("panda", members=members) as played, opened(played.port) as page:
        application = find_application("apps.moving")
        status = application.status.message(state="CARRYING", started=True, subject="cube", done=1, total=2)
        played.bus.writer(application.status).put(status)
        await page.until(lambda: "Carrying cube" in page.text and '<div data-field="done"><b>1</b>' in page.text)
        with pytest.raises(LookupError):
            page.label("Targets")


async def test_rejected_places_are_counted_once(panda: Played, page: BrowserDouble) -> None:
    writer = panda.bus.writer(REJECTED_TARGETS)
    panda.bus.writer(PICK_PLACE_STATUS).put(PickPlaceStatus())
    for x, reason in ((0.9, "too far"), (0.91, "too far"), (0.2, "too near"), (0.5, "inside the container")):
        rejection = m.Rejection(position=m.Vector3(x=x), reason=reason)
        writer.put(m.Rejections(header=m.Header(), rejected=[rejection]))
    await page.until(lambda: '<div data-field="rejected"><b>2</b>' in page.text)


async def test_rejected_places_are_counted_no_more_when_nothing_lies_there_whoever_reset_the_world(
    panda: Played, page: BrowserDouble
) -> None:
    panda.bus.writer(PICK_PLACE_STATUS).put(PickPlaceStatus())
    panda.bus.writer(REJECTED_TARGETS).put(m.Rejections(header=m.Header(stamp=10), rejected=[
        m.Rejection(position=m.Vector3(x=x, y=0.8), reason="too far") for x in (1.1, 1.3, 1.5)]))
    detected = panda.bus.writer(DETECTED_OBJECTS)
    lies = m.Marker(ns="balls", id=1, type="sphere", pose=m.Pose(position=m.Vector3(x=1.1, y=0.8)),
                    scale=m.Vector3(x=0.06, y=0.06, z=0.06))
    await page.until(lambda: '<div data-field="rejected"><b>3</b>' in page.text)
    detected.put(m.MarkerArray(header=m.Header(stamp=5_000_000_000), markers=[lies]))
    await page.until(lambda: '<div data-field="rejected"><b>1</b>' in page.text)


async def test_page_looks_back_and_what_moves_the_arm_brings_it_to_now(
    panda: Played, page: BrowserDouble, scenes: list[SceneDouble]
) -> None:
    joints, status = panda.bus.writer(topics.JOINT_STATES), panda.bus.writer(PICK_PLACE_STATUS)

    def seen() -> float | None:
        state = scenes[0].latest(topics.JOINT_STATES) if scenes else None
        return state.position[0] if state is not None else None

    async def say(state: Any, value: float) -> None:
        status.put(PickPlaceStatus(state=state, started=True, subject="ball_1"))
        joints.put(m.JointState(header=m.Header(stamp=round(1 + value)), name=["panda_joint1"], position=[value]))
        await until(lambda: seen() == value)
        await asyncio.sleep(0.5)  # is kept by then

    await say("GRASPING", 1.0)
    await say("PLACING", 2.0)
    await page.until(lambda: "Placing ball_1" in page.text and "Taking ball_1" in page.text)
    await page.press("‹ event")
    await page.press("‹ event")
    await until(lambda: seen() == 1.0)
    await page.until(lambda: "s ago" in page.news["past"])
    await page.press("Take")
    await until(lambda: seen() == 2.0)
    await page.until(lambda: not page.news["past"])


async def test_page_guides_a_hand_eye_calibration(panda: Played, page: BrowserDouble) -> None:
    await page.until(lambda: page.button("Begin")[1] == "give it a name first")
    assert page.button("Take a picture")[1] == "begin first"
    await page.set("Take pictures by itself", False)
    await page.set("Called", "wrist")
    await page.press("Begin")
    await page.until(lambda: "Missing: 15 more views: tilt the hand to another side" in page.text)
    assert page.button("Calibrate")[1] == "6 views are needed"
    picture = m.Image(header=m.Header(), height=48, width=64, encoding="bgr8", data=bytes(3 * 48 * 64))
    panda.bus.writer(topics.CAMERA_IMAGE).put(picture)
    await page.press("Take a picture")
    await page.until(lambda: "nobody says where the joints were" in page.text or "no picture comes" in page.text)
    await page.press("End")
    await page.until(lambda: page.button("Calibrate")[1] == "begin first")
