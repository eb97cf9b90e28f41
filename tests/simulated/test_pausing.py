"""Pause, resume and stop in complete cells: the joints stop, and a paused motion is completed."""

from __future__ import annotations

from typing import Any

import pytest

from applications.outlining.topics import OUTLINE_STATUS
from applications.pick_place.topics import PICK_PLACE_STATUS
from common import topics
from common.client.operator_motion import MotionFailed, OperatorMotion
from common.messages import JointGoal, JointState, MotionStatus, TaskCommand
from common.transport.bus import Bus, Reader
from tests.harness import until
from tests.simulated.outlined import assert_cube_outlined
from tests.simulated.visited import SimulatedCell

pytestmark = pytest.mark.timeout(600)  # some seconds of work, on a machine that may be busy

STATUS = {"panda": PICK_PLACE_STATUS, "ur5": OUTLINE_STATUS}
STILL = 30  # joint states in a row


async def send(bus: Bus, command: str) -> None:
    await bus.client(topics.TASK_COMMAND).call(TaskCommand.model_validate({"command": command}), 10.0)


def moves(cell: SimulatedCell, state: JointState) -> bool:
    speed = dict(zip(state.name, state.velocity, strict=True))
    return any(abs(speed[name]) > 0.02 for name in cell.cell.robot.joints)


async def held(motion: Reader[MotionStatus]) -> MotionStatus:
    return await until(motion, lambda m: m.held and not m.message.startswith("coming to rest"))


async def assert_still(cell: SimulatedCell, joints: Reader[JointState], after: int) -> list[float]:
    """The positions of the arm, which do not change from a time [ns] on."""
    count, seen = len(cell.cell.robot.joints), set()
    await until(joints, lambda s: s.header.stamp > after)
    for _ in range(STILL):
        seen.add(tuple((await joints.next()).position[:count]))
    assert len(seen) == 1
    return list(seen.pop())


async def pause_in_motion(cell: SimulatedCell, bus: Bus, stage: str) -> Any:
    """The status when all is done; before, pause while the arm moves in a stage, look, and resume."""
    joints, motion = bus.reader(topics.JOINT_STATES), bus.reader(topics.MOTION_STATUS)
    status = bus.reader(STATUS[cell.cell.name])
    await until(status, lambda s: s.stage == stage, 90)
    await until(joints, lambda s: moves(cell, s))
    await send(bus, "pause")
    at_rest = await held(motion)
    assert at_rest.state == "active" and 0 < at_rest.progress < 1, at_rest
    assert (await until(status, lambda s: s.paused)).stage == stage
    await assert_still(cell, joints, at_rest.header.stamp)
    with pytest.raises(MotionFailed, match=r"is paused.*stop the task first"):
        await OperatorMotion(bus, [status]).move(JointGoal(named="home"))
    await send(bus, "resume")
    ended = await until(motion, lambda m: m.id != at_rest.id or m.state != "active")
    assert (ended.id, ended.state) == (at_rest.id, "succeeded"), "the same motion resumes"
    return await until(status, lambda s: s.state in ("DONE", "ERROR"), 120)


@pytest.mark.slow
def test_paused_panda_resumes_and_places_every_ball() -> None:
    async def visit(cell: SimulatedCell, bus: Bus) -> None:
        await pause_in_motion(cell, bus, "across")

    summary = SimulatedCell("panda", ["world.count=2"], visit=visit).summary
    assert summary["state"] == "DONE"
    assert summary["truth"] == {"in_box": 2, "on_table": 0, "elsewhere": 0, "containers": {"box": 2}}
    assert (summary["failures"], summary["retries"]) == (0, 0)
    assert summary["seconds"]["moving"] < summary["seconds"]["task"]


@pytest.mark.slow
def test_ur5_paused_while_tracing_resumes_the_same_trace() -> None:
    async def visit(cell: SimulatedCell, bus: Bus) -> None:
        status = await pause_in_motion(cell, bus, "trace")
        assert status.closed and (status.object, status.failures) == ("Object_0", 0)

    summary = SimulatedCell("ur5", world="w2", visit=visit).summary
    assert_cube_outlined(summary)
    assert summary["seconds"]["moving"] < summary["seconds"]["task"]


@pytest.mark.slow
def test_robot_stays_held_when_a_paused_task_dies_until_resume() -> None:
    async def visit(cell: SimulatedCell, bus: Bus) -> None:
        joints, motion = bus.reader(topics.JOINT_STATES), bus.reader(topics.MOTION_STATUS)
        status = bus.reader(PICK_PLACE_STATUS)
        await until(status, lambda s: s.stage == "across", 90)
        await until(joints, lambda s: moves(cell, s))
        await send(bus, "pause")
        at_rest = await held(motion)
        assert at_rest.state == "active" and 0 < at_rest.progress < 1, at_rest
        cell.kill("smart_pick_place")
        found = await until(status, lambda s: s.paused and "found held" in s.message)
        assert found.stage == "" and found.started
        await assert_still(cell, joints, at_rest.header.stamp)
        await send(bus, "resume")
        ended = await until(motion, lambda m: m.id != at_rest.id or m.state != "active")
        assert (ended.id, ended.state) == (at_rest.id, "succeeded"), "the same motion resumes"

    summary = SimulatedCell("panda", ["world.count=1"], visit=visit).summary
    assert summary["truth"]["in_box"] == 1 and summary["restarts"] == {"smart_pick_place": 1}


@pytest.mark.slow
def test_operator_moves_a_stopped_robot_home_and_starts_the_task() -> None:
    async def visit(cell: SimulatedCell, bus: Bus) -> None:
        joints, motion = bus.reader(topics.JOINT_STATES), bus.reader(topics.MOTION_STATUS)
        status = bus.reader(PICK_PLACE_STATUS)
        operator = OperatorMotion(bus, [status])
        await until(status, lambda s: s.stage == "pre-grasp", 90)
        with pytest.raises(MotionFailed, match=r"the task is GRASPING .*stop the task first"):
            await operator.move(JointGoal(named="home"))
        await until(motion, lambda m: m.state == "active")
        await send(bus, "pause")
        await held(motion)
        await send(bus, "stop")
        stopped = await until(motion, lambda m: m.state == "cancelled")
        assert stopped.held, "until the next start"
        await operator.move(JointGoal(named="home"))
        there = await assert_still(cell, joints, (motion.latest or stopped).header.stamp)
        assert there == pytest.approx(cell.cell.robot.named_poses["home"], abs=1e-3)
        await send(bus, "start")

    assert SimulatedCell("panda", ["world.count=1"], visit=visit).summary["truth"]["in_box"] == 1
