from collections.abc import AsyncIterator

import numpy as np
import pytest

from common import messages as m
from common import topics
from common.config import Cell as LoadedCell
from common.config import load_cell, service_config
from common.robot.finger_joints import finger_positions
from common.robot.model import RobotModel
from common.robot.transforms import pose_to_matrix
from services import robot_state_publisher
from tests.services.fake_cell import FakeCell, settle, until

CELL, UR5 = load_cell("panda"), load_cell("panda", ["robot=ur5"], world="w2")
CONFIG = service_config(CELL, "robot_state_publisher", robot_state_publisher.Config)
HOME = CELL.robot.named_poses["home"]
ARM = [f"panda_joint{i}" for i in range(1, 8)]


class Cell(FakeCell):
    def __init__(self) -> None:
        super().__init__()
        self.config: robot_state_publisher.Config
        self.tf, self.static = self.reader(topics.TF), self.reader(topics.TF_STATIC)


@pytest.fixture
async def cell() -> AsyncIterator[Cell]:
    made = Cell()
    made.config = CONFIG.model_copy()
    async with made.running(robot_state_publisher, made.config):
        yield made


def pose_in_world(tree: dict[str, m.TransformStamped], frame: str) -> np.ndarray:
    """Return the (4, 4) pose of a frame in world, following the tree."""
    T = np.eye(4)
    while frame != "world":
        T = pose_to_matrix(tree[frame].transform) @ T
        frame = tree[frame].header.frame_id
    return T


@pytest.mark.parametrize(("loaded", "camera"), [(CELL, "camera_optical_frame"), (UR5, "depth_camera_optical_frame")])
async def test_frames_agree_with_forward_kinematics_and_each_has_one_parent(loaded: LoadedCell, camera: str) -> None:
    cell, robot, gripper = Cell(), RobotModel.load(loaded.robot), loaded.robot.gripper
    assert gripper is not None
    q, fingers = robot.named("home") + 0.1, finger_positions(gripper, 0.02)
    config = service_config(loaded, "robot_state_publisher", robot_state_publisher.Config)
    async with cell.running(robot_state_publisher, config):
        cell.put_joints([*robot.joint_names, *gripper.joints], [*q, *fingers], 7 * 10**9)
        moving, fixed = await until(cell.tf), await until(cell.static)
    tree = {t.child_frame_id: t for t in moving.transforms + fixed.transforms}
    assert len(tree) == len(moving.transforms + fixed.transforms) and set(tree) == {*robot.link_names, camera}
    assert all(t.header.stamp == 7 * 10**9 for t in moving.transforms)
    for link, T in robot.link_poses(q, dict(zip(gripper.joints, fingers, strict=True))).items():
        assert np.allclose(pose_in_world(tree, link), T, atol=1e-6), link
    T = pose_in_world(tree, camera)
    assert np.allclose(T[:3, 2], (0, 0, -1)) and np.linalg.det(T[:3, :3]) == pytest.approx(1.0), "looks down"
    if loaded is UR5:
        assert tree["base_link"].header.frame_id == "world" and tree["base_link"].transform.position.z == 0.75
    else:
        assert np.allclose(pose_in_world(tree, "panda_hand_tcp"), robot.fk(q), atol=1e-6)
        assert np.allclose(T[:3, :2], [(0, -1), (-1, 0), (0, 0)]) and np.allclose(T[:3, 3], (0.40, 0.0, 0.80))


async def test_tf_has_half_the_rate_of_joint_states_or_the_rate_set_live(cell: Cell) -> None:
    stamps, start = [], cell.bus.header().stamp
    for number in range(20):
        cell.put_joints(ARM, HOME, start + number * 10_000_000)
        await settle()
        if number % 2 == 0:
            stamps.append((await until(cell.tf)).transforms[0].header.stamp)
    assert stamps == [start + n * 10_000_000 for n in range(0, 20, 2)] and cell.tf.received == 10
    cell.config.rate = 1.0
    for stamp in (start + 10**9, start + 10**9 + 500_000_000, start + 2 * 10**9):
        cell.put_joints(ARM, HOME, stamp)
        await settle()
    assert cell.tf.received == 12, "once a second"


async def test_state_of_another_robot_is_skipped_with_one_warning(cell: Cell) -> None:
    log = cell.reader(topics.LOG)
    for number in range(3):
        cell.put_joints(["shoulder_pan_joint"], [0.0], (1 + number) * 10**9)
        await settle()
    cell.put_joints(ARM, HOME, 10**10)
    assert (await until(cell.tf)).transforms[0].header.stamp == 10**10
    line = await until(log)
    assert line.message == "joint_states has only shoulder_pan_joint: a joint of the arm is missing"
    assert log.received == 1


async def test_older_stamps_of_a_restarted_executor_are_accepted(cell: Cell) -> None:
    for stamp in (10**12, 10**11):
        cell.put_joints(ARM, HOME, stamp)
        assert (await until(cell.tf)).transforms[0].header.stamp == stamp
