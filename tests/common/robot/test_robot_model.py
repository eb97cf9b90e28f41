import numpy as np
import pinocchio as pin
import pytest

from common.config import RobotConfig, load_cell
from common.errors import ConfigError, UnknownName
from common.robot.model import RobotModel

CONFIG = load_cell("panda").robot


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    return RobotModel.load(CONFIG)


def test_panda_has_the_joints_limits_and_frames_of_its_description(robot):
    assert robot.joint_names == [f"panda_joint{i}" for i in range(1, 8)] and robot.dof == 7
    assert np.allclose(robot.velocity, [2.175] * 4 + [2.61] * 3)
    assert np.allclose(robot.lower[[0, 3]], [-2.8973, -3.0718])
    assert (robot.acceleration[1], robot.jerk[6]) == (7.5, 10000) and robot.groups == ["arm", "panda_arm"]
    assert robot.world_frames == ["", "world", "panda_link0"]
    share = next(folder for folder in robot.package_folders if (folder / "example-robot-data").is_dir())
    alone = pin.buildModelFromUrdf(str(share / CONFIG.urdf.removeprefix("package://")))
    assert list(alone.names) == list(robot.full_model.names)
    q = pin.randomConfiguration(alone)
    frames = []
    for model in (alone, robot.full_model):
        data = model.createData()
        pin.framesForwardKinematics(model, data, q)
        frames.append({f.name: data.oMf[i].homogeneous for i, f in enumerate(model.frames)})
    assert all(np.allclose(T, frames[1][name]) for name, T in frames[0].items())


def test_tcp_lies_between_the_finger_tips(robot):
    q = robot.named("home")
    links = robot.link_poses(q)
    assert np.allclose(robot.fk(q), links["panda_hand_tcp"])
    fingers = (links["panda_leftfinger"][:3, 3] + links["panda_rightfinger"][:3, 3]) / 2
    hand = links["panda_hand"]
    assert np.allclose(np.cross(fingers - hand[:3, 3], hand[:3, 2]), 0, atol=1e-6)
    assert np.isclose(np.linalg.norm(robot.fk(q)[:3, 3] - links["panda_link8"][:3, 3]), 0.1034, atol=1e-4)


def test_link_poses_of_the_fingers_follow_their_positions(robot):
    for positions, apart in (({"panda_finger_joint1": 0.0, "panda_finger_joint2": 0.0}, 0.0), ({}, 0.08)):
        links = robot.link_poses(robot.named("home"), positions)
        away = links["panda_leftfinger"][:3, 3] - links["panda_rightfinger"][:3, 3]
        assert np.isclose(np.linalg.norm(away), apart)
    assert set(robot.link_parents) == set(links) - {"panda_link0"}
    assert set(robot.link_parents.values()) <= set(links)


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


@pytest.mark.parametrize(("change", "message"), [
    ({"urdf": "package://no-such-package/x.urdf"}, "robot.urdf.*no-such-package.*pip install no-such-package"),
    ({"urdf": "/nowhere/robot.urdf"}, "robot.urdf.*/nowhere/robot.urdf"),
    ({"tcp_link": "thumb"}, "robot.tcp_link.*thumb.*panda_hand_tcp"),
    ({"locked_joints": {}}, "robot.locked_joints.*panda_finger_joint1"),
    ({"locked_joints": {"thumb": 0.0}}, "thumb.*not a joint"),
    ({"named_poses": {"home": [9.0, 0, 0, -1, 0, 1, 0]}}, "robot.named_poses.home.*panda_joint1"),
    ({"joints": [CONFIG.joints[1], CONFIG.joints[0], *CONFIG.joints[2:]]}, r"robot\.joints"),
])
def test_invalid_robot_file_is_refused_with_field_and_choices(change, message):
    with pytest.raises(ConfigError, match=message):
        RobotModel.load(RobotConfig.model_validate(CONFIG.model_dump() | change))


def test_description_that_does_not_parse_is_named(tmp_path):
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "robot.urdf").write_text("<robot")
    change = {"urdf": "package://broken/robot.urdf", "package_dirs": [str(tmp_path)]}
    with pytest.raises(ConfigError, match="does not parse"):
        RobotModel.load(RobotConfig.model_validate(CONFIG.model_dump() | change))
