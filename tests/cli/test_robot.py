"""`zencell robot`: a robot file from a URDF alone and a cell that picks with it, its check, and its collision pairs."""

import io
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml

from common.config import RobotConfig, check, config_root, load_cell, read_robot
from common.planning.robot_geometry import RobotGeometry
from common.robot.model import RobotModel
from lab.simulation import Simulation
from tests.harness import ROOT, ask
from tests.small_arms import nodding, scara, six
from tools.robot_setup.fingers import check_tool_frame

URDF = ROOT / "tests" / "data" / "side_arm.urdf"
TEXT = URDF.read_text()
NO_ARM = '<robot name="post"><link name="a"/><link name="b"/><joint name="j" type="fixed">' \
         '<parent link="a"/><child link="b"/></joint></robot>'
CHAIN = '<robot name="chain">' + "".join(f'<link name="l{i}"/>' for i in range(40)) + "".join(
    f'<joint name="j{i}" type="continuous"><parent link="l{i}"/><child link="l{i + 1}"/></joint>' for i in range(39)
) + "</robot>"
NO_MESH = NO_ARM.replace('<link name="b"/>', '<link name="b"><collision><geometry><mesh filename="package://gone/b.stl"/>'
                                             '</geometry></collision></link>')


def with_shape(shape: str) -> str:
    return TEXT.replace('<box size="0.04 0.05 0.11"/>', shape)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with the files of a new robot."""
    folder = tmp_path_factory.mktemp("new")
    (folder / "side_arm.urdf").write_text(TEXT)
    done = ask(folder, "robot", "new", "side_arm.urdf", "--yes", "--name", "side", "--cell", "side_cell.yaml")
    assert done.returncode == 0, done.stderr
    (folder / "output.txt").write_text(done.stdout)
    return folder


def test_tool_frame_and_home_pose_suit_the_hand(folder):
    robot = RobotModel.load(check(RobotConfig, read_robot(folder / "side.yaml"), "robot"))
    assert robot.config.base_link == "foot"
    assert robot.config.joints == ["turn", "lift", "bend", "roll", "pitch", "spin"]
    assert robot.config.gripper.closing_axis == "y"
    assert robot.config.gripper.max_width == pytest.approx(0.08)
    assert check_tool_frame(robot) == []
    home = robot.named("home")
    poses = robot.link_poses(home)
    T_flange_tcp = np.linalg.inv(poses["flange"]) @ poses[robot.config.tcp_link]
    assert T_flange_tcp[:3, 2] == pytest.approx([1, 0, 0], abs=1e-5)  # no link of the URDF points that way
    assert T_flange_tcp[:3, 3] == pytest.approx([0.10, 0, 0], abs=1e-4)  # a centimetre behind the tips
    T_world_tcp = robot.fk(home)
    assert T_world_tcp[2, 2] == pytest.approx(-1, abs=1e-3), "the tool points down"
    assert T_world_tcp[0, 3] > 0.15 and abs(T_world_tcp[1, 3]) < 0.02, "in front of the base"
    assert np.all(np.minimum(home - robot.lower, robot.upper - home) > 0.1)


def test_guessed_limits_are_marked(folder):
    text, values = (folder / "side.yaml").read_text(), yaml.safe_load((folder / "side.yaml").read_text())
    assert values["position_limits"][0] == pytest.approx([-np.pi, np.pi])
    assert values["velocity_limits"] == [2, 2, 2, 3, 3, 1]
    assert values["acceleration_limits"] == [4, 4, 4, 6, 6, 2]
    assert values["jerk_limits"] == [80, 80, 80, 120, 120, 40]
    for field in ("velocity_limits", "acceleration_limits", "jerk_limits"):
        before = text[: text.index(f"\n{field}:")].rsplit("\n", 1)[-1]
        assert before.startswith("# GUESSED"), field
    output = (folder / "output.txt").read_text()
    assert "guessed: velocity_limits of spin" in output
    assert "next: zencell robot check side.yaml" in output and "zencell run side_cell.yaml" in output
    assert "zencell up side_cell.yaml --set autostart=false" in output


def test_check_compares_the_tool_with_the_fingers(folder):
    done = ask(folder, "robot", "check", "side.yaml")
    assert (done.returncode, done.stderr) == (0, "") and "fingers close along its y" in done.stdout
    (folder / "undrawn.urdf").write_text(TEXT.replace(
        '<link name="foot">', '<link name="foot"><visual><geometry><mesh filename="gone.dae"/></geometry></visual>'))
    (folder / "undrawn.yaml").write_text((folder / "side.yaml").read_text().replace("side_arm.urdf", "undrawn.urdf"))
    done = ask(folder, "robot", "check", "undrawn.yaml")
    assert done.returncode == 0 and "mesh gone.dae is missing: the link is drawn" in done.stdout
    (folder / "wrong.yaml").write_text((folder / "side.yaml").read_text().replace("closing_axis: y", "closing_axis: x"))
    done = ask(folder, "robot", "check", "wrong.yaml")
    assert done.returncode == 1
    assert done.stdout.splitlines() == ["gripper.closing_axis: the fingers close along y of side_tcp, not along x"]
    values = yaml.safe_load((folder / "side.yaml").read_text())
    del values["tcp"]
    (folder / "bare.yaml").write_text(yaml.safe_dump(values | {"tcp_link": "flange"}))
    done = ask(folder, "robot", "check", "bare.yaml")
    assert done.returncode == 1
    assert "z of flange must point from the palm to the tips of the fingers, which is x" in done.stdout


JAW = '<link name="lower_jaw">', '<link name="upper_jaw">'
WRIST = '<joint name="bend"', '<joint name="pitch"'


def new_robot(folder: Path, text: str, *options: str) -> tuple[list[str], RobotConfig]:
    """Return the lines of `zencell robot new` that begin with check or lost, and the robot file."""
    (folder / "arm.urdf").write_text(text)
    done = ask(folder, "robot", "new", "arm.urdf", "--yes", "--name", "r", "--force", *options)
    assert done.returncode == 0, done.stderr
    lines = [line for line in done.stdout.splitlines() if line.startswith(("check:", "lost:"))]
    return lines, check(RobotConfig, read_robot(folder / "r.yaml"), "robot")


def test_links_without_collision_shapes_collide_with_their_visuals(tmp_path):
    lines, config = new_robot(tmp_path, re.sub("(</?)collision>", r"\1visual>", TEXT))
    links = ["foot", "shoulder", "upper", "fore", "wrist", "flange", "upper_finger", "lower_finger"]
    assert config.visual_as_collision == links
    assert any(f"no collision shape: {', '.join(links)}; they collide" in line for line in lines), lines
    geometry = RobotGeometry(RobotModel.load(config))
    assert sorted(geometry.links) == sorted(links) and geometry.geometry.collisionPairs
    assert "visual_as_collision" not in ask(tmp_path, "robot", "check", "r.yaml").stdout
    (tmp_path / "r.yaml").write_text(re.sub("(?m)^visual_as.*$", "", (tmp_path / "r.yaml").read_text()))
    assert "check: links with a visual and no collision shape: foot" in ask(tmp_path, "robot", "check", "r.yaml").stdout


def test_sizes_and_limits_that_cannot_be_right_are_named(tmp_path):
    text = TEXT.replace('upper="2.6"', 'upper="150"').replace('velocity="3"', 'velocity="180"')
    text = text.replace('"0.3 0 0"', '"12 0 0"')
    lines, _ = new_robot(tmp_path, text.replace('<box size="0.04 0.05 0.11"/>', '<box size="0.04 50 0.11"/>'))
    for words in ("limits of bend", "150, look like degrees", "velocity limit of", "0.04 x 50 x 0.11 m large",
                  "check: the arm reaches 12"):
        assert any(words in line for line in lines), (words, lines)
    done = ask(tmp_path, "robot", "check", "r.yaml")
    assert done.returncode == 1 and "0.04 x 50 x 0.11 m large" in done.stdout


def test_joint_of_the_arm_that_follows_another_is_refused(tmp_path, monkeypatch, rejection):
    monkeypatch.chdir(tmp_path)
    Path("arm.urdf").write_text(TEXT.replace('<child link="fore"/>', '<child link="fore"/><mimic joint="lift"/>'))
    assert "'bend' follows lift" in rejection("robot", "new", "arm.urdf", "--yes", "--name", "r")


def test_joint_and_link_may_have_one_name(tmp_path):
    _, config = new_robot(tmp_path, TEXT.replace('name="spin"', 'name="foot"').replace('name="roll"', 'name="wrist"'))
    assert config.joints == ["turn", "lift", "bend", "wrist", "pitch", "foot"]
    robot = RobotModel.load(config)
    plain = RobotModel.load(new_robot(tmp_path, TEXT)[1])
    home = plain.named("home")
    assert {link: pose.tolist() for link, pose in robot.link_poses(home).items()} == {
        link: pose.tolist() for link, pose in plain.link_poses(home).items()}
    assert RobotGeometry(robot).links == RobotGeometry(plain).links


def test_allowed_pairs_are_written_checked_and_not_planned_around(tmp_path, monkeypatch, rejection):
    _, config = new_robot(tmp_path, TEXT, "--allow-pair", "foot", "fore", "--allow-pair", "foot", "flange")
    assert config.allowed_pairs == [("foot", "fore"), ("foot", "flange")]
    geometry = RobotGeometry(RobotModel.load(config))
    pairs = [{geometry.links[pair.first], geometry.links[pair.second]} for pair in geometry.geometry.collisionPairs]
    assert {"foot", "fore"} not in pairs and {"foot", "wrist"} in pairs
    assert "not checked: foot and fore: allowed_pairs" in ask(tmp_path, "robot", "check", "r.yaml").stdout
    monkeypatch.chdir(tmp_path)
    line = rejection("robot", "new", "arm.urdf", "--yes", "--name", "s", "--allow-pair", "foot", "nose")
    assert "robot.allowed_pairs: 'nose' is not a link; choices: foot" in line


def test_files_are_overwritten_only_on_request(folder):
    before = (folder / "side.yaml").read_text()
    done = ask(folder, "robot", "new", "side_arm.urdf", "--yes", "--name", "side")
    assert done.returncode == 2
    assert done.stderr.splitlines() == ["zencell: --out: 'side.yaml' is there already; --force overwrites it"]
    assert (folder / "side.yaml").read_text() == before


def test_name_is_asked_for_with_a_guess(folder, monkeypatch):
    monkeypatch.setattr("sys.stdin", io.StringIO("\n"))
    done = ask(folder, "robot", "new", "side_arm.urdf")
    assert done.returncode == 0, done.stderr
    assert "name of the robot [side_arm]" in done.stdout
    assert yaml.safe_load((folder / "side_arm.yaml").read_text())["name"] == "side_arm"
    monkeypatch.setattr("sys.stdin", io.StringIO(""))
    done = ask(folder, "robot", "new", "side_arm.urdf", "--force")
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1] == "zencell: --yes: is needed without a terminal: it takes the best guesses"


def test_xacro_file_of_a_package_needs_no_ros(tmp_path):
    package = tmp_path / "clone"
    package.mkdir()
    (package / "package.xml").write_text("<package><name>side_description</name></package>")
    macro = TEXT.replace('<robot name="side arm">', '<xacro:macro name="side" params="speed">') \
        .replace("</robot>", "</xacro:macro>").replace('velocity="3"', 'velocity="${speed / 2}"') \
        .replace('<box size="0.04 0.05 0.11"/>', '<mesh filename="file://$(find side_description)/hand.stl"/>')
    head = '<robot name="x" xmlns:xacro="http://www.ros.org/wiki/xacro">'
    (package / "parts.xacro").write_text(f"{head}{macro[macro.index('<xacro'):]}</robot>")
    (package / "hand.stl").write_bytes(trimesh.creation.box((0.04, 0.05, 0.11)).export(file_type="stl"))
    (package / "arm.urdf.xacro").write_text(
        f'{head}<xacro:include filename="$(find side_description)/parts.xacro"/>'
        '<xacro:side speed="$(arg speed)"/></robot>')
    new = ("robot", "new", "clone/arm.urdf.xacro", "--yes")
    done = ask(tmp_path, *new, "speed:=5")
    assert done.returncode == 0, done.stderr
    values = yaml.safe_load((tmp_path / "x.yaml").read_text())
    assert values["velocity_limits"] == [2, 2, 2, 2.5, 2.5, 1]
    assert (values["urdf"], values["package_dirs"]) == ("x.urdf", ["clone"])
    assert "package://side_description/hand.stl" in (tmp_path / "x.urdf").read_text()
    assert ask(tmp_path, "robot", "check", "x.yaml").returncode == 0
    for arguments, wanted in ((["speed:=5"], "is there already; --force"),
                              ([], "needs the argument speed: give speed:="),
                              (["sped:=5", "speed:=5"], "choices: speed"), (["speed=5"], "must be name:=value")):
        done = ask(tmp_path, *new, *arguments)
        assert done.returncode == 2 and wanted in done.stderr and len(done.stderr.splitlines()) == 1, done.stderr


def test_maker_s_srdf_gives_pairs_group_and_poses(folder, tmp_path):
    joints = ["turn", "lift", "bend", "roll", "pitch", "spin"]
    poses = yaml.safe_load((folder / "side.yaml").read_text())["named_poses"]
    home = [round(value + 0.01, 4) for value in poses["home"]]

    def state(name: str, values: list[float]) -> str:
        inside = "".join(f'<joint name="{joint}" value="{value}"/>'
                         for joint, value in zip(joints, values, strict=False))
        return f'<group_state name="{name}" group="arm">{inside}</group_state>'

    def maker(*states: str) -> None:
        (tmp_path / "maker.srdf").write_text(
            '<robot name="side"><group name="short"><joint name="turn"/></group><group name="arm"><group name="inner"/>'
            '</group><group name="inner"><chain base_link="foot" tip_link="flange"/></group>'
            '<group name="loop"><group name="loop"/></group>' + "".join(states)
            + '<disable_collisions link1="foot" link2="upper_finger"/>'
            '<disable_collisions link1="foot" link2="gone"/></robot>')

    new = ("robot", "new", str(URDF), "--srdf", "maker.srdf", "--yes", "--force", "--name", "side")
    maker(state("home", home), state("far", [9.0] * 6), state("part", [0.1]), state("bent: 0 #", [0.1] * 6))
    done = ask(tmp_path, *new)
    assert done.returncode == 0, done.stderr
    values = yaml.safe_load((tmp_path / "side.yaml").read_text())
    assert (values["joints"], values["named_poses"]) == (joints, {"home": home, "bent: 0 #": [0.1] * 6})
    for line in ("the SRDF names links that the URDF lacks: gone", "pose far of the SRDF is left out",
                 "group arm of the SRDF is the arm; --group selects inner"):
        assert line in done.stdout
    assert 'link1="foot" link2="upper_finger"' in (tmp_path / "side.srdf").read_text()
    maker(state("home", [0.1] * 6))
    done = ask(tmp_path, *new, "--group", "arm")
    values = yaml.safe_load((tmp_path / "side.yaml").read_text())
    assert values["named_poses"]["maker_home"] == [0.1] * 6 != values["named_poses"]["home"]
    for options, wanted in ((["--group", "legs"], "choices: arm, inner"), (["--srdf", str(URDF)], "--srdf")):
        done = ask(tmp_path, *new, *options)
        assert done.returncode == 2 and wanted in done.stderr and len(done.stderr.splitlines()) == 1, done.stderr


@pytest.mark.parametrize(("text", "options", "wanted"), [
    (None, "", ["bad.urdf", "is missing"]),
    ("joint: 1", "", ["bad.urdf", "does not parse"]),
    ("<sdf/>", "", ["its root is <sdf>"]),
    (NO_MESH, "", ["package://gone/b.stl", "--package-dir"]),
    (with_shape('<mesh filename="bad.urdf"/>'), "", ["a mesh that cannot be read"]),
    (with_shape('<mesh filename="a.stl" scale="0.001"/>'), "", ["link ", "'0.001'"]),
    (with_shape('<box size="0,04 0.05 0.11"/>'), "", ["bad.urdf", "size of <box>", "'0,04 0.05 0.11'"]),
    (with_shape('<box size="nan 0.05 0.11"/>'), "", ["size of <box>", "'nan 0.05 0.11'"]),
    (with_shape('<box size="-1 0.05 0.11"/>'), "", ["negative"]),
    (with_shape('<sphere/>'), "", ["<sphere> has no radius"]),
    (with_shape('<cone/>'), "", ["<cone>", "choices: box, capsule"]),
    (with_shape(''), "", ["has no <geometry>"]),
    (TEXT.replace('upper="2.6"', 'upper="${wide}"'), "", ["'bend'", "'${wide}'"]),
    (TEXT.replace(' velocity="0"', ""), "", ["'spin'", "no velocity"]),
    (CHAIN, "", ["39 of them in one chain", "30"]),
    (TEXT.replace('xyz="0.3 0 0"', 'xyz="75 0 0"').replace('xyz="0 0 0.36"', 'xyz="0 0 90"'), "",
     ["bad.urdf", "reaches 165.2 m", "look like millimetres"]),
    (TEXT, "--package-dir gone", ["--package-dir", "'gone'", "not a folder"]),
    (TEXT, "--name 'my arm'", ["--name", "'my arm'"]),
    (TEXT, "--out no/a.yaml", ["--out", "does not exist"]),
    (TEXT, "--out a.srdf", ["--out", "'a.srdf'", ".yaml"]),
    (TEXT, "--out a.yaml --cell ./a.yaml", ["--cell", "'./a.yaml'", "another"]),
    (TEXT, f"--gripper {URDF}", ["--gripper", "upper_slide moves there already"]),
    (TEXT.replace('"prismatic"', '"fixed"'), "--gripper cup.urdf", ["no moving joint", "suction cup", "gripper.cup"]),
    (TEXT, "--cell a.yaml --like ur5", ["outlining", "lays out no world"]),
], ids=lambda value: ", ".join(value)[:40] if isinstance(value, list) else "")
def test_unusable_description_or_option_is_one_line(text, options, wanted, tmp_path, monkeypatch, rejection):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cup.urdf").write_text(NO_ARM)
    (tmp_path / "a.stl").write_text("solid")
    if text is not None:
        (tmp_path / "bad.urdf").write_text(text)
    line = rejection("robot", "new", "bad.urdf", *shlex.split(options), "--yes")
    assert not [word for word in wanted if word not in line], line


def test_collision_pairs_are_written_or_shown_and_depend_on_the_seed(tmp_path):
    def collisions(robot: str, *options: str) -> str:
        done = ask(tmp_path, "robot", "collisions", robot, *options)
        assert done.returncode == 0, done.stderr
        return done.stdout

    written = collisions("panda", "--samples", "50", "-o", "panda.srdf")
    assert written.startswith("panda.srdf: ") and "adjacent" in written and "never" in written
    shown = collisions("panda", "--samples", "50")
    assert shown == (tmp_path / "panda.srdf").read_text()
    assert shown.startswith('<?xml version="1.0"?>\n<robot name="panda">')
    texts = [collisions("ur5", "--samples", "3", "--seed", seed) for seed in ("0", "1", "0")]
    assert texts[0] == texts[2] != texts[1]
    text = (config_root() / "robots" / "panda.yaml").read_text()
    line = next(line for line in text.splitlines() if line.startswith("srdf:"))
    (tmp_path / "mine.yaml").write_text(text.replace(line, "srdf: mine.srdf"))  # which does not exist yet
    collisions("mine.yaml", "--samples", "10", "-o", "mine.srdf")
    assert (tmp_path / "mine.srdf").is_file()


def clear_table(cell: Path, count: int, seed: int | None = None) -> None:
    outcome = Simulation(load_cell(str(cell), [f"world.count={count}"], seed=seed), 1).run()
    assert (outcome.state, outcome.done, outcome.total) == ("DONE", count, count), outcome.message
    assert (outcome.broken, outcome.crashes) == ([], [])


@pytest.mark.campaign  # that of the docs does it among the slow tests
def test_new_arm_clears_its_table(folder):
    clear_table(folder / "side_cell.yaml", 7)


@pytest.mark.parametrize(("size", "below", "camera"), [
    (0.08, 0.0, 0.4), pytest.param(0.25, 0.0, 0.8, marks=pytest.mark.slow), (1.0, 0.7, 0.8)])
def test_table_container_and_camera_suit_the_size_of_the_arm(size, below, camera, tmp_path):
    (tmp_path / "arm.urdf").write_text(six(size))
    done = ask(tmp_path, "robot", "new", "arm.urdf", "--yes", "--name", "six", "--cell", "six_cell.yaml")
    assert done.returncode == 0, done.stderr
    cell = load_cell(str(tmp_path / "six_cell.yaml"))
    assert cell.robot.base_position == (0.0, 0.0, -below)
    x, _, height = cell.world.camera.position
    reach = RobotModel.load(cell.robot).reach
    assert height == pytest.approx(camera) and 0.2 * reach < x < 0.8 * reach
    (table,) = cell.world.fixtures
    edge = table.position[0] - table.dimensions[0] / 2
    assert edge > 0.3 if below else edge == pytest.approx(0.0)  # not where the arm stands
    checked = ask(tmp_path, "check", "six_cell.yaml")
    assert "no errors, no warnings" in checked.stdout, checked.stdout


@pytest.mark.slow
@pytest.mark.parametrize("count", [2, pytest.param(7, marks=pytest.mark.campaign)])
@pytest.mark.parametrize("arm", [
    scara, lambda: six(0.08), *(pytest.param(each, marks=pytest.mark.campaign) for each in (lambda: six(1.0), nodding)),
    "package://example-robot-data/robots/z1_description/urdf/z1.urdf"])
def test_arm_of_any_size_of_four_joints_or_with_one_jaw_clears_its_table(arm, count, tmp_path):
    if not isinstance(arm, str):
        (tmp_path / "arm.urdf").write_text(arm())
    done = ask(tmp_path, "robot", "new", arm if isinstance(arm, str) else "arm.urdf", "--yes", "--name", "few",
               "--cell", "few_cell.yaml")
    assert done.returncode == 0, done.stderr
    clear_table(tmp_path / "few_cell.yaml", count, seed=1)


@pytest.mark.slow
def test_commands_of_the_docs_set_up_an_arm_that_clears_its_table(tmp_path):
    page = (ROOT / "docs" / "robots.md").read_text()
    block = page.split("```sh\n")[1].split("```")[0].replace("\\\n", " ")
    commands = [shlex.split(line) for line in block.strip().splitlines()]
    assert [command[:3] for command in commands[:2]] == [["zencell", "robot", "new"], ["zencell", "robot", "check"]]
    for command in commands:
        done = ask(tmp_path, *command[1:])
        assert done.returncode == 0, done.stdout + done.stderr
    assert "seed 1: DONE" in done.stdout
