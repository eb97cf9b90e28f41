import numpy as np
import pytest

from common.config import RobotConfig, load_cell
from common.errors import ConfigError, UnknownName
from common.robot.model import RobotModel


@pytest.fixture(scope="module")
def config() -> RobotConfig:
    return load_cell("panda").robot


@pytest.fixture(scope="module")
def robot(config) -> RobotModel:
    return RobotModel.load(config)


def test_panda_has_seven_joints_and_the_limits_of_its_description(robot):
    assert robot.dof == 7
    assert robot.joint_names == [f"panda_joint{i}" for i in range(1, 8)]
    assert np.allclose(robot.velocity, [2.175] * 4 + [2.61] * 3)
    assert np.allclose(robot.lower[[0, 3]], [-2.8973, -3.0718])
    assert robot.acceleration[1] == 7.5
    assert robot.jerk[6] == 10000


def test_group_has_both_names(robot):
    assert robot.groups == ["arm", "panda_arm"]


def test_tcp_lies_between_the_finger_tips(robot):
    q = robot.named("home")
    links = robot.link_poses(q)
    assert np.allclose(robot.fk(q), links["panda_hand_tcp"])
    fingers = (links["panda_leftfinger"][:3, 3] + links["panda_rightfinger"][:3, 3]) / 2
    hand = links["panda_hand"]
    assert np.allclose(np.cross(fingers - hand[:3, 3], hand[:3, 2]), 0, atol=1e-6)
    assert np.isclose(np.linalg.norm(robot.fk(q)[:3, 3] - links["panda_link8"][:3, 3]), 0.1034, atol=1e-4)


def test_link_poses_of_the_fingers_follow_their_positions(robot):
    q = robot.named("home")
    closed = robot.link_poses(q, {"panda_finger_joint1": 0.0, "panda_finger_joint2": 0.0})
    assert np.allclose(closed["panda_leftfinger"][:3, 3], closed["panda_rightfinger"][:3, 3])
    opened = robot.link_poses(q)
    assert np.isclose(np.linalg.norm(opened["panda_leftfinger"][:3, 3] - opened["panda_rightfinger"][:3, 3]), 0.08)


def test_every_link_has_a_known_parent(robot):
    links = set(robot.link_poses(robot.named("home")))
    assert set(robot.link_parents) == links - {"panda_link0"}
    assert set(robot.link_parents.values()) <= links


def test_joint_state_is_ordered_as_the_group(robot):
    names = [*reversed(robot.joint_names), "panda_finger_joint1"]
    assert np.array_equal(robot.order(names, list(range(8))), [6, 5, 4, 3, 2, 1, 0])
    assert robot.order(names[1:], list(range(7))) is None


def test_unknown_names_are_refused_with_the_choices(robot):
    with pytest.raises(UnknownName, match="home"):
        robot.named("nowhere")
    with pytest.raises(UnknownName, match="panda_finger_joint1"):
        robot.link_poses(robot.named("home"), {"thumb": 0.0})
    with pytest.raises(ValueError, match=r"\(7,\)"):
        robot.fk([0.0] * 6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"urdf": "package://no-such-package/x.urdf"}, "robot.urdf.*no-such-package.*pip install no-such-package"),
        ({"urdf": "/nowhere/robot.urdf"}, "robot.urdf.*/nowhere/robot.urdf"),
        ({"tcp_link": "thumb"}, "robot.tcp_link.*thumb.*panda_hand_tcp"),
        ({"locked_joints": {}}, "robot.locked_joints.*panda_finger_joint1"),
        ({"locked_joints": {"thumb": 0.0}}, "thumb.*not a joint"),
        ({"named_poses": {"home": [9.0, 0, 0, -1, 0, 1, 0]}}, "robot.named_poses.home.*panda_joint1"),
    ],
)
def test_invalid_robot_file_is_refused_with_field_and_choices(config, change, message):
    changed = RobotConfig.model_validate(config.model_dump() | change)
    with pytest.raises(ConfigError, match=message):
        RobotModel.load(changed)


def test_joints_in_another_order_than_the_description_are_refused(config):
    swapped = config.model_dump()
    swapped["joints"] = [swapped["joints"][1], swapped["joints"][0], *swapped["joints"][2:]]
    with pytest.raises(ConfigError, match=r"robot\.joints"):
        RobotModel.load(RobotConfig.model_validate(swapped))


def test_description_that_does_not_parse_is_named(config, tmp_path):
    (tmp_path / "broken").mkdir()
    path = tmp_path / "broken" / "robot.urdf"
    path.write_text("<robot")
    changed = config.model_dump() | {"urdf": "package://broken/robot.urdf", "package_dirs": [str(tmp_path)]}
    with pytest.raises(ConfigError, match="does not parse"):
        RobotModel.load(RobotConfig.model_validate(changed))
