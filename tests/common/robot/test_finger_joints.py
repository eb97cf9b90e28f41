"""Joint positions of grippers by their width: the Robotiq 2F-85 against its data sheet, turning and sliding jaws."""

import xml.etree.ElementTree as ET

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.config import GripperConfig, RobotConfig, check, find_file, read_robot
from common.errors import ConfigError
from common.robot.finger_joints import driven_position, finger_positions, finger_velocities, width_at
from common.robot.model import RobotModel
from common.robot.transforms import invert

CONFIG = check(RobotConfig, read_robot(find_file("robots", "ur5")))
ROBOT = RobotModel.load(CONFIG)
GRIPPER = CONFIG.gripper
SHAPES = ROBOT.full_geometry()
WIDTHS = st.floats(0.0, 0.085)
SIDES = {"left": 1, "right": -1}


def in_flange(width: float) -> dict[str, np.ndarray]:
    """(4, 4) poses of the links in tool0 with the gripper at a width."""
    others = dict(zip(GRIPPER.joints, finger_positions(GRIPPER, width), strict=True))
    poses = ROBOT.link_poses(ROBOT.named("home"), others)
    return {link: invert(poses["tool0"]) @ T for link, T in poses.items()}


def tip_corners(side: str, width: float) -> np.ndarray:
    """(N, 3) corners [m] of the boxes of a finger tip in tool0."""
    link, points = f"robotiq_85_{side}_finger_tip_link", []
    for item in SHAPES.geometryObjects:
        frame = ROBOT.full_model.frames[item.parentFrame]
        if frame.name == link:
            T = in_flange(width)[link] @ invert(frame.placement.homogeneous) @ item.placement.homogeneous
            for signs in np.ndindex(2, 2, 2):
                points.append((T @ np.append(item.geometry.halfSide * (2 * np.array(signs) - 1), 1.0))[:3])
    return np.array(points)


@given(WIDTHS)
def test_pads_are_parallel_and_their_distance_is_the_width(width):
    assert tip_corners("left", width)[:, 0].min() == pytest.approx(width / 2, abs=1e-5)
    assert tip_corners("right", width)[:, 0].max() == pytest.approx(-width / 2, abs=1e-5)
    for side in SIDES:
        assert np.allclose(in_flange(width)[f"robotiq_85_{side}_finger_tip_link"][:3, :3], np.eye(3), atol=1e-6)


def test_gripper_ends_163_mm_from_the_flange_at_the_tcp_and_13_mm_nearer_when_open():
    for side in SIDES:
        assert tip_corners(side, 0.0)[:, 2].max() == pytest.approx(0.163, abs=1e-5)
    assert np.allclose(in_flange(0.0)["gripper_tcp"][:3, 3], (0, 0, 0.163))
    assert finger_positions(GRIPPER, 0.085) == pytest.approx([0.0] * 6, abs=1e-5)
    assert 0.163 - tip_corners("left", 0.085)[:, 2].max() == pytest.approx(0.0132, abs=2e-4)


@given(WIDTHS)
def test_inner_knuckles_close_the_parallelogram(width):
    """The end of the inner bar has a fixed position in the finger tip, or the linkage could not move like this."""
    poses = in_flange(width)
    for side, sign in SIDES.items():
        end = poses[f"robotiq_85_{side}_inner_knuckle_link"] @ (sign * 0.0368916, 0.0, 0.0436478, 1.0)
        in_tip = (invert(poses[f"robotiq_85_{side}_finger_tip_link"]) @ end)[:3]
        assert np.allclose(in_tip, (-sign * 0.0179, 0.0, 0.0065), atol=1e-5)


@given(st.floats(0.0, 0.8))
def test_width_and_knuckle_are_inverse_and_reach_the_ends_of_the_data_sheet(knuckle):
    width = width_at(GRIPPER, knuckle)
    assert -1e-9 <= width <= 0.085 + 1e-5
    assert driven_position(GRIPPER, width) == pytest.approx(knuckle, abs=1e-9)
    assert width_at(GRIPPER, 0.8) == pytest.approx(0.0, abs=1e-9)
    assert width_at(GRIPPER, 0.0) == pytest.approx(0.085, abs=1e-5)


@given(st.floats(0.001, 0.084), st.floats(-0.05, 0.05))
def test_joint_velocities_are_the_slope_of_the_positions(width, rate):
    after, before = (np.array(finger_positions(GRIPPER, width + step)) for step in (1e-6, -1e-6))
    assert np.allclose(finger_velocities(GRIPPER, width, rate), (after - before) / 2e-6 * rate, atol=1e-6)


def test_joints_and_mimics_of_the_robot_file_match_the_description():
    joints = {joint.get("name"): joint for joint in ET.fromstring(ROBOT.urdf).iter("joint")}
    driven, *others = GRIPPER.joints
    mimics = {name: joint.find("mimic") for name, joint in joints.items() if joint.find("mimic") is not None}
    assert set(mimics) == set(others) and {mimic.get("joint") for mimic in mimics.values()} == {driven}
    assert [float(mimics[name].get("multiplier", "nan")) for name in others] == GRIPPER.mimic[1:]
    closed = dict(zip(GRIPPER.joints, finger_positions(GRIPPER, 0.0), strict=True))
    assert {name: pytest.approx(value, abs=1e-6) for name, value in closed.items()} == CONFIG.locked_joints


def test_sliding_fingers_each_move_half_the_width():
    panda = GripperConfig(joints=["left", "right"], links=[])
    assert finger_positions(panda, 0.05) == [0.025, 0.025]
    assert finger_velocities(panda, 0.05, -0.2) == [-0.1, -0.1]
    assert width_at(panda, driven_position(panda, 0.03)) == pytest.approx(0.03)


def turning_jaw(opens: int, **values: object) -> GripperConfig:
    jaw = {"radius": 0.08, "angle": -0.3, "closed": 0.2, "opens": opens}
    base = {"joints": ["jaw"], "links": ["tip"], "max_width": 0.07, "jaw": jaw}
    return check(GripperConfig, base | values, "gripper")


@pytest.mark.parametrize("opens", [1, -1])
@pytest.mark.parametrize("width", [0.0, 0.02, 0.05, 0.07])
def test_width_and_position_of_a_turning_jaw_are_inverse(opens: int, width: float) -> None:
    gripper = turning_jaw(opens)
    at = driven_position(gripper, width)
    assert width_at(gripper, at) == pytest.approx(width) and opens * (at - 0.2) >= 0.0
    after, before = driven_position(gripper, width + 1e-5), driven_position(gripper, width - 1e-5)
    assert finger_velocities(gripper, width, 0.1) == [pytest.approx(0.1 * (after - before) / 2e-5, rel=1e-3)]


@pytest.mark.parametrize(("make", "wrong", "message"), [
    (None, {"mimic": [1, -1]}, "mimic has 2 values for 6 joints"),
    (None, {"mimic": [-1, 1, 1, 1, 1, 1]}, "begins with the driven joint"),
    (None, {"max_width": 0.14}, r"opens to 0\.0850 m, but max_width is 0\.14 m"),
    (None, {"named_widths": {"wide": 0.1}}, r"wide is 0\.1 m, more than max_width"),
    (turning_jaw, {"max_width": 0.2}, "gripper.jaw opens by 0.1036 m at most, max_width is 0.2 m"),
    (turning_jaw, {"closed": 0.1}, "gripper.closed is for sliding fingers"),
    (turning_jaw, {"joints": ["jaw", "other"]}, "gripper.jaw needs exactly one joint"),
])
def test_inconsistent_gripper_is_refused(make, wrong: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make(1, **wrong) if make else check(GripperConfig, GRIPPER.model_dump() | wrong, "gripper")
