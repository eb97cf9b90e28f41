"""What the fingers of a model do is measured, and told where it is not what the robot file says."""

from __future__ import annotations

import pytest

from common.config import RobotConfig, check, find_file, names_of, read_robot
from common.robot.model import RobotModel
from common.setup.fingers import tool_complaints
from common.setup.proposal import draft


def config_of(name: str) -> RobotConfig:
    return check(RobotConfig, read_robot(find_file("robots", name)), "robot")


@pytest.mark.parametrize("name", names_of("robots"))
def test_the_robots_that_come_with_the_project_say_what_is_so(name: str) -> None:
    assert tool_complaints(RobotModel.load(config_of(name))) == []


def test_a_width_that_is_not_the_fingers_is_told() -> None:
    config = config_of("panda")
    assert config.gripper is not None
    wide = config.model_copy(update={"gripper": config.gripper.model_copy(update={"mimic": [1.0, 0.5]})})
    (told,) = tool_complaints(RobotModel.load(wide))
    assert told == "gripper.max_width: the fingers open by 0.0600 m, not by 0.08 m"


def test_a_gripper_that_is_mounted_gets_the_linkage_that_was_worked_out_by_hand() -> None:
    by_hand = config_of("ur5").gripper
    made = draft("package://example-robot-data/robots/ur_description/urdf/ur5_robot.urdf", "arm",
                 gripper=str(find_file("robots", "ur5").with_name("robotiq_2f85.urdf")))
    found = made.values["gripper"]
    assert by_hand is not None and by_hand.linkage is not None
    assert found["linkage"] == pytest.approx(by_hand.linkage.model_dump(), abs=1e-4)
    assert dict(zip(found["joints"], found["mimic"], strict=True)) == dict(
        zip(by_hand.joints, by_hand.mimic, strict=True))
    assert found["max_width"] == pytest.approx(by_hand.max_width, abs=1e-4)
    assert set(found["links"]) == set(by_hand.links)
    assert made.values["attachments"][0]["parent_link"] == "tool0"


def test_a_jaw_against_a_fixed_finger_is_no_gripper_and_told_so() -> None:
    made = draft("package://example-robot-data/robots/z1_description/urdf/z1.urdf", "arm")
    assert "gripper" not in made.values
    (lost,) = made.lost
    assert lost.startswith("no gripper: jointGripper moves one finger against a fixed one")
    assert made.values["tcp"]["rpy"] == pytest.approx([0, 1.570796, 0], abs=1e-5)  # its flange has x out


def test_the_flange_whose_z_axis_points_out_is_the_tool_centre_point() -> None:
    made = draft("package://example-robot-data/robots/ur_description/urdf/ur10_robot.urdf", "arm")
    assert made.values["tcp_link"] == "tool0"  # and not ee_link, a third of a millimetre away, with x out
