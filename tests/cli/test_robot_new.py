"""`zencell robot new`: a robot file from nothing but a URDF, and a cell that takes things with it."""

from __future__ import annotations

import io
import shlex
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml

from common.config import RobotConfig, check, load_cell, read_robot
from common.robot.model import RobotModel
from lab.simulation import Simulation
from tests.harness import ask
from tests.small_arms import nodding, scara
from tools.robot_setup.fingers import check_tool_frame

URDF = Path(__file__).parents[1] / "data" / "side_arm.urdf"
NO_ARM = '<robot name="post"><link name="a"/><link name="b"/><joint name="j" type="fixed">' \
         '<parent link="a"/><child link="b"/></joint></robot>'
NO_MESH = NO_ARM.replace('<link name="b"/>', '<link name="b"><collision><geometry><mesh filename="package://gone/b.stl"/>'
                                             '</geometry></collision></link>')


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which the command has written its files."""
    folder = tmp_path_factory.mktemp("new")
    (folder / "side_arm.urdf").write_text(URDF.read_text())
    done = ask(folder, "robot", "new", "side_arm.urdf", "--yes", "--name", "side", "--cell", "side_cell.yaml")
    assert done.returncode == 0, done.stderr
    (folder / "told.txt").write_text(done.stdout)
    return folder


def robot_of(folder: Path) -> RobotModel:
    return RobotModel.load(check(RobotConfig, read_robot(folder / "side.yaml"), "robot"))


def test_the_tool_frame_points_out_of_the_hand_although_no_link_of_the_urdf_does(made: Path) -> None:
    robot = robot_of(made)
    assert robot.config.base_link == "foot"
    assert robot.config.joints == ["turn", "lift", "bend", "roll", "pitch", "spin"]
    assert robot.config.tcp is not None and robot.config.gripper is not None
    assert robot.config.gripper.closing_axis == "y"
    assert robot.config.gripper.max_width == pytest.approx(0.08)
    assert check_tool_frame(robot) == []
    poses = robot.link_poses(robot.named("home"))
    T_flange_tcp = np.linalg.inv(poses["flange"]) @ poses[robot.config.tcp_link]
    assert T_flange_tcp[:3, 2] == pytest.approx([1, 0, 0], abs=1e-5)
    assert T_flange_tcp[:3, 3] == pytest.approx([0.10, 0, 0], abs=1e-4)  # a centimetre behind the tips


def test_home_is_tool_down_in_front_of_the_base_and_within_the_limits(made: Path) -> None:
    robot = robot_of(made)
    home = robot.named("home")
    T_world_tcp = robot.fk(home)
    assert T_world_tcp[2, 2] == pytest.approx(-1, abs=1e-3)
    assert T_world_tcp[0, 3] > 0.15 and abs(T_world_tcp[1, 3]) < 0.02
    assert np.all(np.minimum(home - robot.lower, robot.upper - home) > 0.1)


def test_limits_that_the_urdf_does_not_give_are_marked_as_guessed(made: Path) -> None:
    text, given = (made / "side.yaml").read_text(), yaml.safe_load((made / "side.yaml").read_text())
    assert given["position_limits"][0] == pytest.approx([-np.pi, np.pi])
    assert given["velocity_limits"] == [2, 2, 2, 3, 3, 1]
    assert given["acceleration_limits"] == [4, 4, 4, 6, 6, 2]
    assert given["jerk_limits"] == [80, 80, 80, 120, 120, 40]
    for field in ("velocity_limits", "acceleration_limits", "jerk_limits"):
        before = text[: text.index(f"\n{field}:")].rsplit("\n", 1)[-1]
        assert before.startswith("# GUESSED"), field
    told = (made / "told.txt").read_text()
    assert "guessed: velocity_limits of spin" in told
    assert "next: zencell robot check side.yaml" in told and "zencell run side_cell.yaml" in told
    assert "zencell up side_cell.yaml --set autostart=false" in told


def test_the_file_passes_its_own_check_and_one_with_another_axis_does_not(made: Path) -> None:
    good = ask(made, "robot", "check", "side.yaml")
    assert (good.returncode, good.stderr) == (0, "") and "fingers close along its y" in good.stdout
    (made / "wrong.yaml").write_text((made / "side.yaml").read_text().replace("closing_axis: y", "closing_axis: x"))
    wrong = ask(made, "robot", "check", "wrong.yaml")
    assert wrong.returncode == 1
    assert wrong.stdout.splitlines() == ["gripper.closing_axis: the fingers close along y of side_tcp, not along x"]


def test_a_tool_that_points_elsewhere_is_told_in_one_line(made: Path) -> None:
    given = yaml.safe_load((made / "side.yaml").read_text())
    del given["tcp"]
    (made / "bare.yaml").write_text(yaml.safe_dump(given | {"tcp_link": "flange"}))
    told = ask(made, "robot", "check", "bare.yaml")
    assert told.returncode == 1
    assert "z of flange must point from the palm to the tips of the fingers, which is x" in told.stdout


def test_nothing_is_overwritten_unless_that_is_asked_for(made: Path) -> None:
    before = (made / "side.yaml").read_text()
    refused = ask(made, "robot", "new", "side_arm.urdf", "--yes", "--name", "side")
    assert refused.returncode == 2
    assert refused.stderr.splitlines() == ["zencell: --out: 'side.yaml' is there already; --force overwrites it"]
    assert (made / "side.yaml").read_text() == before


def test_a_person_is_asked_for_the_name_with_a_guess(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO("\n"))
    asked = ask(made, "robot", "new", "side_arm.urdf")
    assert asked.returncode == 0, asked.stderr
    assert "name of the robot [side_arm]" in asked.stdout
    assert yaml.safe_load((made / "side_arm.yaml").read_text())["name"] == "side_arm"


def test_where_nobody_answers_that_is_told(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO(""))
    asked = ask(made, "robot", "new", "side_arm.urdf")
    assert asked.returncode == 2
    assert asked.stderr.splitlines()[-1] == "zencell: --yes: is needed where nobody answers: it takes the best guesses"


def test_a_xacro_file_is_read_and_its_urdf_overwrites_none(tmp_path: Path) -> None:
    pytest.importorskip("xacro")
    head = '<robot name="x" xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:property name="speed" value="2.5"/>'
    text = URDF.read_text().replace('<robot name="side arm">', head).replace('velocity="3"', 'velocity="${speed}"')
    (tmp_path / "arm.urdf.xacro").write_text(text)
    done = ask(tmp_path, "robot", "new", "arm.urdf.xacro", "--yes")
    assert done.returncode == 0, done.stderr
    assert yaml.safe_load((tmp_path / "x.yaml").read_text())["velocity_limits"] == [2, 2, 2, 2.5, 2.5, 1]
    again = ask(tmp_path, "robot", "new", "arm.urdf.xacro", "--yes", "--name", "y")
    assert again.returncode == 2 and "arm.urdf, which is there already" in again.stderr


BAD: dict[str, tuple[str, list[str], list[str]]] = {
    "no file": ("", ["gone.urdf"], ["gone.urdf", "is missing"]),
    "no XML": ("joint: 1", ["bad.urdf"], ["bad.urdf", "does not parse"]),
    "no URDF": ("<sdf/>", ["bad.urdf"], ["its root is <sdf>"]),
    "no joint that moves": (NO_ARM, ["bad.urdf"], ["bad.urdf", "no joint that moves"]),
    "mesh that is nowhere": (NO_MESH, ["bad.urdf"], ["package://gone/b.stl", "--package-dir"]),
    "tip that is no link": (URDF.read_text(), ["bad.urdf", "--tip", "flnge"], ["'flnge'", "did you mean 'flange'?"]),
    "tip that is fixed": (URDF.read_text(), ["bad.urdf", "--tip", "foot"], ["'foot'", "flange"]),
    "name with a blank": (URDF.read_text(), ["bad.urdf", "--name", "my arm"], ["--name", "'my arm'"]),
    "folder that is not there": (URDF.read_text(), ["bad.urdf", "--out", "no/a.yaml"], ["--out", "does not exist"]),
    "out that is no YAML": (URDF.read_text(), ["bad.urdf", "--out", "a.txt"], ["--out", "'a.txt'", ".yaml"]),
    "out that is the file beside it": (
        URDF.read_text(), ["bad.urdf", "--out", "a.srdf"], ["--out", "'a.srdf'", ".yaml"]),
    "cell in the place of the robot": (
        URDF.read_text(), ["bad.urdf", "--out", "a.yaml", "--cell", "./a.yaml"], ["--cell", "'./a.yaml'", "another"]),
    "mesh that is none": (
        URDF.read_text().replace('<box size="0.04 0.05 0.11"/>', '<mesh filename="bad.urdf"/>'), ["bad.urdf"],
        ["a mesh that cannot be loaded"]),
    "gripper on fingers": (
        URDF.read_text(), ["bad.urdf", "--gripper", str(URDF)], ["--gripper", "upper_slide moves there already"]),
    "limits that are none": (
        URDF.read_text().replace('lower="-1.5"', 'lower="3"'), ["bad.urdf"], ["'lift'", "needs limits"]),
    "limit that is no number": (
        URDF.read_text().replace('upper="2.6"', 'upper="${wide}"'), ["bad.urdf"], ["'bend'", "'${wide}'"]),
    "limit without a velocity": (
        URDF.read_text().replace(' velocity="0"', ""), ["bad.urdf"], ["'spin'", "no velocity"]),
    "cell like one that is for another use": (
        URDF.read_text(), ["bad.urdf", "--cell", "a.yaml", "--like", "ur5"], ["outlining", "lays out no world"]),
}


@pytest.mark.parametrize("case", BAD)
def test_what_cannot_be_set_up_is_told_in_one_line(case: str, tmp_path: Path) -> None:
    text, arguments, wanted = BAD[case]
    (tmp_path / "bad.urdf").write_text(text)
    done = ask(tmp_path, "robot", "new", *arguments, "--yes")
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith("zencell: ")
    assert not [word for word in wanted if word not in line], line


@pytest.mark.slow
def test_an_arm_that_nobody_set_up_takes_all_that_lies_in_its_reach(made: Path) -> None:
    outcome = Simulation(load_cell(str(made / "side_cell.yaml")), 1).run()
    assert (outcome.state, outcome.done, outcome.total) == ("DONE", 7, 7), outcome.message
    assert (outcome.broken, outcome.crashes) == ([], [])


@pytest.mark.slow
@pytest.mark.parametrize("arm", [scara, nodding])
def test_an_arm_of_four_joints_clears_its_table_of_balls(arm: Callable[[], str], tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text(arm())
    done = ask(tmp_path, "robot", "new", "arm.urdf", "--yes", "--name", "few", "--cell", "few_cell.yaml")
    assert done.returncode == 0, done.stderr
    outcome = Simulation(load_cell(str(tmp_path / "few_cell.yaml"), seed=1), 1).run()
    assert (outcome.state, outcome.done, outcome.total) == ("DONE", 7, 7), outcome.message
    assert (outcome.broken, outcome.crashes) == ([], [])


@pytest.mark.slow
def test_an_arm_with_one_jaw_against_a_fixed_finger_clears_its_table_of_balls(tmp_path: Path) -> None:
    done = ask(tmp_path, "robot", "new", "package://example-robot-data/robots/z1_description/urdf/z1.urdf", "--yes",
               "--name", "z1", "--cell", "z1_cell.yaml")
    assert done.returncode == 0, done.stderr
    outcome = Simulation(load_cell(str(tmp_path / "z1_cell.yaml"), seed=1), 1).run()
    assert (outcome.state, outcome.done, outcome.total) == ("DONE", 7, 7), outcome.message
    assert (outcome.broken, outcome.crashes) == ([], [])


@pytest.mark.slow
def test_the_commands_of_the_docs_set_up_an_arm_and_have_it_clear_its_table(tmp_path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs" / "robots.md").read_text()
    block = page.split("```sh\n")[1].split("```")[0].replace("\\\n", " ")
    commands = [shlex.split(line) for line in block.strip().splitlines()]
    assert [command[:3] for command in commands[:2]] == [["zencell", "robot", "new"], ["zencell", "robot", "check"]]
    for command in commands:
        done = ask(tmp_path, *command[1:])
        assert done.returncode == 0, done.stdout + done.stderr
    assert "seed 1: DONE" in done.stdout
