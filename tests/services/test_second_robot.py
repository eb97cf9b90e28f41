"""The controller and the frames of a robot that does not stand at the origin, with a gripper of six joints."""

import asyncio
from contextlib import asynccontextmanager
from pathlib import Path

import numpy as np
import pytest

from common import topics
from common.atomic_file import STATE_VARIABLE
from common.clock import Clock
from common.config import load_cell, service_config
from common.errors import RemoteError
from common.messages import ExecuteRequest, GripperCommand, JointState, TFMessage, Vector3, WorldEdit
from common.process.in_process import running_service
from common.robot.finger_joints import finger_positions
from common.robot.model import RobotModel
from common.robot.transforms import pose_to_matrix
from common.sim.objects import centre_of
from common.transport.local import LocalNetwork
from services import robot_state_publisher, trajectory_executor
from tests.services.test_trajectory_executor import move

SEED_TOLERANCES = "services.trajectory_executor.tolerances={path: 0.2, goal: 0.1, stopped_velocity: 0.2}"
CELL = load_cell("panda", ["robot=ur5", SEED_TOLERANCES], world="w2")
SPEED = 10.0
assert CELL.robot.gripper is not None
GRIPPER = CELL.robot.gripper


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    return RobotModel.load(CELL.robot)


@asynccontextmanager
async def executor(**parameters):
    net, clock = LocalNetwork(), Clock(SPEED)
    config = service_config(CELL, "trajectory_executor", trajectory_executor.Config).model_copy(update=parameters)
    async with running_service(net, trajectory_executor.run, config, name="trajectory_executor", clock=clock):
        yield net.bus("tester", clock=clock)


async def see(reader, test):
    """The first message for which test is true."""
    async with asyncio.timeout(20):
        message = reader.latest
        while message is None or not test(message):
            message = await reader.next()
        return message


async def test_it_starts_at_home_with_open_fingers_and_tells_every_joint(robot: RobotModel) -> None:
    async with executor() as bus:
        joints = await see(bus.reader(topics.JOINT_STATES), lambda m: True)
        gripper = await see(bus.reader(topics.GRIPPER_STATE), lambda m: True)
        objects = await see(bus.reader(topics.SCENE_OBJECTS), lambda m: True)
    assert joints.name == [*robot.joint_names, *GRIPPER.joints]
    assert joints.position == pytest.approx([*robot.named("home"), *[0.0] * 6], abs=1e-5)
    assert (gripper.width, gripper.source) == (0.085, "gripper_position_controller")
    assert [o.id for o in objects.objects] == ["cube"]


async def test_fingers_close_together_within_the_speed_of_their_knuckle() -> None:
    async with executor() as bus:
        joints, gripper = bus.reader(topics.JOINT_STATES), bus.reader(topics.GRIPPER_STATE)
        command = bus.client(topics.GRIPPER_COMMAND)
        refused = await command.call(GripperCommand(id="squash", width=0.0, effort=300.0))
        assert refused.state == "rejected" and "effort 300 N" in refused.message and "235 N" in refused.message
        await command.call(GripperCommand(id="close", width=0.0, effort=50.0))
        seen: list[JointState] = []
        async with asyncio.timeout(20):
            while not seen or gripper.latest.state != "succeeded" or gripper.latest.id != "close":
                seen.append(await joints.next())
        done, last = gripper.latest, await joints.next()
    assert done.position == pytest.approx(0.8, abs=1e-5) and (done.width, done.effort) == (0.0, 0.0)
    assert last.position[6:] == pytest.approx(finger_positions(GRIPPER, 0.0), abs=1e-6)
    knuckle = np.array([state.position[6] for state in seen])
    fastest = max(abs(state.velocity[6]) for state in seen)
    assert 0.4 < fastest <= 0.5 + 1e-6 and (np.diff(knuckle) >= 0).all()
    for state in seen:
        assert state.position[6:] == pytest.approx([f * state.position[6] for f in GRIPPER.mimic], abs=1e-12)


async def test_it_follows_a_trajectory_and_signs_with_its_name(robot: RobotModel) -> None:
    home, there = robot.named("home"), robot.named("default")
    async with executor() as bus:
        motion, execute = bus.reader(topics.MOTION_STATUS), bus.client(topics.MOTION_EXECUTE)
        answer = await execute.call(ExecuteRequest(header=bus.header(), id="up", trajectory=move(robot, home, there)))
        assert answer.state == "active", answer.message
        done = await see(motion, lambda m: m.id == "up" and m.state != "active")
        joints = await bus.reader(topics.JOINT_STATES).next()
        again = await execute.call(ExecuteRequest(header=bus.header(), id="again", trajectory=move(robot, home, there)))
    assert (done.state, done.source) == ("succeeded", "joint_trajectory_controller")
    assert joints.position[:6] == pytest.approx(there, abs=1e-6)
    assert (again.state, again.error, again.source) == ("rejected", "start_mismatch", "joint_trajectory_controller")


async def test_what_is_added_without_a_shape_is_like_the_first_object_of_the_world() -> None:
    async with executor() as bus:
        edit = bus.client(topics.WORLD_EDIT)
        with pytest.raises(RemoteError, match="would overlap cube"):
            await edit.call(WorldEdit(op="add", position=Vector3(x=0.5, y=0.0)))
        reply = await edit.call(WorldEdit(op="add", position=Vector3(x=0.5, y=0.2)))
        assert reply.ids == ["cube", "cube_1"]
        objects = await see(bus.reader(topics.SCENE_OBJECTS), lambda m: len(m.objects) == 2)
    first, second = objects.objects
    assert (second.shape, second.size, second.color, second.base) == ("box", first.size, first.color, 1.0)


async def test_object_that_is_moved_stands_there_and_still_does_when_the_process_is_started_again(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv(STATE_VARIABLE, str(tmp_path))
    async with executor() as bus:
        objects = bus.reader(topics.SCENE_OBJECTS)
        edit = bus.client(topics.WORLD_EDIT)
        reply = await edit.call(WorldEdit(op="move", id="cube", position=Vector3(x=0.55, y=0.1)))
        assert (reply.id, reply.ids) == ("cube", ["cube"])
        moved = await see(objects, lambda m: centre_of(m.objects[0])[:2] == pytest.approx((0.55, 0.1)))
        with pytest.raises(RemoteError, match="not on the table for cube") as refusal:
            await edit.call(WorldEdit(op="move", id="cube", position=Vector3(x=0.9, y=0.1)))
        assert refusal.value.code == "off_table"
    async with executor() as bus:
        again = await see(bus.reader(topics.SCENE_OBJECTS), lambda m: True)
    np.testing.assert_allclose(again.objects[0].outline, moved.objects[0].outline, atol=1e-12)


async def test_frames_agree_with_forward_kinematics_from_world_to_the_finger_tips(robot: RobotModel) -> None:
    net = LocalNetwork()
    bus = net.bus()
    config = service_config(CELL, "robot_state_publisher", robot_state_publisher.Config)
    fingers = finger_positions(GRIPPER, 0.03)
    async with running_service(net, robot_state_publisher.run, config), asyncio.timeout(30):
        tf, static = bus.reader(topics.TF), bus.reader(topics.TF_STATIC)
        q = robot.named("home") + 0.1
        state = JointState(header=bus.header("world"), name=[*robot.joint_names, *GRIPPER.joints],
                           position=[*q, *fingers])
        bus.writer(topics.JOINT_STATES).put(state)
        tree: dict[str, tuple[str, np.ndarray]] = {}
        messages: list[TFMessage] = [await tf.next(), await static.next()]
    for transform in (t for message in messages for t in message.transforms):
        assert transform.child_frame_id not in tree
        tree[transform.child_frame_id] = transform.header.frame_id, pose_to_matrix(transform.transform)
    assert set(tree) == {*robot.link_names, "depth_camera_optical_frame"}
    assert tree["base_link"][0] == "world" and tree["base_link"][1][2, 3] == pytest.approx(0.75)
    for link, T in robot.link_poses(q, dict(zip(GRIPPER.joints, fingers, strict=True))).items():
        T_world_link, frame = np.eye(4), link
        while frame != "world":
            frame, T_parent_frame = tree[frame]
            T_world_link = T_parent_frame @ T_world_link
        assert np.allclose(T_world_link, T, atol=1e-6), link
