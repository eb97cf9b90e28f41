"""Layers are found by name: those of the platform, of an application and of the user."""

from __future__ import annotations

from pathlib import Path

import pytest
import viser

from common import messages as m
from common.application import find_application, find_topic
from common.errors import ConfigError, UnknownName
from page.layers import find_layers, has_data, shown_layers
from page.scene import Scene
from tests.page.scene_cell import Clock, FakeConsole, around_of, robot_of

PANDA = find_application("pick_place")
CUSTOM = '''
from common import topics
LABEL = "Gripper width"
ON = False
TOPICS = (topics.GRIPPER_STATE,)
def show(layer, topic, message):
    layer.scene.add_label(f"{layer.root}/width", f"{1000 * message.width:.0f} mm")
'''
CLASSES = '''
from page.layers import Layer
class Floor(Layer):
    LABEL = "Floor"
    def build(self):
        self.scene.add_frame(f"{self.root}/floor")
class HighWall(Layer):
    LABEL = "Wall"
'''


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "page_pkg"
    folder.mkdir()
    monkeypatch.syspath_prepend(tmp_path)
    return folder


def test_cell_has_the_layers_of_the_platform_and_of_its_application() -> None:
    panda, ur5 = find_layers(PANDA), find_layers(find_application("outlining"))
    everywhere = {"robot", "fixtures", "objects", "plan", "tool_path", "camera", "frames", "truth", "grid",
                  "collision_shapes", "reach", "points", "compared"}
    assert {*panda} & {*ur5} == everywhere
    assert {*panda} - {*ur5} == {"targets", "rejected", "workspace"}
    assert {*ur5} - {*panda} == {"outline", "contours"}
    assert (next(iter(panda)), list(panda)[-1]) == ("robot", "grid")  # in the order of their checkboxes
    assert all(kind.LABEL for kind in (*panda.values(), *ur5.values()))


def test_module_with_topics_and_show_is_a_layer(folder: Path, server: viser.ViserServer) -> None:
    (folder / "hand_width.py").write_text(CUSTOM)
    layers = find_layers(PANDA, ["page_pkg.hand_width"])
    name = "page_pkg.hand_width"
    assert (layers[name].LABEL, shown_layers({}, layers)[name]) == ("Gripper width", False)
    server.scene.reset()
    messages = {"gripper/state": m.GripperState(width=0.04)}
    scene = Scene(
        server, robot_of("panda"), around_of("panda"), {name: layers[name]}, FakeConsole(),  # type: ignore[arg-type]
        lambda topic: messages.get(topic.key), shown={name: True}, clock=Clock(),  # type: ignore[arg-type, return-value]
    )
    scene.refresh(1.0)
    label = server.scene.get_handle_by_name(f"/{name}/width")
    assert isinstance(label, viser.LabelHandle) and label.text == "40 mm"


def test_module_may_have_several_layers_as_classes(folder: Path) -> None:
    (folder / "house.py").write_text(CLASSES)
    layers = find_layers(None, ["page_pkg.house"])
    assert [name for name in layers if "." in name] == ["page_pkg.house.floor", "page_pkg.house.high_wall"]


@pytest.mark.parametrize(
    ("text", "message"),
    [("import no_such_thing", "cannot be imported: No module named 'no_such_thing'"),
     ("TOPICS = ()", "has no layer: neither a class derived from Layer, nor LABEL"), ],
)
def test_module_without_a_layer_is_rejected_by_name(folder: Path, text: str, message: str) -> None:
    (folder / f"wrong_{len(text)}.py").write_text(text)
    with pytest.raises(ConfigError, match=f"services.viewer.layers: 'page_pkg.wrong_{len(text)}' {message}"):
        find_layers(PANDA, [f"page_pkg.wrong_{len(text)}"])


def test_layout_may_name_layers_of_other_cells() -> None:
    shown = shown_layers({"outline": False, "their.layer": True, "robot": False}, find_layers(PANDA))
    assert "outline" not in shown and "their.layer" not in shown and not shown["robot"]
    with pytest.raises(UnknownName, match="layer 'outlien'"):
        shown_layers({"outlien": False}, find_layers(PANDA))


def test_layer_is_offered_if_one_of_its_topics_is_published() -> None:
    layers = find_layers(PANDA)
    def offered(*keys: str) -> set[str]:
        return {name for name, kind in layers.items() if has_data(kind, keys)}
    assert offered() == {"grid"}
    assert offered("tf", "tf_static", "joint_states") == {
        "grid", "robot", "collision_shapes", "reach", "frames", "compared"}
    assert offered("depth_camera/points") - offered() == {"points"}
    assert offered("camera/camera_info") - offered() == {"camera"}
    assert offered("scene_objects") - offered() == {"truth"}


def test_topics_of_all_layers_are_known() -> None:
    for name in ("pick_place", "outlining"):
        for layer in find_layers(find_application(name)).values():
            for topic in layer.TOPICS:
                assert topic == find_topic(topic.key)
