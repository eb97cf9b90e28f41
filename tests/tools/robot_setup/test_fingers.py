"""Measured fingers, and deviations of robot files from them."""


import numpy as np
import pytest
from numpy.typing import NDArray

from common.config import RobotConfig, check, find_file, names_of, read_robot
from common.robot.finger_joints import finger_positions, width_at
from common.robot.model import RobotModel
from common.robot.transforms import invert
from tests.small_arms import scara
from tools.robot_setup.end_effector import check_gripper
from tools.robot_setup.fingers import check_tool_frame, link_points, links_moved
from tools.robot_setup.proposal import Proposal, draft

ROBOTS = "package://example-robot-data/robots"


def config_of(name: str) -> RobotConfig:
    return check(RobotConfig, read_robot(find_file("robots", name)), "robot")


@pytest.fixture
def scara_with(tmp_path):
    """Return the proposal for a SCARA whose description was changed."""
    def proposal(*changes: tuple[str, str]) -> Proposal:
        text = scara()
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        (tmp_path / "arm.urdf").write_text(text)
        return draft(str(tmp_path / "arm.urdf"), "arm")

    return proposal


@pytest.mark.parametrize("name", names_of("robots"))
def test_tool_frames_of_the_projects_robots_match_their_fingers(name):
    assert check_tool_frame(RobotModel.load(config_of(name))) == []


def test_mounted_gripper_gets_the_linkage_of_the_manual_robot_file():
    by_hand = config_of("ur5").gripper
    proposal = draft(f"{ROBOTS}/ur_description/urdf/ur5_robot.urdf", "arm",
                     gripper=str(find_file("robots", "ur5").with_name("robotiq_2f85.urdf")))
    found = proposal.values["gripper"]
    assert found["linkage"] == pytest.approx(by_hand.linkage.model_dump(), abs=1e-4)
    assert dict(zip(found["joints"], found["mimic"], strict=True)) == dict(
        zip(by_hand.joints, by_hand.mimic, strict=True))
    assert found["max_width"] == pytest.approx(by_hand.max_width, abs=1e-4)
    assert set(found["links"]) == set(by_hand.links)
    assert proposal.values["attachments"][0]["parent_link"] == "tool0"


@pytest.mark.slow
@pytest.mark.parametrize(("urdf", "opens", "closed"), [
    ("so_arm_description/urdf/so101.urdf", 1, -0.174533), ("z1_description/urdf/z1.urdf", -1, 0.0)])
def test_jaw_that_turns_towards_a_fixed_finger_is_measured(urdf, opens, closed):
    proposal = draft(f"{ROBOTS}/{urdf}", "arm")
    assert proposal.lost == [] and any("one finger is fixed" in line for line in proposal.check)
    config = check(RobotConfig, proposal.values, "robot")
    gripper = config.gripper
    assert (gripper.jaw.opens, gripper.jaw.closed) == (opens, pytest.approx(closed, abs=1e-4))
    assert 0.05 < gripper.max_width < 0.08
    robot = RobotModel.load(config)
    jaw = next(link for link in gripper.links if link in links_moved(robot, gripper.joints))
    q, corners = np.clip(np.zeros(robot.dof), robot.lower, robot.upper), link_points(robot)[jaw]

    def in_tool(width: float) -> NDArray[np.float64]:
        poses = robot.link_poses(q, {gripper.joints[0]: finger_positions(gripper, width)[0]})
        T = invert(poses[config.tcp_link]) @ poses[jaw]
        return np.asarray(corners @ T[:3, :3].T + T[:3, 3])

    # The tip corner nearest to the fixed finger moves away from it by the width.
    shut = in_tool(0.0)
    tip = int(np.argmin(np.where(shut[:, 2] > shut[:, 2].max() - 0.02, shut[:, 1], np.inf)))
    assert shut[tip, 1] == pytest.approx(-gripper.max_width / 2, abs=2e-4)  # the tool is in the middle of the open jaws
    for width in (0.2 * gripper.max_width, gripper.max_width):
        assert in_tool(width)[tip, 1] - shut[tip, 1] == pytest.approx(width, abs=5e-4)


@pytest.mark.slow
def test_wrong_values_of_a_gripper_are_reported_with_the_measured_ones():
    config = check(RobotConfig, draft(f"{ROBOTS}/z1_description/urdf/z1.urdf", "arm").values, "robot")
    jaw = config.gripper.jaw

    def problems(config: RobotConfig, **changes: object) -> list[str]:
        gripper = config.gripper.model_copy(update=changes)
        robot = RobotModel.load(config.model_copy(update={"gripper": gripper}))
        return check_gripper(robot) if gripper.jaw else check_tool_frame(robot)

    assert problems(config) == []
    assert problems(config, closing_axis="x") == [
        "gripper.closing_axis: the jaw closes along y of arm_tcp, not along x"]
    (problem,) = problems(config, jaw=jaw.model_copy(update={"opens": 1}))
    assert problem.startswith("gripper.jaw: it is closed at 0 and opens by -1")
    assert problems(config, jaw=jaw.model_copy(update={"radius": 0.2})) == [
        "gripper.jaw.radius: its tip is 0.1000 m from its axis, not 0.2 m"]
    assert problems(config_of("panda"), mimic=[1.0, 0.5]) == [
        "gripper.max_width: the fingers open by 0.0600 m, not by 0.08 m"]


def test_jaw_that_does_not_reach_the_fixed_finger_is_no_gripper():
    proposal = draft(f"{ROBOTS}/talos_data/robots/talos_left_arm.urdf", "arm")
    assert "gripper" not in proposal.values
    (lost,) = proposal.lost
    assert lost.startswith("no gripper: the jaw of gripper_left_joint does not reach the fixed finger")


def test_slides_closed_at_a_positive_position_report_it(scara_with):
    apart = [(f'xyz="0 {side} 0.03"', f'xyz="0 {-5 * float(side)} 0.03"') for side in ("0.005", "-0.005")]
    proposal = scara_with(('lower="0" upper="0.04"', 'lower="0.03" upper="0.06"'), *apart)
    gripper = check(RobotConfig, proposal.values, "robot").gripper
    assert (gripper.closed, gripper.max_width) == (pytest.approx(0.03), pytest.approx(0.06))
    assert finger_positions(gripper, 0.02) == pytest.approx([0.04, 0.04])
    assert width_at(gripper, 0.04) == pytest.approx(0.02)


LIMITS = 'lower="0" upper="0.04"'
LEFT, RIGHT = (f'<joint name="{side}_finger" type="prismatic"><parent link="palm"/><child link="{side}"/>'
               f'<origin xyz="0 0 0.04"/>\n <axis xyz="{axis}"/>'
               for side, axis in (("left", "0 1 0"), ("right", "0 -1 0")))
MIMIC = '<mimic joint="left_finger"/>'


def turning(joint, axis):
    return joint, joint.replace("prismatic", "revolute").replace("0 1 0", axis).replace("0 -1 0", axis)


@pytest.mark.parametrize(("changes", "opens", "closed", "opened"), [
    # the range begins below 0
    ([('xyz="0 0.005 0.03"', 'xyz="0 0.015 0.03"'), ('xyz="0 -0.005 0.03"', 'xyz="0 -0.015 0.03"'),
      (LIMITS, 'lower="-0.01" upper="0.03"')], 0.08, [-0.01, -0.01], [0.03, 0.03]),
    # closed fingers are apart
    ([('xyz="0 0.005 0.03"', 'xyz="0 0.01 0.03"'), ('xyz="0 -0.005 0.03"', 'xyz="0 -0.01 0.03"')],
     0.09, [0.0, 0.0], [0.04, 0.04]),
    # open at the lower end
    ([("0 1 0", "0 -1 0"), (RIGHT, RIGHT.replace("0 -1 0", "0 1 0")), (LIMITS, 'lower="-0.04" upper="0"')],
     0.08, [0.0, 0.0], [-0.04, -0.04]),
    # independent fingers that move the same way at equal positions
    ([(f"{RIGHT}<limit {LIMITS}", f'{RIGHT.replace("0 -1 0", "0 1 0")}<limit lower="-0.04" upper="0"'), (MIMIC, "")],
     0.08, [0.0, 0.0], [0.04, -0.04]),
    # fingers that turn, one with an offset; a tip may retreat by 12 mm
    ([turning(LEFT, "-1 0 0"), turning(RIGHT, "1 0 0"), (LIMITS, 'lower="-0.1" upper="0.4"'),
      (MIMIC, '<mimic joint="left_finger" multiplier="0.5" offset="0.05"/>')], None, None, None),
], ids=["below 0", "apart", "reversed", "independent", "turning"])
def test_fingers_get_the_width_that_their_shapes_show(changes, opens, closed, opened, scara_with):
    proposal = scara_with(*changes)
    assert proposal.lost == []
    robot = RobotModel.load(check(RobotConfig, proposal.values, "robot"))
    gripper = robot.config.gripper
    assert check_gripper(robot) == []
    for width in np.linspace(gripper.travel[0][0] if gripper.travel else 0.0, gripper.max_width, 9):
        assert width_at(gripper, finger_positions(gripper, width)[0]) == pytest.approx(width, abs=1e-5)
    if opens is None:
        left, right = finger_positions(gripper, 0.04)
        assert right == pytest.approx(0.5 * left + 0.05, abs=1e-4)
        assert 0.03 < gripper.max_width < 0.07
        return
    assert gripper.max_width == pytest.approx(opens, abs=1e-4)
    assert finger_positions(gripper, 0.0) == pytest.approx(closed, abs=1e-4)
    assert finger_positions(gripper, gripper.max_width) == pytest.approx(opened, abs=1e-4)


def test_fingers_that_do_not_meet_are_no_gripper(scara_with):
    proposal = scara_with(('xyz="0 0.005 0.03"', 'xyz="0 0.03 0.03"'), ('xyz="0 -0.005 0.03"', 'xyz="0 -0.03 0.03"'))
    assert proposal.lost == ["no gripper: the fingers of left_finger do not meet: they are 50 mm apart where they are "
                             "closest"]


def test_independent_joint_that_carries_no_finger_is_locked(scara_with):
    proposal = scara_with((
        "</robot>", '<link name="bar"/><joint name="bar_turns" type="continuous"><parent link="palm"/>'
                    '<child link="bar"/><axis xyz="0 0 1"/><limit velocity="1" effort="1"/></joint></robot>'))
    assert proposal.values["gripper"]["joints"] == ["left_finger", "right_finger"]
    assert proposal.values["locked_joints"]["bar_turns"] == 0.0
    assert "gripper: bar_turns is locked: it moves independently of left_finger" in proposal.check


def test_tool_points_away_from_the_arm(scara_with):
    around = scara_with(('0.005 0.03"/><geometry>', '0.005 -0.004"/><geometry>'),
                        ('xyz="0 0 0.04"/>', 'xyz="0 0 0.1"/>'))  # the fingers are around their frames
    robot = RobotModel.load(check(RobotConfig, around.values, "robot"))
    assert robot.fk(np.zeros(4))[2, 2] == pytest.approx(-1.0)  # down, as the gripper is mounted
    proposal = draft(f"{ROBOTS}/ur_description/urdf/ur10_robot.urdf", "arm")
    assert proposal.values["tcp_link"] == "tool0"  # and not ee_link, a third of a millimetre away, with x out
