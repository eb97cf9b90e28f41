import asyncio
import logging

import numpy as np
import pytest

from common import topics
from common.clock import Clock
from common.config import load_cell, service_config
from common.messages import JointState, TFMessage
from common.process.in_process import running_service
from common.robot.model import RobotModel
from common.robot.transforms import pose_to_matrix
from common.supervision.wiring import wiring
from common.transport.local import LocalNetwork
from services import robot_state_publisher
from services.robot_state_publisher import Config

ARM = [f"panda_joint{i}" for i in range(1, 8)]
FINGERS = ["panda_finger_joint1", "panda_finger_joint2"]


def config() -> Config:
    return service_config(load_cell("panda"), "robot_state_publisher", Config)


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    return RobotModel.load(load_cell("panda").robot)


def chain(messages: list[TFMessage], frame: str) -> np.ndarray:
    """(4, 4) pose of the frame in world, following the tree."""
    tree = {t.child_frame_id: t for message in messages for t in message.transforms}
    T = np.eye(4)
    while frame != "world":
        T = pose_to_matrix(tree[frame].transform) @ T
        frame = tree[frame].header.frame_id
    return T


async def test_it_reads_joint_states_and_writes_tf_and_what_the_robot_is() -> None:
    found = await wiring(robot_state_publisher.run, config())
    assert found.reads == {topics.JOINT_STATES} and not found.serves
    assert found.writes == {topics.TF, topics.TF_STATIC, topics.ROBOT_DESCRIPTION}


async def test_frames_agree_with_forward_kinematics_and_each_has_one_parent(robot: RobotModel) -> None:
    net = LocalNetwork()
    bus = net.bus()
    async with running_service(net, robot_state_publisher.run, config()), asyncio.timeout(30):
        tf, static = bus.reader(topics.TF), bus.reader(topics.TF_STATIC)
        q = robot.named("home") + 0.1
        header = bus.header("world")
        bus.writer(topics.JOINT_STATES).put(JointState(header=header, name=ARM + FINGERS, position=[*q, 0.01, 0.01]))
        moving, fixed = await tf.next(), await static.next()
    children = [t.child_frame_id for t in moving.transforms + fixed.transforms]
    assert len(children) == len(set(children)) and set(children) == {*robot.link_names, "camera_optical_frame"}
    assert all(t.header.stamp == header.stamp for t in moving.transforms)
    poses = robot.link_poses(q, dict.fromkeys(FINGERS, 0.01))
    for link, T in poses.items():
        assert np.allclose(chain([moving, fixed], link), T, atol=1e-6), link
    assert np.allclose(chain([moving, fixed], "panda_hand_tcp"), robot.fk(q), atol=1e-6)


async def test_camera_looks_straight_down_and_is_no_mirror() -> None:
    net = LocalNetwork()
    bus = net.bus()
    async with running_service(net, robot_state_publisher.run, config()), asyncio.timeout(30):
        T = chain([await bus.reader(topics.TF_STATIC).next()], "camera_optical_frame")
    assert np.allclose(T[:3, :3], np.column_stack([(0, -1, 0), (-1, 0, 0), (0, 0, -1)]))
    assert np.allclose(T[:3, 3], (0.40, 0.0, 0.80)) and np.linalg.det(T[:3, :3]) == pytest.approx(1.0)


async def test_messages_come_at_half_the_rate_of_joint_states(robot: RobotModel) -> None:
    net = LocalNetwork()
    bus = net.bus(clock=Clock())
    seen = []
    async with running_service(net, robot_state_publisher.run, config()), asyncio.timeout(30):
        tf, joints = bus.reader(topics.TF), bus.writer(topics.JOINT_STATES)
        start = bus.header().stamp
        for number in range(20):
            header = bus.header().model_copy(update={"stamp": start + number * 10_000_000})
            joints.put(JointState(header=header, name=ARM, position=robot.named("home").tolist()))
            if number % 2 == 0:
                seen.append(await tf.next())
            else:
                await asyncio.sleep(0)
    assert [t.transforms[0].header.stamp for t in seen] == [start + n * 10_000_000 for n in range(0, 20, 2)]


async def test_state_of_another_robot_is_told_once_and_skipped(robot: RobotModel) -> None:
    net = LocalNetwork()
    bus = net.bus()
    told, lines = asyncio.Event(), []

    class Note(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            lines.append(record.getMessage())
            told.set()

    async with running_service(net, robot_state_publisher.run, config()) as service, asyncio.timeout(30):
        service.log.addHandler(note := Note(logging.WARNING))
        tf, joints = bus.reader(topics.TF), bus.writer(topics.JOINT_STATES)
        start = bus.header().stamp
        for number in range(3):
            header = bus.header().model_copy(update={"stamp": start + number * 10**9})
            joints.put(JointState(header=header, name=["shoulder_pan_joint"], position=[0.0]))
            await told.wait()
        header = header.model_copy(update={"stamp": start + 10**10})
        joints.put(JointState(header=header, name=ARM, position=robot.named("home").tolist()))
        assert (await tf.next()).transforms[0].header.stamp == header.stamp
        service.log.removeHandler(note)
    assert lines == ["joint_states has shoulder_pan_joint: a joint of the arm is missing"]


async def test_restarted_executor_with_older_stamps_is_followed(robot: RobotModel) -> None:
    net = LocalNetwork()
    bus = net.bus()
    async with running_service(net, robot_state_publisher.run, config()), asyncio.timeout(30):
        tf, joints = bus.reader(topics.TF), bus.writer(topics.JOINT_STATES)
        for stamp in (10**12, 10**11):
            header = bus.header().model_copy(update={"stamp": stamp})
            joints.put(JointState(header=header, name=ARM, position=robot.named("home").tolist()))
            assert (await tf.next()).transforms[0].header.stamp == stamp
