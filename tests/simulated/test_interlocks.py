"""Interlocks of operators in complete cells survive restarts of processes."""

import asyncio

import pytest

from applications.pick_place.topics import PICK_PLACE_STATUS, PickPlaceStatus
from common import topics
from common.client.operator_motion import MotionFailed, OperatorMotion
from common.errors import RemoteError
from common.messages import JointGoal, ParameterRequest, StopRequest, TaskCommand
from common.transport.bus import Bus, Reader
from tests.harness import until
from tests.simulated.test_pausing import assert_still, held, moves
from tests.simulated.visited import SimulatedCell

TASK, EXECUTOR = "smart_pick_place", "trajectory_executor"


async def command(bus: Bus, order: str, by: str, override: bool = False) -> None:
    asked = TaskCommand.model_validate({"command": order, "by": by, "override": override})
    await bus.client(topics.TASK_COMMAND).call(asked, 10.0)


async def again(cell: SimulatedCell, bus: Bus, *names: str) -> None:
    """Kill processes at once; return when they are ready again."""
    for name in names:
        cell.kill(name)
    for name in names:
        await bus.alive.wait(name, there=False)
    for name in names:
        await bus.alive.wait(name)


async def moving(cell: SimulatedCell, bus: Bus, status: Reader[PickPlaceStatus], stage: str) -> None:
    await until(status, lambda s: s.stage == stage, 90)
    await until(bus.reader(topics.JOINT_STATES), lambda s: moves(cell, s))


async def assert_standstill(cell: SimulatedCell, bus: Bus) -> None:
    """Check standstill for five seconds, in which every service has time to start."""
    joints = bus.reader(topics.JOINT_STATES)
    first = await assert_still(cell, joints, bus.clock.now_ns())
    await asyncio.sleep(5.0)
    assert await assert_still(cell, joints, bus.clock.now_ns()) == first


@pytest.mark.slow
def test_stopped_robot_stays_stopped_over_restarts_until_an_operator_starts_it() -> None:
    async def visit(cell: SimulatedCell, bus: Bus) -> None:
        motion, status = bus.reader(topics.MOTION_STATUS), bus.reader(PICK_PLACE_STATUS)
        await moving(cell, bus, status, "pre-grasp")
        # The page asks the executor itself; the task hangs, and a watchdog kills it.
        answer = await bus.client(topics.MOTION_STOP).call(StopRequest(reason="smoke", owner="anna"))
        assert answer.stopped.endswith("UTC by anna (smoke)")
        cell.kill(TASK)
        stopped = await until(status, lambda s: not s.started and "by anna (smoke): start to go on" in s.message)
        assert stopped.state == "IDLE" and not stopped.paused
        await assert_standstill(cell, bus)
        await again(cell, bus, TASK, EXECUTOR)
        await assert_standstill(cell, bus)
        with pytest.raises(RemoteError, match=r"stopped since .* by anna .*: start the task"):
            await command(bus, "resume", "anna")
        with pytest.raises(MotionFailed, match=r"the robot is stopped since .* by anna"):
            await OperatorMotion(bus, [status], "bert").move(JointGoal(named="home"))
        there = await OperatorMotion(bus, [status], "anna").move(JointGoal(named="home"))
        assert there.state == "succeeded" and there.stopped, "only the operator who stopped it may move it"
        await again(cell, bus, TASK)
        await assert_standstill(cell, bus)
        await command(bus, "start", "bert")
        # Reported by the task, which then dies: with autostart it must not start by itself either.
        await moving(cell, bus, status, "pre-grasp")
        await command(bus, "stop", "bert")
        assert motion.latest is not None and "by bert" in (await until(motion, lambda m: bool(m.stopped))).stopped
        await again(cell, bus, TASK)
        await until(status, lambda s: not s.started and "by bert" in s.message)
        await assert_standstill(cell, bus)
        await command(bus, "start", "anna")
        assert not (await until(motion, lambda m: not m.interlocks)).stopped

    summary = SimulatedCell("panda", ["world.count=1"], visit=visit).summary
    assert summary["truth"]["in_box"] == 1 and summary["failures"] == 0


@pytest.mark.slow
def test_operators_hold_and_speed_survive_restarts_and_only_the_operator_releases_them() -> None:
    path = "services.trajectory_executor.speed_scaling"

    async def visit(cell: SimulatedCell, bus: Bus) -> None:
        motion, status = bus.reader(topics.MOTION_STATUS), bus.reader(PICK_PLACE_STATUS)
        await moving(cell, bus, status, "across")
        await bus.client(topics.parameters_of(EXECUTOR)).call(ParameterRequest(set={path: 0.05}, by="anna"))
        await command(bus, "pause", "anna")
        await held(motion)
        await again(cell, bus, EXECUTOR)
        found = await until(motion, lambda m: m.state == "none")
        assert found.held and [hold.by for hold in found.interlocks] == ["anna"] and found.speed_scaling == 0.05
        await assert_standstill(cell, bus)
        await again(cell, bus, TASK, EXECUTOR)
        assert "by anna" in (await until(status, lambda s: s.paused and "found held" in s.message)).message
        await assert_standstill(cell, bus)
        for order in ("resume", "start"):
            with pytest.raises(RemoteError, match=r"held since .* by anna .*: only they can release it, unless"):
                await command(bus, order, "bert")
        with pytest.raises(MotionFailed):
            await OperatorMotion(bus, [], "bert").move(JointGoal(named="home"))
        await assert_standstill(cell, bus)
        await bus.client(topics.parameters_of(EXECUTOR)).call(ParameterRequest(set={path: 1.0}, by="anna"))
        await command(bus, "resume", "bert", override=True)
        await until(motion, lambda m: not m.held)
        assert any("bert released an interlock of another operator: held since" in line for line in cell.lines)

    summary = SimulatedCell("panda", ["world.count=1"], visit=visit).summary
    assert summary["state"] == "DONE"
