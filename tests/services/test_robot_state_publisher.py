import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import numpy as np
import pytest

from common import topics
from common.clock import Clock
from common.config import load_cell, service_config
from common.messages import Header, JointState, TFMessage
from common.process.in_process import running_service
from common.robot.model import RobotModel
from common.robot.transforms import pose_to_matrix
from common.supervision.wiring import wiring
from common.transport.local import LocalNetwork
from services import robot_state_publisher

CELL = load_cell("panda")
CONFIG = service_config(CELL, "robot_state_publisher", robot_state_publisher.Config)
ROBOT = RobotModel.load(CELL.robot)
HOME = ROBOT.named("home").tolist()
ARM = [f"panda_joint{i}" for i in range(1, 8)]
FINGERS = ["panda_finger_joint1", "panda_finger_joint2"]


class User:
    """Publishes joint states and reads tf."""

    def __init__(self, net: LocalNetwork) -> None:
        self.bus = net.bus(clock=Clock())
        self.tf, self.static = self.bus.reader(topics.TF), self.bus.reader(topics.TF_STATIC)
        self.joints = self.bus.writer(topics.JOINT_STATES)
        self.log: logging.Logger

    def put(self, stamp: int, position: list[float] = HOME, names: list[str] = ARM) -> None:
        self.joints.put(JointState(header=Header(stamp=stamp), name=names, position=position))


@asynccontextmanager
async def publisher() -> AsyncIterator[User]:
    net = LocalNetwork()
    async with running_service(net, robot_state_publisher.run, CONFIG) as service, asyncio.timeout(30):
        user = User(net)
        user.log = service.log
        yield user


def chain(messages: list[TFMessage], frame: str) -> np.ndarray:
    """(4, 4) pose of the frame in world, following the tree."""
    tree = {t.child_frame_id: t for message in messages for t in message.transforms}
    T = np.eye(4)
    while frame != "world":
        T = pose_to_matrix(tree[frame].transform) @ T
        frame = tree[frame].header.frame_id
    return T


async def test_wiring_is_joint_states_to_tf_and_the_description() -> None:
    found = await wiring(robot_state_publisher.run, CONFIG)
    assert found.reads == {topics.JOINT_STATES} and not found.serves
    assert found.writes == {topics.TF, topics.TF_STATIC, topics.ROBOT_DESCRIPTION}


async def test_frames_agree_with_forward_kinematics_and_each_has_one_parent() -> None:
    async with publisher() as user:
        q = ROBOT.named("home") + 0.1
        user.put(7 * 10**9, [*q, 0.01, 0.01], ARM + FINGERS)
        moving, fixed = await user.tf.next(), await user.static.next()
    children = [t.child_frame_id for t in moving.transforms + fixed.transforms]
    assert len(children) == len(set(children)) and set(children) == {*ROBOT.link_names, "camera_optical_frame"}
    assert all(t.header.stamp == 7 * 10**9 for t in moving.transforms)
    for link, T in ROBOT.link_poses(q, dict.fromkeys(FINGERS, 0.01)).items():
        assert np.allclose(chain([moving, fixed], link), T, atol=1e-6), link
    assert np.allclose(chain([moving, fixed], "panda_hand_tcp"), ROBOT.fk(q), atol=1e-6)


async def test_camera_frame_looks_straight_down_and_is_right_handed() -> None:
    async with publisher() as user:
        T = chain([await user.static.next()], "camera_optical_frame")
    assert np.allclose(T[:3, :3], np.column_stack([(0, -1, 0), (-1, 0, 0), (0, 0, -1)]))
    assert np.allclose(T[:3, 3], (0.40, 0.0, 0.80)) and np.linalg.det(T[:3, :3]) == pytest.approx(1.0)


async def test_tf_has_half_the_rate_of_joint_states() -> None:
    seen = []
    async with publisher() as user:
        start = user.bus.header().stamp
        for number in range(20):
            user.put(start + number * 10_000_000)
            if number % 2 == 0:
                seen.append(await user.tf.next())
            else:
                await asyncio.sleep(0)
    assert [t.transforms[0].header.stamp for t in seen] == [start + n * 10_000_000 for n in range(0, 20, 2)]


async def test_state_of_another_robot_is_skipped_with_one_warning() -> None:
    warned, lines = asyncio.Event(), []

    class Recorder(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            lines.append(record.getMessage())
            warned.set()

    async with publisher() as user:
        user.log.addHandler(recorder := Recorder(logging.WARNING))
        for number in range(3):
            user.put((1 + number) * 10**9, [0.0], ["shoulder_pan_joint"])
            await warned.wait()
        user.put(10**10)
        assert (await user.tf.next()).transforms[0].header.stamp == 10**10
        user.log.removeHandler(recorder)
    assert lines == ["joint_states has only shoulder_pan_joint: a joint of the arm is missing"]


async def test_older_stamps_of_a_restarted_executor_are_accepted() -> None:
    async with publisher() as user:
        for stamp in (10**12, 10**11):
            user.put(stamp)
            assert (await user.tf.next()).transforms[0].header.stamp == stamp
