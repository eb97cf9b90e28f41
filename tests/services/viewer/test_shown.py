"""Content of the page: states, images, parameters, layers."""

from __future__ import annotations

import asyncio
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml
from websockets.asyncio.client import connect
from websockets.exceptions import InvalidStatus

from applications.outlining.page import choose
from applications.outlining.topics import (
    CONTOUR_PATH,
    CONTOURS,
    OUTLINE_STATUS,
    Contour,
    Contours,
    OutlinePoints,
    OutlineSelect,
    OutlineStatus,
)
from applications.pick_place.topics import DETECTED_OBJECTS, DETECTION_IMAGE, REJECTED_TARGETS, WORKSPACE_MARKERS
from common import messages as m
from common import topics
from common.application import find_application
from common.config import Members, load_cell
from page.access import cookie_value
from page.layout import Layout
from services import viewer
from tests.page.fake_browser import PATIENCE, FakeBrowser, opened
from tests.services.fake_cell import at
from tests.services.viewer.conftest import MIN_AREA, TOKEN, FakeScene, FakeServices, page_of, serve_page, until

AREA = "min area [px^2]"


async def test_state_and_counters_are_shown(panda: FakeServices, page: FakeBrowser) -> None:
    panda.put_task(state="GRASPING", started=True, target="track_4", placed=2, targets=7, stage="pre_grasp")
    panda.put_motion(state="active", progress=0.5, held=True)
    await page.until(lambda: 'data-held="True"' in page.text and "pre grasp" in page.text)
    await page.until(lambda: "Paused" in page.text and "Press Resume to continue." in page.text)
    await page.until(lambda: "<b>2 of 7</b>" in page.text)
    panda.put_motion(state="active", progress=0.5)
    await page.until(lambda: "Grasping track 4" in page.text and "arm moving, 50 % of this motion" in page.text)


async def test_images_and_truth_are_read_only_while_displayed(panda: FakeServices) -> None:
    image, overlay, objects = (panda.bus.writer(topic) for topic in (
        topics.CAMERA_IMAGE, DETECTION_IMAGE, topics.SCENE_OBJECTS))
    assert not image.matched and not overlay.matched and not objects.matched
    async with opened(panda.port) as page:
        await until(lambda: image.matched and overlay.matched)
        assert not objects.matched
        await page.set("Ground truth (simulation)", True)
        await until(lambda: objects.matched)
        await page.set("Detections overlay", False)
        await until(lambda: not overlay.matched)
        assert image.matched
    await until(lambda: not image.matched and not objects.matched)


async def test_parameter_is_changed_on_the_page_and_a_rejected_value_is_reverted(panda, page):
    def value() -> Any:
        return page.values[page.label(AREA)]

    await page.set(AREA, 300.0)
    await page.until(lambda: f"{MIN_AREA} set to 300.0" in page.text)
    assert panda.sets == [({MIN_AREA: 300.0}, "page")]
    with pytest.raises(LookupError):
        page.label("fixed")
    await page.set(AREA, 900.0)
    await page.until(lambda: "900.0 must be less than or equal to 500" in page.text and value() == 300.0)
    assert panda.area == 300.0


async def test_parameter_changed_elsewhere_is_shown(panda: FakeServices, page: FakeBrowser) -> None:
    await page.until(lambda: page.values[page.label(AREA)] == 60.0)
    panda.area = 120.0
    await page.until(lambda: page.values[page.label(AREA)] == 120.0)


async def test_crashed_service_is_red_until_it_is_ready_again(panda: FakeServices, page: FakeBrowser) -> None:
    for status, shown in (
        ({"state": "ready", "pid": 41}, 'data-service="vision_detector" data-state="ready" data-pid="41"'),
        ({"state": "restarting", "restarts": 1, "message": "killed by SIGKILL"}, "killed by SIGKILL"),
        ({"state": "restarting", "restarts": 1, "message": "killed by SIGKILL"}, 'class="bad">● crashed'),
        ({"state": "starting", "pid": 42, "restarts": 1}, 'class="bad">● restarting'),
        ({"state": "ready", "pid": 42, "restarts": 1}, 'data-state="ready" data-pid="42" data-restarts="1"'),
    ):
        service = m.ServiceStatus.model_validate({"name": "vision_detector", **status})
        panda.put(topics.SUPERVISOR_STATUS, m.SupervisorStatus(cell="test", services=[service]))
        await page.until(lambda shown=shown: shown in page.text)


async def test_log_lines_are_escaped_and_filtered_by_level(panda: FakeServices, page: FakeBrowser) -> None:
    odd, log = (panda.bus.writer(topics.of_service(topics.LOG, name)) for name in ("<b>x", "y"))
    await until(lambda: log.matched)
    odd.put(m.LogLine(service="<b>x", level="warning", message="<script>alert(1)</script>"))
    await page.until(lambda: "&lt;script&gt;alert(1)&lt;/script&gt;" in page.text and "&lt;b&gt;x" in page.text)
    assert "<script>" not in page.text
    log.put(m.LogLine(service="y", level="info", message="a quiet line"))
    await page.until(lambda: "a quiet line" in page.text)
    await page.set("Minimum level", "warning")
    await page.until(lambda: "a quiet line" not in page.text)


async def test_invalid_messages_change_nothing(panda, page, capfd):
    await page.until(lambda: page.label("Planner") and page.label("Speed [%]"))
    speed = page.label("Speed [%]")
    changes = [(speed, {"value": value}) for value in ("fast", None, [1], float("nan"), 1e300)]
    changes += [(page.label("Planner"), {"value": "Explode"}), (page.label("Minimum level"), {"value": "nothing"})]
    changes += [(speed, updates) for updates in (
        {"update_cb": []}, {"removed": True}, {"value": 20.0, "label": "Speed"})]
    for uuid, updates in changes:
        await page.send_viser({"type": "GuiUpdateMessage", "uuid": uuid, "updates": updates})
    panda.put(DETECTION_IMAGE, m.Image(header=m.Header(), height=4, width=4, encoding="bgr8", data=b"short"))
    for words in ({}, {"do": "explode"}, {"do": "press"}, {"do": "press", "what": 2000 * "x"}, {"do": "hold", "at": 1}):
        await page.send(**words)
    await page.send(do="press", what="pause")
    await until(lambda: panda.commands)
    assert panda.commands == ["pause"]
    capfd.readouterr()  # viser prints what it could not convert


async def test_lights_are_sent_before_all_meshes(page: FakeBrowser) -> None:
    """Otherwise a browser compiles all shaders twice, which takes seconds without a GPU."""
    await page.until(lambda: page.label("Speed [%]"))
    first = next(number for number, kind in enumerate(page.kinds) if kind in ("GuiSliderMessage", "MeshMessage"))
    lights = ("EnableLightsMessage", "EnvironmentMapMessage", "HemisphereLightMessage")
    assert max(map(page.kinds.index, lights)) < first


async def test_saved_layout_has_the_displayed_content(tmp_path: Path) -> None:
    file = tmp_path / "layout.yaml"
    file.write_text("tabs: [Log, View]\n")
    async with page_of("panda", layout=str(file)) as (_, page):
        await page.set("Frames (TF)", True)
        await page.set("Minimum level", "error")
        await page.click("Save layout")
        await page.until(lambda: f"Saved in {file}" in page.text)
        saved = Layout.model_validate(yaml.safe_load(file.read_text()))
        assert saved.layers == {"frames": True} and saved.log_level == "error" and saved.tabs == ["Log", "View"]
        assert saved.viewpoint("panda").position == (1.0, 2.0, 3.0)
        file.chmod(0o444)
        await page.click("Save layout")
        await page.until(lambda: f"{file} cannot be written: it is read-only" in page.text)
        assert [path.name for path in tmp_path.iterdir()] == [file.name]  # noqa: ASYNC240


async def test_object_selected_in_the_list_or_scene_is_traced_once_its_path_is_known(scenes: list[FakeScene]) -> None:
    async with page_of("ur5") as (services, page):
        await until(lambda: scenes and scenes[0].started)
        console, wanted = scenes[0].console, OutlineSelect(rule="index", index=1)
        await asyncio.to_thread(lambda: console.put(lambda: choose(console, wanted)))  # as viser does on a click
        await until(lambda: services.selects)
        assert services.selects == [wanted]
        services.put(OUTLINE_STATUS, OutlineStatus(state="DONE", started=True))
        contours = [Contour(index=i, label=f"Object_{i}", pixels=[(1.0, 1.0), (2.0, 1.0), (2.0, 2.0)])
                    for i in range(2)]
        services.put(CONTOURS, Contours(header=m.Header(), width=4, height=4, contours=contours, selected=0))
        await page.until(lambda: page.label("● Object_0"))
        await page.click("Object_1")
        await until(lambda: len(services.selects) == 2)
        assert services.selects[1] == OutlineSelect(rule="index", index=1, at=(5 / 3, 4 / 3)) and not services.commands
        services.put(CONTOUR_PATH, OutlinePoints(object="Object_1"))
        await until(lambda: services.commands)
        assert services.commands == ["start"]
        await page.until(lambda: "Object_1 is chosen" in page.text)


# --- the scene ---


async def test_layers_follow_their_checkboxes_also_before_the_scene_is_loaded(panda, page, scenes):
    await until(lambda: scenes and scenes[0].started)
    assert scenes[0].visible["targets"] and not scenes[0].visible["truth"]
    await page.set("Targets", False)
    await until(lambda: not scenes[0].visible["targets"])


async def test_scene_is_updated_while_a_page_is_open(panda: FakeServices, scenes: list[FakeScene]) -> None:
    markers = m.MarkerArray(header=m.Header(), markers=[])
    panda.put(WORKSPACE_MARKERS, markers)
    await until(lambda: scenes)
    assert not scenes[0].calls_of("refresh") and scenes[0].latest(WORKSPACE_MARKERS) is None
    async with opened(panda.port) as page:
        await page.set("Workspace", True)
        await until(lambda: scenes[0].calls_of("refresh") and scenes[0].latest(WORKSPACE_MARKERS) == markers)


def rejections(*positions: tuple[float, float], reason: str = "too far", stamp: int = 0) -> m.Rejections:
    return m.Rejections(header=m.Header(stamp=stamp), rejected=[
        m.Rejection(position=m.Vector3(x=x, y=y), reason=reason) for x, y in positions])


async def test_rejection_before_the_scene_is_loaded_is_shown(scenes, monkeypatch):
    resume = threading.Event()

    def slow(*arguments: object, **options: Any) -> FakeScene:
        assert resume.wait(PATIENCE)
        return FakeScene(*arguments, **options)

    monkeypatch.setattr("page.scene.Scene", slow)
    async with page_of("panda") as (services, page):
        rejected = rejections((1.0, 0.0))
        services.put(REJECTED_TARGETS, rejected)
        await page.send(do="press", what="pause")  # the page works before the scene is loaded
        await until(lambda: services.commands)
        resume.set()
        await until(lambda: scenes and scenes[0].calls_of("handle_event") == [(REJECTED_TARGETS, rejected)])


async def test_rejected_positions_are_counted_once_while_they_are_detected(panda, page):
    panda.put_task()
    for x, reason in ((1.1, "too far"), (1.11, "too far"), (0.2, "too near"), (0.5, "inside the container")):
        panda.put(REJECTED_TARGETS, rejections((x, 0.8), reason=reason, stamp=10))
    await page.until(lambda: '<b>2</b><span class="dim">rejected' in page.text)
    remaining = m.Marker(ns="balls", id=1, type="sphere", pose=at(1.1, 0.8, 0.0),
                         scale=m.Vector3(x=0.06, y=0.06, z=0.06))
    panda.put(DETECTED_OBJECTS, m.MarkerArray(header=m.Header(stamp=5_000_000_000), markers=[remaining]))
    await page.until(lambda: '<b>1</b><span class="dim">rejected' in page.text)


async def test_scene_is_loaded_when_the_cell_is_up_or_a_page_is_open(scenes, monkeypatch):
    monkeypatch.setattr(viewer, "STARTUP_TIMEOUT", 1e6)
    async with serve_page("panda") as services:
        await services.bus.alive.wait("viewer")
        assert not scenes
        async with opened(services.port):
            await until(lambda: scenes)
    scenes.clear()
    async with serve_page("panda") as services:
        for name in load_cell("panda").services.keys() - {"viewer"}:
            assert not scenes
            await services.net.bus(name).ready()
        await until(lambda: scenes)


# --- other cells ---


async def test_control_socket_rejects_foreign_origins_and_missing_tokens() -> None:
    async with serve_page("panda", token=TOKEN) as services:
        address = f"ws://127.0.0.1:{services.port}/control"
        for status, headers in ((401, {}), (403, {
            "Cookie": f"zencell-{services.port}={cookie_value(TOKEN, services.port)}", "Origin": "http://a.b"})):
            with pytest.raises(InvalidStatus) as caught:
                async with connect(address, proxy=None, additional_headers=headers):
                    pass
            assert caught.value.response.status_code == status


async def test_custom_layer_has_a_checkbox_and_reads_its_topics_while_shown(tmp_path, monkeypatch):
    (tmp_path / "viewer_pkg").mkdir()
    (tmp_path / "viewer_pkg" / "noise.py").write_text("""
from common import topics
LABEL, ON, TOPICS = "My noise", False, (topics.DEPTH_CAMERA_DEPTH,)
def show(layer, topic, message): ...
""")
    monkeypatch.syspath_prepend(tmp_path)
    async with page_of("ur5", layers=["viewer_pkg.noise"]) as (services, page):
        depth = services.bus.writer(topics.DEPTH_CAMERA_DEPTH)
        await page.until(lambda: page.values[page.label("My noise")] is False)
        assert not depth.matched
        await page.set("My noise", True)
        await until(lambda: depth.matched)


async def test_images_of_two_cameras_are_shown() -> None:
    members = Members(services=["left_camera", "right_camera"], task="", application="pick_place",
                      keys=[{"camera/*": "left_camera/*"}, {"camera/*": "right_camera/*"}])
    async with page_of("panda", members=members) as (services, page):
        keys = [f"{side}_camera/image_raw" for side in ("left", "right")]
        writers = [services.bus.writer(replace(topics.CAMERA_IMAGE, key=key)) for key in keys]
        await until(lambda: all(writer.matched for writer in writers))
        for writer, grey in zip(writers, (10, 200), strict=True):
            writer.put(m.Image(header=m.Header(), height=4, width=4, encoding="mono8", data=bytes([grey] * 16)))
        await page.until(lambda: all(page.label(key) for key in keys))


async def test_application_without_a_page_has_the_default_buttons_and_texts(tmp_path, monkeypatch):
    (tmp_path / "apps").mkdir()
    (tmp_path / "apps" / "moving.py").write_text("""
from common.application import Application, ApplicationTopics
from common.messages import TaskStatus
from common.topics import Topic
class MovingStatus(TaskStatus):
    pass
STATUS = Topic("moving_status", MovingStatus, "state", "how far the moving is")
APPLICATION = Application(topics=ApplicationTopics(status=STATUS))
""")
    monkeypatch.syspath_prepend(tmp_path)
    members = Members(services=["trajectory_executor", "viewer", "mover"], task="mover", application="apps.moving")
    async with page_of("panda", members=members) as (services, page):
        status = find_application("apps.moving").status
        services.put(status, status.message(state="CARRYING", started=True, subject="cube", done=1, total=2))
        await page.until(lambda: "Carrying cube" in page.text and "<b>1 of 2</b>" in page.text)
        with pytest.raises(LookupError):
            page.label("Targets")
