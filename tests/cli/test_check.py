"""`zencell check`: each finding by a cell with exactly this mistake, and none for the cells of the project."""

import json
from pathlib import Path

import pytest

from common.config import Cell, load_cell, names_of
from common.errors import ConfigError
from tests.harness import ask
from tools.check.cell import Keys, blocking_errors, check_files, check_model, check_wiring, wiring

HAND = str(Path(__file__).parents[1] / "data" / "hand_camera.yaml")  # what is seen is seen from home
ONE = "world.count=1"
CUBE = "world.objects=[{id: cube, shape: box, size: [0.04,0.04,0.04], x: %s, y: %s}]"
# Cell, overrides, severity, part of the finding; a rejected cell does not start.
QUICK = [
    ("panda", "robot.gripper.links=[panda_hand,claw]", "rejected", "gripper.links: 'claw' is no link"),
    ("panda", "robot.gripper.joints=[panda_finger_joint1,panda_finger_joint7]", "rejected",
     "'panda_finger_joint7' is no joint"),
    ("panda", "robot.gripper.joints=[panda_joint1]", "rejected", "'panda_joint1' is one of robot.joints, too"),
    ("ur5", "robot.gripper.linkage=null", "rejected", "'robotiq_85_left_knuckle_joint' turns (revolute)"),
    ("panda", "robot.gripper.linkage={length: 0.05, open_angle: 0.4, closed: 0.4109}; robot.gripper.max_width=0.04003",
     "rejected", "'panda_finger_joint1' slides (prismatic)"),
    ("panda", "robot.gripper.max_width=0.2", "warning", "would go from 0 to 0.1 m"),
    ("panda", "world.camera.position=[2.0,0,0.8]", "warning", "100 % of the top of table is outside"),
    ("panda", "world.camera.position=[2.0,0,0.8]", "warning", "ball_1 at (0.4, -0.3) is completely outside"),
    ("panda", "world.balls=[[0.77,0.0]]", "warning", "ball_1 at (0.77, 0) is to"),
    ("panda", "services.vision_detector.min_contour_area_px=3000", "error", "ball_1 appears on 1227 px^2"),
    ("panda", "world.ball_color=[0,1,0]", "error", "which no window of vision_detector holds"),
    ("panda", "robot.gripper.max_width=0.05", "error", "ball_1 is 60 mm wide, the fingers open to 50 mm"),
    ("panda", "world.container.half_side=0.06", "error", "box.slot_offset: 0.033 puts balls"),
    ("panda", "world.container.half_side=0.03", "error", "44 mm between the walls"),
    ("panda", "world.container.layers=1; world.count=7", "warning", "7 objects for 4 places"),
    ("panda", CUBE % (0.4, -0.29), "error", "ball_1 at (0.4, -0.3) and cube at (0.4, -0.29) overlap"),
    ("panda", CUBE % (0.47, 0.25), "warning", "cube at (0.47, 0.25) intersects a wall of box"),
    ("panda", CUBE % (0.5, 0.7), "warning", "cube at (0.5, 0.7) is not on the table"),
    ("panda", CUBE % (0.5, -0.1), "warning", "cube is a box, vision_detector looks for spheres"),
    (HAND, "world.camera.position=[1.06,0,-0.1]", "warning",
     "ball_1 at (0.4, -0.3) is completely outside of the image from home"),
    (HAND, "services.vision_detector.min_contour_area_px=3000", "error", "ball_1 appears on"),
]
THOROUGH = [
    ("panda", "world.balls=[[0.9,0.0]]", "error", "ball_1 at (0.900, 0.000, 0.030) cannot be taken, too far"),
    ("panda", "robot.base_position=[0,0,1.0]", "error", "cannot be taken"),
    ("panda", "world.container.x=1.3", "error", "containers.box: the tool cannot be above it, at (1.300"),
    ("panda", "world.fixtures=[{id: lid, dimensions: [0.3,0.3,0.02], position: [0.4,-0.3,0.12]}]", "error",
     "would touch lid"),
    ("panda", "world.fixtures=[{id: post, dimensions: [0.1,0.1,1.0], position: [0.3,0,0.5]}]", "rejected",
     "named_poses.home"),
    ("panda", "robot.flange_link=panda_link3", "rejected", "robot.flange_link: 'panda_link3' is no link that moves"),
    ("panda", "robot.tcp_link=nonsense", "rejected", "robot.tcp_link: 'nonsense' is not a link"),
    ("panda", "robot.srdf=/etc/passwd", "rejected", "robot.srdf: '/etc/passwd' does not parse"),
    ("panda", "robot.named_poses.home=[9,0,0,-2,0,1.5,0]", "rejected", "must be within"),
]


def cell_with(name: str, overrides: str) -> Cell:
    return load_cell(name, [*([ONE] if name == "panda" else []), *overrides.split("; ")])


@pytest.mark.parametrize(("name", "overrides", "severity", "what"), QUICK)
def test_mistake_is_found_without_a_model_of_the_robot(name, overrides, severity, what):
    cell = cell_with(name, overrides)
    found = [each for each in check_files(cell) if what in each.what]
    assert found, check_files(cell)
    assert ("rejected" if found[0].refused else found[0].severity) == severity
    assert found[0].severity == ("error" if severity == "rejected" else severity)
    assert found[0].remedy and "\n" not in found[0].line
    assert bool(blocking_errors(cell)) == (severity == "rejected")


@pytest.mark.parametrize(("name", "overrides", "severity", "what"), THOROUGH)
def test_unreachable_place_or_pose_is_found(name, overrides, severity, what):
    cell = cell_with(name, overrides)
    findings = [*check_model(cell)]
    found = [(each.severity, each.refused) for each in findings if what in each.what]
    assert found == [("error", severity == "rejected")], findings


@pytest.mark.parametrize(("name", "override", "what"), [
    ("conveyor", "services.belt_picker.window=[1.4,0.5]",
     "services.belt_picker.window: [1.4, 0.5] must increase within the belt, 0 to 1.6"),
    ("handover", "services.hander.left.gives_to=rigt",
     "services.left_hander.gives_to: 'rigt' and takes_from: one of both must name another arm; choices: right"),
    ("handover", "services.hander.left.gives_to=left",
     "services.left_hander.gives_to: 'left' and takes_from: one of both must name another arm; choices: right"),
])
def test_values_that_do_not_fit_each_other_are_refused_as_at_the_start(name, override, what):
    (found,) = wiring(load_cell(name, [override]))
    assert (found.severity, found.refused, found.what) == ("error", True, what)


def test_unknown_link_of_a_camera_is_rejected_with_the_choices():
    found = check_files(load_cell(HAND, ["world.camera.mount=hand"]))
    assert [(each.severity, each.refused) for each in found] == [("error", True)]
    assert found[0].what.startswith("world.camera.mount: 'hand' is no link of panda; choices: tcp, panda_link0")
    both = str(Path(HAND).with_name("hand_and_fixed.yaml"))
    (found, *_) = check_files(load_cell(both, ["world.cameras.hand.mount=x"]))
    assert found.what.startswith("world.cameras.hand.mount: 'x' is")
    with pytest.raises(ConfigError, match="needs position and rpy in tcp"):
        load_cell("panda", ["world.camera={mount: tcp}"])


@pytest.mark.parametrize(("name", "options"), [
    (HAND, {}), ("conveyor", {}), ("panda", {"seed": 1}),
    ("panda", {"overrides": ["world.layout=random", "world.count=8"], "seed": 7}),
    *(pytest.param("ur5", {"world": world}, marks=[pytest.mark.slow] if world > "w2" else [])
      for world in names_of("worlds") if world != "balls")])
def test_cells_of_the_project_have_no_findings(name, options):
    cell = load_cell(name, **options)
    assert [*check_files(cell), *check_model(cell), *wiring(cell)] == []


def test_task_must_be_a_service_of_the_cell():
    (found,) = wiring(load_cell("panda", ["task=no_such"]))
    assert found.severity == "error" and found.what.startswith("task: 'no_such' is no service of the cell")
    assert "smart_pick_place" in found.remedy


def test_service_without_the_status_of_a_task_is_no_task_and_a_cell_needs_none():
    (found,) = wiring(load_cell("panda", ["task=vision_detector", "application=pick_place"]))
    assert (found.what, found.severity) == (
        "task: vision_detector publishes no status of a task, so that a run never ends", "error")
    assert list(wiring(load_cell("panda", ["task=", "application="]))) == []


def test_second_writer_and_missing_writers_and_servers_are_found():
    found = list(check_wiring([
        Keys("left", ["image"], ["found"], [], ["motion/plan"]), Keys("right", [], ["found"], ["move"], ["move"]),
        Keys("page", ["anything"], [], [], [], reads_any=True), Keys("log_reader", ["log"], [], [], []),
    ]))
    assert [(each.severity, each.refused, each.what) for each in found] == [
        ("error", True, "services.right: left has found already, and a key is written or served by one service"),
        ("warning", False, "services.left: reads image, which no service of the cell writes"),
        ("warning", False, "services.left: calls motion/plan, which no service of the cell serves"),
    ]


def test_object_fits_the_fingers_where_it_is_thin(tmp_path):
    bars = ((0.14, 0.024, 0.0), (0.03, 0.12, 0.085))  # a hammer: handle and head along x and y, center of x [m]
    corners = [(c + i * x / 2, j * y / 2, z) for x, y, c in bars for i in (-1, 1) for j in (-1, 1) for z in (0, 0.03)]
    faces = [(a + n, b + n, c + n) for n in (1, 9) for a, b, c in (
        (0, 1, 2), (1, 2, 3), (4, 5, 6), (5, 6, 7), (0, 1, 4), (1, 4, 5), (2, 3, 6), (3, 6, 7), (0, 2, 4), (2, 4, 6),
        (1, 3, 5), (3, 5, 7))]
    lines = [f"v {x} {y} {z}" for x, y, z in corners] + [f"f {a} {b} {c}" for a, b, c in faces]
    (tmp_path / "hammer.obj").write_text("\n".join(lines))
    for scale, fits in ((1, True), (4, False)):
        thing = f"{{id: hammer, shape: mesh, mesh: {tmp_path}/hammer.obj, scale: {scale}, x: 0.45, y: -0.1}}"
        found = check_files(load_cell("panda", ["world.balls=[[0.4, 0.3]]", f"world.objects=[{thing}]"]))
        assert any("the fingers open to 80 mm" in each.what for each in found) != fits


def test_section_of_the_cell_below_a_service_is_rejected_and_jogging_needs_no_writer(tmp_path):
    cell = load_cell("panda", ["services.motion_planner.robot={base_position: [1, 0, 0]}"])
    (found,) = (each for each in wiring(cell) if each.refused)
    assert found.what.endswith("is a section of the cell, no parameter of a service; choices: helpers, points, watch")
    keys = "services.trajectory_executor.topics={motion/jog: arm/jog}"
    assert not [each for each in wiring(load_cell("panda", [keys])) if "jog" in each.what]


def test_check_lists_unknown_parameters_and_keys_once(tmp_path):
    done = ask(tmp_path, "check", "panda", "--set", ONE, "--set", "services.vision_detector.speling=3", "--set",
               "services.scene_manager.topics={camra/*: left/camra/*}", "--json")
    found = [json.loads(line) for line in done.stdout.splitlines()]
    assert done.returncode == 1 and all(each["severity"] == "error" and each["refused"] for each in found)
    assert [each["what"].partition(";")[0] for each in found] == [
        "services.vision_detector.speling: 3 is not a parameter",
        "services.scene_manager.topics: 'camra/*' is no key that it reads, writes, serves or calls"]
    done = ask(tmp_path, "check", "panda", "--set", ONE)
    assert (done.returncode, done.stdout) == (0, "panda: no errors, no warnings\n")


@pytest.mark.parametrize("verb", ["run", "up"])
def test_rejected_cell_does_not_start(verb, rejection, domain):
    line = rejection(verb, "panda", "--set", "robot.gripper.links=[panda_hand,claw]", "--domain", str(domain))
    assert "robot.gripper.links: 'claw' is no link of the description" in line
