"""Arm and gripper of the Python client in complete simulated cells."""

from __future__ import annotations

import asyncio
from typing import Any

import numpy as np
import pytest

from common import topics
from common.client import operator_motion
from common.client.cell import Cell
from common.client.goals import any_of, pose, region, through
from common.client.operator_motion import JogFailed, MotionFailed
from common.errors import ConfigError, RemoteError, UnknownName, ZencellError
from common.messages import JointGoal, StopRequest
from tests.client.simulated_cell import moving, run, standstill

pytestmark = pytest.mark.timeout(600)


def test_arm_is_read_planned_for_and_moved() -> None:
    async def program(cell: Cell) -> None:
        description = await cell.arm.description()
        assert len(description.joints) == 7 and "home" in description.named_poses
        q = await cell.arm.joints()
        assert np.allclose(q, description.named_poses["home"], atol=1e-3)
        T = await cell.arm.pose()
        assert np.allclose(T, await cell.tf("world", "tcp")) and np.allclose(T[2, :3], [0, 0, -1], atol=1e-3)

        plan = await cell.arm.plan(pose(0.45, 0.1, 0.4), speed=0.5)
        assert plan.joints == tuple(description.joints) and np.allclose(plan.positions[0], q, atol=1e-3)
        assert plan.times[0] == 0 and plan.duration > 0.2
        assert np.allclose(await cell.arm.joints(), q, atol=1e-3), "planning moves nothing"
        assert (await cell.arm.execute(plan)).state == "succeeded"
        T = await cell.arm.pose()
        assert np.allclose(T[:3, 3], [0.45, 0.1, 0.4], atol=2e-3) and np.allclose(T[:3, 2], [0, 0, -1], atol=5e-3)

        await cell.arm.move(pose(0.45, -0.1, 0.4), straight=True)
        await cell.arm.move(pose(0.45, 0.1, 0.4), via=(0.5, 0.0, 0.4))
        assert np.allclose((await cell.arm.pose())[:3, 3], [0.45, 0.1, 0.4], atol=2e-3)
        await cell.arm.move(pose(0.45, -0.1, 0.4), around=(0.4, 0.0, 0.4))
        await cell.arm.move(through(pose(0.4, 0.0, 0.4), pose(0.4, 0.1, 0.4), tool_speed=0.1))
        await cell.arm.move(region(pose(0.5, 0.0, 0.4), size=(0.02, 0.02, 0.02), yaw=3.0))
        await cell.arm.move(any_of("home", JointGoal(positions=q.tolist())))
        assert np.allclose(await cell.arm.joints(), q, atol=2e-3)
        assert (await cell.arm.owner_now()).owner in ("", "program")

    run(program)


REACHABLE = pose(0.4, 0.0, 0.4)
INVALID: list[tuple[Any, dict[str, Any], Any, str]] = [  # goal, options, error, words of its message
    ("hoem", {}, MotionFailed, "home"), (pose(3.0, 0.0, 0.4), {}, MotionFailed, "operator"),
    ([0.1, 0.2], {}, MotionFailed, "operator"), ([], {}, ConfigError, "name of a pose"),
    ({"x": 1}, {}, ConfigError, "name of a pose"), ([0.0, np.nan], {}, ConfigError, "finite"),
    (2 * np.eye(4), {}, ConfigError, "rotation"), ("home", {"speed": 2.0}, ConfigError, "velocity_scaling"),
    ("home", {"speed": 0}, ConfigError, "velocity_scaling"), ([1e300] * 7, {}, ConfigError, "positions"),
    (pose(1e30, 0.0, 0.0), {}, ConfigError, "position.x"),
    (REACHABLE, {"via": (0.4, 0.1, 0.4), "around": (0.4, 0.1, 0.4)}, ConfigError, "via or center"),
    (REACHABLE, {"via": (0.4, 0.1, 0.4), "straight": True}, ConfigError, "straight"),
    (REACHABLE, {"goal": 3}, ConfigError, "goal"), ("home", {"sped": 2.0}, ConfigError, "choices"),
    ("home", {"via": (1, 2)}, ConfigError, "pose"),
    ("home", {"planner": "unknown"}, (MotionFailed, RemoteError), "unknown"),
    ("home", {"touch": ["track_l"]}, UnknownName, r"object to touch 'track_l' \(did you mean 'track_\d'\?\)"),
]


def test_unreachable_and_invalid_goals_raise_one_line_and_move_nothing() -> None:
    async def program(cell: Cell) -> None:
        await cell.objects(least=1)
        before = await cell.arm.joints()
        for goal, options, error, words in INVALID:
            with pytest.raises(error, match=words) as caught:
                await cell.arm.move(goal, **options)
            assert "\n" not in str(caught.value)
        for request in (cell.arm.execute(None), cell.arm.stop(None), cell.arm.jog(linear=(1, 0)),  # type: ignore[arg-type]
                        cell.arm.jog(linear=(0.1, 0, 0), seconds=1e9)):
            with pytest.raises(ConfigError):
                await request
        with pytest.raises(UnknownName, match="elbow"):
            await cell.arm.jog(joints={"elbow": 0.1})
        with pytest.raises(ConfigError, match="rpy"):
            pose(0.4, 0.0, 0.4, rpy=(0.0, 0.0))
        await cell.arm.plan("home", touch="track_1")
        assert np.allclose(await cell.arm.joints(), before, atol=1e-6)

    run(program)


async def cancelled(cell: Cell) -> None:
    """Wait until the motion is cancelled, and check that the arm has stopped."""
    async with asyncio.timeout(5.0):
        async for status in cell.listen("motion/status"):
            if status.state == "cancelled":
                break
    assert np.abs(await cell.arm.velocities()).max() < 1e-3


def test_motion_pauses_while_held_and_stops_when_it_is_cancelled_or_the_cell_is_left() -> None:
    async def program(cell: Cell) -> None:
        there = asyncio.create_task(cell.arm.move(pose(0.4, 0.3, 0.3), speed=0.5))
        await moving(cell)
        await cell.arm.hold("a visitor comes")
        await standstill(cell)
        where = await cell.arm.joints()
        for _ in range(50):
            assert np.allclose(await cell.arm.joints(), where, atol=1e-6) and not there.done()
        await cell.arm.release()
        assert (await there).state == "succeeded"

        back = asyncio.create_task(cell.arm.move("home", speed=0.3))
        await moving(cell)
        back.cancel()
        with pytest.raises(asyncio.CancelledError):
            await back
        await cancelled(cell)

        async with Cell.on(cell.bus, owner="program") as inner:
            back = asyncio.create_task(inner.arm.move("home", speed=0.1))
            await moving(cell)
            with pytest.raises(ZencellError, match="joined already"):
                await inner.__aenter__()
        assert back.cancelled()
        await cancelled(cell)
        await cell.arm.move("home")

    run(program)


def test_motion_releases_the_stop_of_its_own_operator_but_not_that_of_another() -> None:
    async def program(cell: Cell) -> None:
        await cell.arm.stop("lunch")
        assert "lunch" in (await cell.arm.status()).stopped
        await cell.arm.move("home")
        assert (await cell.gripper.open()).state == "succeeded"
        other = Cell.on(cell.bus, owner="other")
        for seconds in (0.2, 1.0):
            with pytest.raises(JogFailed, match="lunch"):
                await other.arm.jog(linear=(0.0, 0.0, 0.1), seconds=seconds)
        await cell.bus.client(topics.MOTION_STOP).call(StopRequest(owner="another", reason="obstructed"))
        with pytest.raises(MotionFailed, match="another") as caught:
            await cell.arm.move("home")
        assert caught.value.code == "stopped"
        with pytest.raises(MotionFailed, match="another"):
            await cell.gripper.open()

    run(program)


async def no_owner(cell: Cell) -> None:
    """Wait until no operator owns the motion."""
    async with asyncio.timeout(5.0):
        async for owner in cell.listen("motion/owner"):
            if owner.kind == "none":
                return


def test_owned_block_keeps_other_clients_from_moving_until_its_end() -> None:
    async def program(cell: Cell) -> None:
        other = Cell.on(cell.bus, owner="other")
        async with cell.arm.owned() as owner:
            assert (owner.owner, owner.kind) == ("program", "script")
            with pytest.raises(MotionFailed) as caught:
                await other.arm.move(pose(0.4, 0.1, 0.4))
            assert caught.value.code == "not_owner"
            async with cell.arm.owned():
                await cell.arm.move("home")
            with pytest.raises(RemoteError):
                await other.arm.own("take")  # the inner block does not return the authority
            assert (await cell.arm.owner_now()).owner == "program"
        await no_owner(cell)
        await other.arm.move("home")
        async with cell.arm.owned(lease=1.0):
            async with cell.arm.owned():
                pass
            await no_owner(cell)  # the lease ends without a renewal, as of a program that hangs

    run(program)


def test_cancelled_take_leaves_no_motion_authority() -> None:
    async def program(cell: Cell) -> None:
        async def own() -> None:
            async with cell.arm.owned():
                await asyncio.Event().wait()

        for after in (0.0, 0.001, 0.002, 0.01):
            owning = asyncio.create_task(own())
            await asyncio.sleep(after)
            owning.cancel()
            with pytest.raises(asyncio.CancelledError):
                await owning
            other = Cell.on(cell.bus, owner="other")
            await other.arm.own("take")  # an owner would reject it
            await other.arm.own("give")
            await no_owner(cell)

    run(program)


def test_jogging_moves_for_the_requested_time() -> None:
    async def program(cell: Cell) -> None:
        before = await cell.arm.pose()
        await cell.arm.jog(linear=(0.0, 0.1, 0.0), seconds=1.0)
        assert np.abs(await cell.arm.velocities()).max() < 1e-3, "the arm has stopped when jogging returns"
        x, y, z = (await cell.arm.pose())[:3, 3] - before[:3, 3]
        assert 0.03 < y < 0.11 and abs(x) < 5e-3 and abs(z) < 5e-3
        for seconds in (0.01, 0.1, 0.2):
            await cell.arm.jog(linear=(0.0, -0.1, 0.0), seconds=seconds)
            assert not (await cell.arm.owner_now()).jogging
        await cell.arm.move("home")

    run(program)


@pytest.mark.slow
def test_jog_in_a_direction_that_the_arm_cannot_keep_fails_with_the_reason() -> None:
    async def program(cell: Cell) -> None:
        for seconds in (20.0, 0.5):  # until the end of reach, and from there
            with pytest.raises(JogFailed, match="the tool cannot keep its direction, as the arm is at the end"):
                await cell.arm.jog(linear=(0.2, 0.0, 0.1), seconds=seconds)
        await cell.arm.jog(linear=(-0.2, 0.0, -0.1), seconds=0.5)
        assert not (await cell.arm.status()).message
        await cell.arm.move("home")

    run(program)


def test_jog_of_a_stalled_program_reports_late_commands(monkeypatch: pytest.MonkeyPatch) -> None:
    async def program(cell: Cell) -> None:
        async def stall() -> None:
            async for owner in cell.listen("motion/owner"):
                if owner.jogging:
                    monkeypatch.setattr(operator_motion, "JOG_PERIOD", 1.0)  # longer than a command moves the arm
                    return

        stalling = asyncio.create_task(stall())
        with pytest.raises(JogFailed, match="; commands of this program arrived too late"):
            await cell.arm.jog(linear=(0.0, 0.0, 0.05), seconds=10.0)
        await stalling
        assert np.abs(await cell.arm.velocities()).max() < 1e-3

    run(program)


def test_gripper_reports_whether_it_holds_and_a_pick_takes_ten_lines() -> None:
    async def program(cell: Cell) -> None:
        closed = await cell.gripper.move(0.02, 20.0)
        assert closed.width == pytest.approx(0.02, abs=2e-3) and not closed.holding
        empty = await cell.gripper.close(expected=0.04)
        assert (empty.state, empty.outcome) == ("aborted", "empty") and (await cell.gripper.state()).width < 2e-3
        with pytest.raises(ConfigError, match="width"):
            await cell.gripper.move(5.0)

        opened = await cell.gripper.open()
        assert opened.state == "succeeded" and opened.width == pytest.approx(0.08, abs=2e-3)
        ball, *_ = await cell.objects(least=1)
        x, y, z = ball.pose.position.x, ball.pose.position.y, ball.pose.position.z
        await cell.arm.move(pose(x, y, z + 0.15))
        await cell.arm.move(pose(x, y, z), straight=True, touch=ball.id)
        assert (await cell.gripper.close()).holding
        await cell.arm.move(pose(x, y, z + 0.15), straight=True)
        (held,) = [each.id for each in await cell.world.objects() if each.state == "held"]
        assert (await cell.gripper.state()).holding and held

    run(program, "panda", "world.count=1")
