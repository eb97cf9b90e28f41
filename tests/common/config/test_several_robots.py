"""Cell files with several robots: the sections, keys and services of each arm, and what is refused."""

from pathlib import Path

import pytest
import yaml

from common.arms import arm_of, of_arm
from common.config import Arms, Cell, Reach, RobotConfig, Surroundings, load_cell, service_config
from common.errors import ConfigError, UnknownName
from common.supervision.wiring import owned_in, require_one_owner, wiring_of
from common.topics import CAMERA_IMAGE, MOTION_STATUS
from services import motion_planner, trajectory_executor
from tools.check.cell import check_arms, examine

CELL = str(Path(__file__).parents[2] / "data" / "two_arms.yaml")
APART = "robots={left: panda, right: {robot: panda, base_position: [0, 1, 0]}}"


def edited(folder: Path, **changes: object) -> str:
    tree = yaml.safe_load(Path(CELL).read_text()) | changes
    (folder / "cell.yaml").write_text(yaml.safe_dump({key: value for key, value in tree.items() if value is not None},
                                                     sort_keys=False))
    return str(folder / "cell.yaml")


def test_each_arm_has_its_robot_its_services_and_its_nearest_container() -> None:
    cell = load_cell(CELL, ["services.right_workspace_validator.max_radius=0.6"])
    assert list(cell.robots) == ["left", "right"] and cell.robot == cell.robots["left"]
    assert cell.services["right_motion_planner"].arm == "right" and cell.services["trajectory_executor"].arm == ""
    planner = service_config(cell, "right_motion_planner", motion_planner.Config)
    assert planner.robot.base_position == (0.0, -0.45, 0.0)
    around = {arm: cell.section(Surroundings, arm=arm) for arm in cell.robots}
    assert [one.container.id for one in around.values()] == ["box_left", "box_right"]
    reach = cell.section(Reach)
    assert isinstance(reach, Reach)
    assert reach.of("left")["left_workspace_validator"] == {"max_radius": 0.55}
    assert "right_workspace_validator" not in reach.of("left") and "vision_detector" in reach.of("left")
    assert cell.arms.tasks == {"left": "left_smart_pick_place", "right": "right_smart_pick_place"}
    assert cell.task == "arm_tasks"
    assert service_config(cell, "trajectory_executor", trajectory_executor.Config).arms == Arms(
        robots=cell.robots, tasks=cell.arms.tasks)


def test_parameters_below_the_name_of_an_arm_are_of_that_arm_alone(tmp_path: Path) -> None:
    cell = load_cell(edited(tmp_path, services={"motion_planner": {"each": "arm", "right": {"time": 3}, "x": 1}}))
    assert [entry.parameters for entry in cell.services.values()] == [{"x": 1}, {"x": 1, "time": 3}]


def test_override_of_a_service_that_each_arm_has_is_one_for_each() -> None:
    cell = load_cell(CELL, ["services.workspace_validator.max_radius=0.5", "services.left_workspace_validator.x=1"])
    assert cell.services["right_workspace_validator"].parameters == {"max_radius": 0.5}
    assert cell.services["left_workspace_validator"].parameters == {"max_radius": 0.5, "x": 1}
    with pytest.raises(UnknownName, match="left_workspace_validator"):
        load_cell(CELL, ["services.validator.max_radius=0.5"])


def test_smallest_cell_of_two_arms_passes_every_check() -> None:
    assert list(examine(load_cell(str(Path(__file__).parents[3] / "examples" / "two_arms.yaml")))) == []


async def test_keys_of_arms_are_below_their_names_and_have_one_owner() -> None:
    cell = load_cell(CELL)
    wirings = {entry.name: await wiring_of(cell, entry) for entry in cell.services.values()}
    require_one_owner(wirings)
    owned = {key: services for key, (_, services) in owned_in(wirings).items()}
    for arm in cell.robots:
        assert owned[f"{arm}/motion/execute"] == owned[f"{arm}/joint_states"] == ["trajectory_executor"]
        assert owned[f"{arm}/planning_scene"] == [f"{arm}_scene_manager"]
        assert owned[f"{arm}/pick_place_status"] == [f"{arm}_smart_pick_place"]
    assert owned["scene_objects"] == owned["world/edit"] == ["trajectory_executor"]
    assert owned["pick_place_status"] == owned["task/command"] == ["arm_tasks"]
    assert "motion/status" not in owned and "joint_states" not in owned
    assert of_arm(MOTION_STATUS, "left").key == "left/motion/status" and of_arm(CAMERA_IMAGE, "left") is CAMERA_IMAGE
    assert (arm_of("left/tf", cell.robots), arm_of("camera/image_raw", cell.robots)) == ("left", "")


def test_value_of_a_service_of_each_arm_is_set_for_one_arm_or_all() -> None:
    cell = load_cell("handover", ["services.hander.left.meeting_speed=0.05", "services.hander.back_off=0.15"])
    given = {arm: cell.services[f"{arm}_hander"].parameters for arm in cell.robots}
    assert {arm: each.get("meeting_speed") for arm, each in given.items()} == {"left": 0.05, "right": None}
    assert {each["back_off"] for each in given.values()} == {0.15}


@pytest.mark.parametrize(("override", "error"), [
    ("robots={left: panda, right: panda}", r"robots\.right\.base_position: .* is 0\.000 m from the base of left"),
    ("robots={left: pandas}", "unknown robot 'pandas' .did you mean 'panda'"),
    ("robots={motion: panda}", "robots: 'motion' is the first part of other keys already"),
    ("robots={a-b: panda}", "robots: 'a-b' is no name of an arm"),
    ("robots=[panda]", r"robots: \['panda'\] must be a mapping of arms"),
    ("robots={left: 3}", r"robots\.left: 3 must be a name or a mapping; choices: fr3, panda, ur5"),
    ("robot=panda", "robot: and robots are given"),
    ("robots.left=NAME", "unknown robot 'NAME'; choices: fr3, panda"),
    ("robots.left=3", r"robots\.left: 3 must be a name or a mapping; choices: fr3, panda"),
    ("robots.left={robot: panda, nonsense: 1}", r"robots\.left\.nonsense: 1 is not a parameter"),
    ("robots.lefty=panda", "unknown arm 'lefty' .did you mean 'left'"),
    ("robots.right.base_position=[0, 0.40, 0]", r"robots\.right\.base_position: .* is 0\.050 m from the base of left"),
    ("robots.right.joints=[]", r"robots\.right\.joints: "),
])
def test_robots_that_do_not_fit_are_refused_in_one_line(override: str, error: str) -> None:
    with pytest.raises((ConfigError, UnknownName), match=error):
        load_cell(CELL, [override])


@pytest.mark.parametrize(("services", "error"), [
    ({"motion_planner": {"arm": "middle"}}, r"services\.motion_planner\.arm: 'middle' is no arm of this cell; choices: "
                                            "left, right"),
    ({"motion_planner": {"each": "robot"}}, r"services\.motion_planner\.each: 'robot' must be arm"),
    ({"motion_planner": {"each": "arm", "left": 3}}, r"services\.motion_planner\.left: 3 must be a mapping"),
    ({"motion_planner": {"each": "arm", "arm": "left"}}, "has each and arm"),
    ({"motion_planner": {"each": "arm"}, "left_motion_planner": {"service": "motion_planner", "arm": "left"}},
     r"services\.left_motion_planner: is listed twice"),
])
def test_services_that_do_not_fit_the_arms_are_refused_in_one_line(
    tmp_path: Path, services: object, error: str
) -> None:
    with pytest.raises(ConfigError, match=error):
        load_cell(edited(tmp_path, services=services))


def test_service_of_one_robot_has_to_say_of_which(tmp_path: Path) -> None:
    cell = load_cell(edited(tmp_path, services={"motion_planner": {}}))
    with pytest.raises(ConfigError, match=r"motion_planner needs one robot, and the cell has left, right: add `each"):
        service_config(cell, "motion_planner", motion_planner.Config)


@pytest.mark.parametrize(("services", "expected"), [
    ({"trajectory_executor": {}}, []),
    ({"trajectory_executor": {"arm": "left"}}, ["robots.right: no trajectory_executor drives it"]),
    ({"trajectory_executor": {}, "second": {"service": "trajectory_executor", "arm": "right"}},
     ["services.second: drives right, as trajectory_executor does"]),
])
def test_every_arm_has_one_executor(tmp_path: Path, services: object, expected: list[str]) -> None:
    assert [found.what for found in check_arms(load_cell(edited(tmp_path, services=services)))] == expected


def test_two_arms_at_one_address_are_refused() -> None:
    device = "{{backend: ur, options: {{host: 192.0.2.5, model: ur5e}}}}"
    real = f"{{{{robot: ur5, base_position: [0, {{y}}, 0], hardware: {device}}}}}"
    cell = load_cell(CELL, [f"robots={{left: {real.format(y=0)}, right: {real.format(y=1)}}}"])
    assert any("which left is already" in found.what for found in check_arms(cell))


def test_cell_with_one_robot_keeps_services_with_a_parameter_named_arm() -> None:
    cell = load_cell("panda", ["services={motion_planner: {arm: x, each: y}}"])
    assert isinstance(cell, Cell) and cell.services["motion_planner"].parameters == {"arm": "x", "each": "y"}
    assert cell.robots == {} and cell.tables == [] and isinstance(cell.section(RobotConfig), RobotConfig)
