"""`zencell check`: each finding by a cell with exactly this mistake, and none for cells that are as they should be."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from common.config import Cell, load_cell, names_of
from common.errors import ConfigError
from tests.harness import ask
from tools.check import Finding
from tools.check.cell import blocking_errors, check_files, check_model
from tools.check.services import Keys, check_wiring, wiring

ONE = "world.count=1"


def found_in(cell: Cell) -> list[Finding]:
    return [*check_files(cell), *check_model(cell)]


QUICK = [
    ("panda", ["robot.gripper.links=[panda_hand,claw]"], "error", "gripper.links: 'claw' is no link", True),
    ("panda", ["robot.gripper.joints=[panda_finger_joint1,panda_finger_joint7]"], "error",
     "'panda_finger_joint7' is no joint", True),
    ("panda", ["robot.gripper.joints=[panda_joint1]"], "error", "'panda_joint1' is one of robot.joints, too", True),
    ("ur5", ["robot.gripper.linkage=null"], "error", "'robotiq_85_left_knuckle_joint' turns (revolute)", True),
    ("panda", ["robot.gripper.linkage={length: 0.05, open_angle: 0.4, closed: 0.4109}",
               "robot.gripper.max_width=0.04003"], "error", "'panda_finger_joint1' slides (prismatic)", True),
    ("panda", ["robot.gripper.max_width=0.2"], "warning", "would go from 0 to 0.1 m", False),
    ("panda", ["world.camera.position=[2.0,0,0.8]"], "warning", "100 % of the top of table is outside", False),
    ("panda", ["world.camera.position=[2.0,0,0.8]"], "warning", "ball_1 at (0.4, -0.3) is completely outside", False),
    ("panda", ["world.balls=[[0.77,0.0]]"], "warning", "ball_1 at (0.77, 0) is to", False),
    ("panda", ["services.vision_detector.min_contour_area_px=3000"], "error", "ball_1 appears on 1227 px^2", False),
    ("panda", ["world.ball_color=[0,1,0]"], "error", "which no window of vision_detector holds", False),
    ("panda", ["robot.gripper.max_width=0.05"], "error", "ball_1 is 60 mm wide, the fingers open to 50 mm", False),
    ("panda", ["world.container.half_side=0.06"], "error", "box.slot_offset: 0.033 puts balls", False),
    ("panda", ["world.container.half_side=0.03"], "error", "44 mm between the walls", False),
    ("panda", ["world.container.layers=1", "world.count=7"], "warning", "7 objects for 4 places", False),
    ("panda", ["world.objects=[{id: cube, shape: box, size: [0.04,0.04,0.04], x: 0.4, y: -0.29}]"], "error",
     "ball_1 at (0.4, -0.3) and cube at (0.4, -0.29) overlap", False),
    ("panda", ["world.objects=[{id: cube, shape: box, size: [0.04,0.04,0.04], x: 0.47, y: 0.25}]"], "warning",
     "cube at (0.47, 0.25) intersects a wall of box", False),
    ("panda", ["world.objects=[{id: cube, shape: box, size: [0.04,0.04,0.04], x: 0.5, y: 0.7}]"], "warning",
     "cube at (0.5, 0.7) is not on the table", False),
    ("panda", ["world.objects=[{id: cube, shape: box, size: [0.04,0.04,0.04], x: 0.5, y: -0.1}]"], "warning",
     "cube is a box, vision_detector looks for spheres", False),
]
HAND = str(Path(__file__).parents[1] / "data" / "hand_camera.yaml")  # what is seen is seen from home
QUICK += [
    (HAND, ["world.camera.position=[1.06,0,-0.1]"], "warning",
     "ball_1 at (0.4, -0.3) is completely outside of the image from home", False),
    (HAND, ["services.vision_detector.min_contour_area_px=3000"], "error", "ball_1 appears on", False),
]
THOROUGH = [
    ("panda", ["world.balls=[[0.9,0.0]]"], "error", "ball_1 at (0.900, 0.000, 0.030) cannot be taken, too far", False),
    ("panda", ["robot.base_position=[0,0,1.0]"], "error", "cannot be taken", False),
    ("panda", ["world.container.x=1.3"], "error", "containers.box: the tool cannot be above it, at (1.300", False),
    ("panda", ["world.fixtures=[{id: lid, dimensions: [0.3,0.3,0.02], position: [0.4,-0.3,0.12]}]"], "error",
     "would touch lid", False),
    ("panda", ["world.fixtures=[{id: post, dimensions: [0.1,0.1,1.0], position: [0.3,0,0.5]}]"], "error",
     "named_poses.home", True),
    ("panda", ["robot.tcp_link=nonsense"], "error", "robot.tcp_link: 'nonsense' is not a link", True),
    ("panda", ["robot.srdf=/etc/passwd"], "error", "robot.srdf: '/etc/passwd' does not parse", True),
    ("panda", ["robot.named_poses.home=[9,0,0,-2,0,1.5,0]"], "error", "must be within", True),
]


@pytest.mark.parametrize(("name", "overrides", "severity", "what", "is_refused"), QUICK)
def test_mistake_is_told_without_a_model_of_the_robot(name, overrides, severity, what, is_refused):
    cell = load_cell(name, [*([ONE] if name == "panda" else []), *overrides])
    found = [each for each in check_files(cell) if what in each.what]
    assert [(each.severity, each.refused) for each in found[:1]] == [(severity, is_refused)], check_files(cell)
    assert found[0].remedy and "\n" not in found[0].line
    assert bool(blocking_errors(cell)) == is_refused


def test_link_that_a_camera_sits_on_and_that_the_robot_has_not_is_told_with_the_choices():
    assert found_in(load_cell(HAND)) == []
    found = check_files(load_cell(HAND, ["world.camera.mount=hand"]))
    assert [(each.severity, each.refused) for each in found] == [("error", True)]
    assert found[0].what.startswith("world.camera.mount: 'hand' is no link of panda; choices: tcp, panda_link0")
    both = str(Path(HAND).with_name("hand_and_fixed.yaml"))
    (found, *_) = check_files(load_cell(both, ["world.cameras.hand.mount=x"]))
    assert found.what.startswith("world.cameras.hand.mount: 'x' is")
    with pytest.raises(ConfigError, match="needs position and rpy in tcp"):
        load_cell("panda", ["world.camera={mount: tcp}"])


@pytest.mark.parametrize(("name", "overrides", "severity", "what", "is_refused"), THOROUGH)
def test_place_or_pose_that_the_arm_cannot_have_is_told(name, overrides, severity, what, is_refused):
    cell = load_cell(name, [ONE, *overrides])
    found = [each for each in check_model(cell) if what in each.what]
    assert [(each.severity, each.refused) for each in found] == [(severity, is_refused)], [*check_model(cell)]


@pytest.mark.parametrize("overrides", [["world.layout=random", "world.count=8"], []])
@pytest.mark.parametrize("seed", [1, 7, 30])
def test_landed_panda_gives_no_alarm(overrides, seed):
    assert found_in(load_cell("panda", overrides, seed=seed)) == []


@pytest.mark.parametrize("world", [name for name in names_of("worlds") if name != "balls"])
def test_landed_ur5_gives_no_alarm_in_any_of_its_worlds(world):
    assert found_in(load_cell("ur5", world=world)) == []


@pytest.mark.parametrize("name", ["panda", "ur5"])
def test_landed_cells_have_an_owner_for_every_key(name):
    assert list(wiring(load_cell(name))) == []


def test_task_that_is_no_service_of_the_cell_is_told():
    (found,) = wiring(load_cell("panda", ["task=nobody"]))
    assert found.severity == "error" and found.what.startswith("task: 'nobody' is no service of the cell")
    assert "smart_pick_place" in found.remedy


def test_two_writers_and_readers_of_what_nobody_writes_are_told():
    found = list(check_wiring([
        Keys("left", ["image"], ["found"], [], ["motion/plan"]), Keys("right", [], ["found"], ["move"], ["move"]),
        Keys("page", ["anything"], [], [], [], reads_any=True), Keys("log_reader", ["log"], [], [], []),
    ]))
    assert [(each.severity, each.refused, each.what) for each in found] == [
        ("error", True, "services.right: left has found already, and a key is written or served by one service"),
        ("warning", False, "services.left: reads image, which no service of the cell writes"),
        ("warning", False, "services.left: calls motion/plan, which no service of the cell serves"),
    ]


def test_parameter_that_nobody_reads_and_key_that_names_nothing_are_told_once_each(tmp_path):
    done = ask(tmp_path, "check", "panda", "--set", ONE, "--set", "services.vision_detector.speling=3", "--set",
               "services.scene_manager.topics={camra/*: left/camra/*}", "--json")
    found = [json.loads(line) for line in done.stdout.splitlines()]
    assert done.returncode == 1 and all(each["severity"] == "error" and each["refused"] for each in found)
    assert [each["what"].partition(";")[0] for each in found] == [
        "services.vision_detector.speling: 3 is not a parameter",
        "services.scene_manager.topics: 'camra/*' is no key that it reads, writes, serves or calls"]


def test_cell_that_is_well_says_so_and_bad_input_is_one_line(tmp_path):
    done = ask(tmp_path, "check", "panda", "--set", ONE)
    assert (done.returncode, done.stdout) == (0, "panda: no errors, no warnings\n")
    done = ask(tmp_path, "check", "nonsense")
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize("verb", ["run", "up"])
def test_fingers_that_would_move_wrongly_are_refused_before_anything_starts(verb, tmp_path, domain):
    done = ask(tmp_path, verb, "panda", "--set", "robot.gripper.links=[panda_hand,claw]", "--domain", str(domain))
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1
    assert "robot.gripper.links: 'claw' is no link of the description" in done.stderr
