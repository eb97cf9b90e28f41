"""Layers are found by name: those of the platform, of an application and of the user."""

from pathlib import Path

import pytest

from common.application import find_application, find_topic
from common.errors import ConfigError, UnknownName
from page.layers import find_layers, has_data, shown_layers

PANDA, UR5 = find_application("pick_place"), find_application("outlining")
MODULES = {
    "single": 'LABEL = "Gripper width"\nON = False\nTOPICS = ()\ndef show(layer, topic, message): pass\n',
    "house": 'from page.layers import Layer\nclass Floor(Layer):\n    LABEL = "Floor"\n'
             'class HighWall(Layer):\n    LABEL = "Wall"\n',
    "broken": "import no_such_thing", "empty": "TOPICS = ()",
}


@pytest.fixture(autouse=True)
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "page_pkg").mkdir()
    for name, text in MODULES.items():
        (tmp_path / "page_pkg" / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)


def test_cell_has_the_layers_of_the_platform_and_of_its_application() -> None:
    panda, ur5 = find_layers(PANDA), find_layers(UR5)
    everywhere = {"robot", "fixtures", "objects", "plan", "tool_path", "camera", "frames", "truth", "grid",
                  "collision_shapes", "reach", "points", "compared"}
    assert {*panda} & {*ur5} == everywhere
    assert {*panda} - {*ur5} == {"targets", "rejected", "workspace"}
    assert {*ur5} - {*panda} == {"outline", "contours"}
    assert (next(iter(panda)), list(panda)[-1]) == ("robot", "grid")  # in the order of their checkboxes
    for kind in (*panda.values(), *ur5.values()):
        assert kind.LABEL and all(topic == find_topic(topic.key) for topic in kind.TOPICS)


def test_custom_module_is_a_layer_or_has_several_as_classes() -> None:
    layers = find_layers(PANDA, ["page_pkg.single", "page_pkg.house"])
    names = [name for name in layers if "." in name]
    assert names == ["page_pkg.single", "page_pkg.house.floor", "page_pkg.house.high_wall"]
    assert [layers[name].LABEL for name in names] == ["Gripper width", "Floor", "Wall"]
    assert not shown_layers({}, layers)["page_pkg.single"]


@pytest.mark.parametrize(("module", "message"), [
    ("broken", "cannot be imported: No module named 'no_such_thing'"),
    ("empty", "has no layer: neither a class derived from Layer, nor LABEL"),
])
def test_module_without_a_layer_is_rejected_by_name(module: str, message: str) -> None:
    with pytest.raises(ConfigError, match=f"services.viewer.layers: 'page_pkg.{module}' {message}"):
        find_layers(PANDA, [f"page_pkg.{module}"])


def test_layout_may_name_layers_of_other_cells() -> None:
    shown = shown_layers({"outline": False, "their.layer": True, "robot": False}, find_layers(PANDA))
    assert "outline" not in shown and "their.layer" not in shown and not shown["robot"]
    with pytest.raises(UnknownName, match="layer 'outlien'"):
        shown_layers({"outlien": False}, find_layers(PANDA))


@pytest.mark.parametrize(("keys", "offered"), [
    ([], set()), (["depth_camera/points"], {"points"}), (["camera/camera_info"], {"camera"}),
    (["scene_objects"], {"truth"}),
    (["tf", "tf_static", "joint_states"], {"robot", "collision_shapes", "reach", "frames", "compared"}),
])
def test_layer_is_offered_if_one_of_its_topics_is_published(keys: list[str], offered: set[str]) -> None:
    assert {name for name, kind in find_layers(PANDA).items() if has_data(kind, keys)} == {"grid", *offered}
