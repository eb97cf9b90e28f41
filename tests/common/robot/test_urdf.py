"""Robots of several descriptions: base pose, attachments, TCP, limits."""

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import trimesh

from common.config import RobotConfig, check, find_file, read_robot
from common.errors import ConfigError
from common.robot.model import RobotModel
from common.robot.transforms import rpy_to_matrix, transform
from tools.robot_setup.tree import find_arm, read_tree

BOX = '<collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision>'


def link(name: str, inside: str = "") -> str:
    return f'<link name="{name}">{inside}</link>'


def joint(parent: str, child: str, kind: str = "revolute", xyz: str = "0 0 0.5") -> str:
    limit = '<axis xyz="0 0 1"/><limit lower="-2" upper="2" velocity="1" effort="1"/>' if kind == "revolute" else ""
    return (f'<joint name="{parent}_{child}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="{xyz}"/>{limit}</joint>')


ARM = link("base", BOX) + link("arm", BOX) + joint("base", "arm")
HAND = link("palm", BOX) + link("thumb") + joint("palm", "thumb", "fixed", "0.1 0 0")


@pytest.fixture
def make(tmp_path):
    """Create a robot of an arm with one joint, and its files."""

    def create(arm: str = ARM, hand: str = HAND, **changes: object) -> RobotModel:
        (tmp_path / "arm.urdf").write_text(f'<robot name="arm">{arm}</robot>')
        (tmp_path / "hand.urdf").write_text(f'<robot name="hand">{hand}</robot>')
        values = {
            "name": "arm", "urdf": str(tmp_path / "arm.urdf"), "joints": ["base_arm"], "base_link": "base",
            "tcp_link": "arm", "named_poses": {"home": [0.0]}, "acceleration_limits": [1], "jerk_limits": [1],
        }
        return RobotModel.load(check(RobotConfig, values | changes, "robot"))

    return create


def mounted(folder: Path, **changes: object) -> list[dict[str, object]]:
    return [{"urdf": str(folder / "hand.urdf"), "parent_link": "arm", "position": [0, 0, 0.2], **changes}]


def shapes(robot: RobotModel) -> list[pin.GeometryObject]:
    return list(robot.full_geometry().geometryObjects)


def test_base_pose_of_the_robot_file_moves_the_complete_robot(make):
    at_origin, moved = make(), make(base_position=[1.0, -0.5, 0.75], base_rpy=[0.1, -0.2, 0.7])
    T_world_base = transform(rpy_to_matrix(0.1, -0.2, 0.7), (1.0, -0.5, 0.75))
    for name, T in at_origin.link_poses([0.3]).items():
        assert np.allclose(moved.link_poses([0.3])[name], T_world_base @ T, atol=1e-9)
    assert np.allclose(moved.fk([0.3]), T_world_base @ at_origin.fk([0.3])) and moved.jacobian([0.3]).shape == (6, 1)
    assert np.allclose(shapes(moved)[0].placement.homogeneous, T_world_base, atol=1e-9)
    assert (at_origin.world_frames, moved.world_frames) == (["", "world", "base"], ["", "world"])
    assert set(moved.link_names) == {"base", "arm"} and moved.link_parents == {"arm": "base"}


def test_base_pose_of_the_description_is_ignored(make):
    robot = make(arm=link("world") + joint("world", "base", "fixed", "5 5 5") + ARM, base_position=[0, 0, 1])
    assert np.allclose(robot.link_poses([0.0])["base"][:3, 3], (0, 0, 1))


def test_continuous_joint_gets_limits_of_a_full_turn_or_of_the_robot_file(make):
    turning = ARM.replace('type="revolute"', 'type="continuous"').replace('lower="-2" upper="2" ', "")
    for changes, low, high in (({}, -2 * np.pi, 2 * np.pi), ({"position_limits": [(-1.0, 3.0)]}, -1.0, 3.0)):
        robot = make(turning, **changes)
        assert (robot.dof, robot.lower.tolist(), robot.upper.tolist()) == (1, [low], [high])


def test_fixed_joint_may_have_the_name_of_a_link(make):
    robot = make(ARM + link("stand") + joint("arm", "stand", "fixed").replace('"arm_stand"', '"stand"'))
    assert robot.link_poses([0.3])["stand"][2, 3] == pytest.approx(1.0)


def test_what_planning_does_not_use_of_a_description_prints_nothing(make, capfd):
    inside = '<safety_controller/><calibration rising="x"/><limit'
    unused = '<material name="m"><color rgba="x"/></material>' + link("a", "<inertial/>") + joint("arm", "a", "fixed")
    make(ARM.replace("<limit", inside).replace('"0 0 0.5"', '"0&#9;0 0.5"').replace('"-2"', '"-2 "') + unused)
    assert capfd.readouterr() == ("", "")


def test_attachment_is_fixed_to_its_link_and_the_tcp_to_the_attachment(make, tmp_path):
    tcp = {"link": "tip", "parent": "thumb", "position": [0, 0, 0.05], "rpy": [0, np.pi / 2, 0]}
    robot = make(attachments=mounted(tmp_path, rpy=[0, 0, np.pi / 2]), tcp=tcp, tcp_link="")
    assert robot.link_parents == {"arm": "base", "palm": "arm", "thumb": "palm", "tip": "thumb"}
    assert np.allclose(robot.fk([0.0])[:3, 3], (0, 0.1, 0.75))
    assert np.allclose(robot.fk([0.0])[:3, 2], (0, 1, 0)) and len(shapes(robot)) == 3


def test_link_called_world_is_replaced_and_what_else_is_fixed_to_it_stays(make):
    arm = (link("world") + joint("world", "base", "fixed", "0 0 0.2") + ARM + link("lamp", BOX)
           + joint("world", "lamp", "fixed", "0.3 0 0.5"))
    assert make(arm).link_poses([0.3])["lamp"][:3, 3] == pytest.approx((0.3, 0.0, 0.3))
    arm += link("a") + joint("arm", "a") + link("b") + joint("a", "b")
    assert find_arm(read_tree(ET.fromstring(f"<robot>{arm}</robot>"), "arm"), "arm").base == "base"


@pytest.mark.parametrize(("changes", "message"), [
    ({"base_link": "nowhere"}, "robot.base_link.*nowhere.*choices: base, arm"),
    ({"base_link": "arm"}, "robot.base_link.*its parent is base and joint base_arm moves"),
    ({"tcp": {"link": "tip", "parent": "elbow"}, "tcp_link": ""}, "robot.tcp.parent.*elbow.*choices: base, arm"),
    ({"tcp": {"link": "arm", "parent": "base"}}, "robot.tcp.link.*is a link of the URDF already"),
    ({"tcp": {"link": "tip", "parent": "arm"}}, "tcp_link is arm, but tcp defines tip"),
    ({"tcp_link": ""}, "tcp_link must be given, or tcp"),
    ({"velocity_limits": [1, 1]}, "velocity_limits has 2 values for 1 joints"),
    ({"position_limits": [[0, 1], [0, 1]]}, "position_limits has 2 values for 1 joints"),
    ({"position_limits": [[1, 0]]}, "robot.position_limits.*has no usable limits for joint"),
    ({"position_limits": [[0.5, 1]]}, "robot.named_poses.home.*must be within 0.5 to 1"),
])
def test_invalid_part_is_refused_with_field_and_choices(make, changes, message):
    with pytest.raises(ConfigError, match=message):
        make(**changes)


@pytest.mark.parametrize(("hand", "changes", "message"), [
    (HAND, {"parent_link": "elbow"}, r"robot.attachments.0.parent_link.*elbow.*choices: base, arm"),
    (HAND, {"urdf": "gone.urdf"}, r"robot.attachments.0.urdf.*gone.urdf.*is missing"),
    (link("arm"), {}, r"robot.attachments.0.urdf.*has a link arm, which the robot already has"),
    (link("one") + link("two"), {}, r"robot.attachments.0.urdf.*must have one root, not one, two"),
    ("<link", {}, r"robot.attachments.0.urdf.*does not parse"),
])
def test_invalid_attachment_is_refused(make, tmp_path, hand, changes, message):
    with pytest.raises(ConfigError, match=message):
        make(hand=hand, attachments=mounted(tmp_path, **changes))


def test_mesh_next_to_an_attachment_is_found_from_any_folder(make, tmp_path):
    trimesh.creation.box().export(tmp_path / "palm.stl")
    hand = link("palm", '<collision><geometry><mesh filename="palm.stl"/></geometry></collision>')
    assert len(shapes(make(hand=hand, attachments=mounted(tmp_path)))) == 3


def test_files_next_to_a_robot_file_are_found_from_any_folder(tmp_path):
    robot = (find_file("robots", "ur5").parent / "robotiq_2f85.urdf").read_text()
    (tmp_path / "mine.urdf").write_text(robot)
    (tmp_path / "mine.yaml").write_text("urdf: mine.urdf\nsrdf: package://a/b.srdf\nattachments: [{urdf: mine.urdf}]")
    read = read_robot(tmp_path / "mine.yaml")
    assert read["urdf"] == read["attachments"][0]["urdf"] == str(tmp_path / "mine.urdf")
    assert read["srdf"] == "package://a/b.srdf"
