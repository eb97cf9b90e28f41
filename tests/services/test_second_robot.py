"""Executor of a UR5 that does not stand at the origin, with a gripper of six joints."""


import numpy as np
import pytest

from common.atomic_file import STATE_VARIABLE
from common.config import load_cell
from common.errors import RemoteError
from common.messages import GripperCommand, JointState, Vector3
from common.robot.finger_joints import finger_positions
from common.robot.model import RobotModel
from common.sim.objects import centre_of
from tests.services.executor_rig import executor, move
from tests.services.fake_cell import latest, until

OVERRIDES = ("robot=ur5", "services.trajectory_executor.tolerances={path: 0.2, goal: 0.1, stopped_velocity: 0.2}")
CELL = load_cell("panda", OVERRIDES, world="w2")
GRIPPER = CELL.robot.gripper
assert GRIPPER is not None


def ur5():
    return executor(*OVERRIDES, world="w2")


async def test_fingers_close_together_within_the_speed_of_their_knuckle() -> None:
    async with ur5() as client:
        rejected = await client.command.call(GripperCommand(id="squash", width=0.0, effort=300.0))
        assert rejected.state == "rejected" and "effort 300 N" in rejected.message and "235 N" in rejected.message
        await client.command.call(GripperCommand(id="close", width=0.0, effort=50.0))
        states: list[JointState] = []
        while not states or (client.gripper.latest.id, client.gripper.latest.state) != ("close", "succeeded"):
            states.append(await until(client.joints))
        done, last = client.gripper.latest, await until(client.joints)
    assert last.name[6:] == GRIPPER.joints and done.source == "gripper_position_controller"
    assert done.position == pytest.approx(0.8, abs=1e-5) and (done.width, done.effort) == (0.0, 0.0)
    assert last.position[6:] == pytest.approx(finger_positions(GRIPPER, 0.0), abs=1e-6)
    assert 0.4 < max(abs(state.velocity[6]) for state in states) <= 0.5 + 1e-6
    assert (np.diff([state.position[6] for state in states]) >= 0).all()
    for state in states:
        assert state.position[6:] == pytest.approx([f * state.position[6] for f in GRIPPER.mimic], abs=1e-12)


async def test_trajectory_is_followed_and_status_names_its_controller() -> None:
    robot = RobotModel.load(CELL.robot)
    home, there = robot.named("home"), robot.named("default")
    async with ur5() as client:
        done = await client.follow("up", move(robot, home, there))
        joints = await client.joints.next()
        again = await client.start("again", move(robot, home, there))
    assert done.source == "joint_trajectory_controller" and joints.position[:6] == pytest.approx(there, abs=1e-6)
    assert (again.state, again.error, again.source) == ("rejected", "start_mismatch", "joint_trajectory_controller")


async def test_edited_objects_are_like_the_first_of_the_world_and_persist_over_a_restart(monkeypatch, tmp_path):
    monkeypatch.setenv(STATE_VARIABLE, str(tmp_path))
    async with ur5() as client:
        with pytest.raises(RemoteError, match="would overlap cube"):
            await client.edit(op="add", position=Vector3(x=0.5, y=0.0))
        assert (await client.edit(op="add", position=Vector3(x=0.5, y=0.2))).ids == ["cube", "cube_1"]
        first, second = (await latest(client.objects, lambda found: len(found.objects) == 2)).objects
        assert (second.shape, second.size, second.color, second.base) == ("box", first.size, first.color, 1.0)
        reply = await client.edit(op="move", id="cube", position=Vector3(x=0.55, y=0.05))
        assert (reply.id, reply.ids) == ("cube", ["cube", "cube_1"])
        moved = await latest(
            client.objects, lambda found: centre_of(found.objects[0])[:2] == pytest.approx((0.55, 0.05)))
        with pytest.raises(RemoteError, match="not on the table for cube") as refusal:
            await client.edit(op="move", id="cube", position=Vector3(x=0.9, y=0.1))
        assert refusal.value.code == "off_table"
    async with ur5() as client:
        again = await latest(client.objects)
    np.testing.assert_allclose(again.objects[0].outline, moved.objects[0].outline, atol=1e-12)
