"""One module as several services of a cell: their names, their keys, and the camera of each."""

from pathlib import Path

import pytest
import yaml

from common.config import Surroundings, load_cell, service_config
from common.errors import ConfigError, UnknownName
from common.remapping import Remapping, validate_table
from services import camera_opencv, vision_detector

TWO = ["services={motion_planner: {}, "
       "left_camera: {service: camera_opencv, camera: left, source: a.avi, topics: {camera/*: left_camera/*}}, "
       "right_camera: {service: camera_opencv, camera: right, source: b.avi, topics: {camera/*: right_camera/*}}, "
       "smart_pick_place: {}}",
       "world.cameras={left: {position: [0.3, 0, 0.8]}, right: {position: [0.6, 0, 0.8], frame: the_right_one}}"]


def cell_of(*services: str) -> list[str]:
    return [f"services={{{', '.join(services)}}}"]


def test_each_has_its_name_its_keys_and_its_parameters() -> None:
    cell = load_cell("panda", TWO)
    assert list(cell.services) == ["motion_planner", "left_camera", "right_camera", "smart_pick_place"]
    left, planner = cell.services["left_camera"], cell.services["motion_planner"]
    assert (left.name, left.kind, left.module) == ("left_camera", "camera_opencv", "services.camera_opencv")
    assert left.topics == {"camera/*": "left_camera/*"} and "topics" not in left.parameters
    assert left.name_option == ["--name", "left_camera"] and planner.name_option == []
    cell = load_cell("panda", [*TWO, "services.left_camera.rate=5", "services.right_camera.topics={camera/*: r/*}"])
    configs = [service_config(cell, name, camera_opencv.Config) for name in ("left_camera", "right_camera")]
    assert [(config.source, config.rate) for config in configs] == [("a.avi", 5.0), ("b.avi", 10.0)]
    assert cell.services["right_camera"].topics == {"camera/*": "r/*"}
    with pytest.raises(UnknownName, match="left_camera"):
        load_cell("panda", [*TWO, "services.camera_opencv.rate=5"])


def test_camera_of_a_service_is_the_one_that_it_chose() -> None:
    cell = load_cell("panda", TWO)
    left, right = (service_config(cell, name, camera_opencv.Config).world for name in ("left_camera", "right_camera"))
    assert (left.camera.position, left.camera.frame) == ((0.3, 0, 0.8), "left_optical_frame")
    assert (right.camera.position, right.camera.frame) == ((0.6, 0, 0.8), "the_right_one")
    assert list(left.cameras) == ["left", "right"]
    assert service_config(cell, "vision_detector", vision_detector.Config).world.camera == left.camera  # the first
    wrong = load_cell("panda", [*TWO, "services.left_camera.camera=middle"])
    with pytest.raises(ConfigError, match=r"services\.left_camera\.camera: 'middle' must be one of left, right"):
        service_config(wrong, "left_camera", camera_opencv.Config)


def test_single_camera_is_set_under_both_names_and_one_of_several_by_a_file(tmp_path: Path) -> None:
    around = load_cell("panda", ["world.camera.fx=500", "world.cameras.camera.fy=510"]).section(Surroundings)
    assert isinstance(around, Surroundings)
    assert (around.camera.fx, around.camera.fy) == (500, 510) and around.cameras == {"camera": around.camera}
    assert load_cell("panda", ["world.camera.frame=eye"]).world.camera.frame == "eye"
    file = tmp_path / "left.yaml"
    file.write_text("{width: 64, height: 48, fx: 50, fy: 50, cx: 32, cy: 24, position: [0, 0, 1], rpy: [0, 0, 0]}")
    several = load_cell("panda", [*TWO, f"world.cameras.left={file}"]).world.cameras
    assert (several["left"].width, several["right"].width) == (64, 640)


@pytest.mark.parametrize(("overrides", "reason"), [
    (["world.cameras={}"], r"world\.cameras: "),
    (["world.cameras={a: {}, b: {}}", "world.camera.fx=400"], r"camera is for a world with one: this one has a, b"),
    (["world.cameras={a: {frame: x}, b: {frame: x}}"], r"cameras\.b has the frame of a: x"),
    (["world.cameras={a: {fz: 3}}"], r"world\.cameras\.a\.fz: 3 is not a parameter; choices: cx, cy"),
    (["robot.gripper.cup.radius=1"], r"cup\.radius: 1 is not a parameter; choices: give, lip_radius, vacuum$"),
    (["robot.attachments=[{urdf: a, parent_link: b, xyz: 0}]"], r"\.0\.xyz: .* choices: parent_link, position, rpy"),
    (["world.fixtures=[{id: a, shape: sphere, dimensions: [1, 1], position: [0, 0, 0]}]"], r"1 of dimensions, not 2"),
    (["world.objects=[{id: a, shape: sphere, radius: 0.02, height: 1}]"], r"height has no effect .*; choices: radius$"),
    (["world.objects=[{id: a, shape: sphere, radius: 0.02, x: 0, y: 0, rpy: [1, 0, 0]}]"], r"rpy has no effect on x"),
    (cell_of("a: {service: camera_open}"), r"unknown service 'camera_open' \(did you mean 'camera_opencv'"),
    (cell_of("a: {service: 3}"), r"services\.a\.service: 3 must be a service"),
    (cell_of("my.cam:", "your.cam:"), r"services\.your\.cam: my\.cam has the name cam already.*another_cam"),
    (cell_of("a-b: {service: viewer}"), r"services: 'a-b' is not a valid service name"),
    (cell_of("supervisor: {service: viewer}"), r"services: 'supervisor' is not a valid service name"),
    (cell_of("viewer: {topics: [1]}"), r"services\.viewer\.topics: \[1\] must be a mapping of keys"),
    (cell_of("viewer: {topics: {camera/*: left}}"), r"services\.viewer\.topics: .* must have \* at both ends"),
    (cell_of("viewer: {topics: {camera//a: b}}"), r"services\.viewer\.topics: 'camera//a' is no key such as"),
    (cell_of("viewer: {topics: {'a*b': b}}"), r"services\.viewer\.topics: 'a\*b' is no key"),
    (cell_of("viewer: {topics: {log: b}}"), r"services\.viewer\.topics: 'log' is a key of all services"),
])
def test_invalid_cameras_and_services_are_refused_in_one_line(overrides: list[str], reason: str) -> None:
    with pytest.raises((ConfigError, UnknownName), match=reason) as error:
        load_cell("panda", overrides)
    assert "\n" not in str(error.value)


def test_task_with_another_name_belongs_to_its_application() -> None:
    given = [*cell_of("picker: {service: smart_pick_place}"), "task=picker"]
    for cell in (load_cell("panda", given), load_cell("panda", [*given, "application=pick_place"])):
        assert (cell.task, cell.application) == ("picker", "pick_place")


@pytest.mark.parametrize(("table", "expected"), [
    ({"*": "x/*", "camera/*": "left/*", "tf": "t", "tf_static": "tf_static"},
     {"camera/image_raw": "left/image_raw", "camera/depth/a": "left/depth/a", "tf": "t", "tf_static": "tf_static",
      "motion/plan": "x/motion/plan", "log": "log", "counters": "counters", "param/viewer": "param/viewer"}),
    ({"seen": "left/seen", "other": "left/other"},
     {"seen/mask": "left/seen/mask", "seen": "left/seen", "other/a/b": "other/a/b"}),
], ids=["longest matching prefix, shared keys stay", "keys just below a key"])
def test_key_is_remapped(table: dict[str, str], expected: dict[str, str]) -> None:
    remapping = Remapping(validate_table("topics", table))
    assert {key: remapping.key(key) for key in expected} == expected


def test_unused_remapping_is_reported_with_the_existing_keys() -> None:
    remapping = Remapping({"camra/*": "left/*"})
    assert remapping.key("camera/image_raw") == "camera/image_raw"
    with pytest.raises(ConfigError, match=r"services\.left\.topics: 'camra/\*' .* choices: camera/image_raw"):
        remapping.require_used("left")


def test_page_on_extending_shows_the_cell_that_the_tests_run() -> None:
    root = Path(__file__).resolve().parents[3]
    page = (root / "docs" / "extending.md").read_text(encoding="utf-8")
    chapter = page[page.index("### Several of a kind"):]
    shown = yaml.safe_load(chapter.split("```yaml\n")[1].split("```")[0])
    run = yaml.safe_load((root / "tests" / "data" / "two_cameras.yaml").read_text(encoding="utf-8"))
    assert shown["world"]["cameras"] == run["world"]["cameras"]
    assert shown["services"].items() <= run["services"].items()
