"""Stops, holds and speed persist over restarts of the executor; and the policy for a vanished task."""

import asyncio
import errno
import os

import pytest

from common import topics
from common.atomic_file import STATE_VARIABLE
from common.control import interlocks
from common.control.interlocks import InterlockFile
from common.errors import ConfigError, RemoteError
from common.messages import GripperCommand, HoldRequest, OwnRequest, ParameterRequest, RobotCommand, StopRequest
from tests.doubles import stopping_arm
from tests.services.executor_rig import blocked, cycles_continue, executor, to_home_plus
from tests.services.fake_cell import latest

NEAR = to_home_plus(0.2)


def messages(caplog, part):
    return [text for text in (record.getMessage() for record in caplog.records) if part in text]


async def test_held_arm_is_at_standstill_and_continues_after_the_release() -> None:
    async with executor() as client:
        await client.move_slowly()
        request = asyncio.create_task(client.hold.call(HoldRequest(hold=True, reason="tested")))
        status = await latest(client.motion, lambda m: m.message == "held: tested")
        request.cancel()  # a hold without a name belongs to every operator
        assert (status.id, status.state, status.held) == ("a", "active", True) and status.progress < 0.9
        first = await client.joints_after(status.header.stamp)
        later = await client.joints_after(first.header.stamp + 2_000_000_000)
        assert first.position == later.position and not any(later.velocity)
        assert (await client.grip("g", 0.02)).state == "succeeded", "the gripper is not held"
        assert not (await client.release("")).held
        assert (await client.ended("a")).state == "succeeded"


async def test_status_is_published_before_the_answer_to_a_stop_or_a_hold() -> None:
    async with executor("services.trajectory_executor.joint_state_rate=10", speed=1.0) as client:
        await latest(client.motion, lambda m: not m.held)
        for hold in (True, False) * 5:
            await client.hold.call(HoldRequest(hold=hold, owner="ann"))
            assert client.motion.latest.held == hold
        await client.stop.call(StopRequest(owner="ann"))
        assert [one.by for one in client.motion.latest.interlocks] == ["ann"]


async def test_log_gives_a_reason_for_a_stop_without_one(caplog) -> None:
    async with executor() as client:
        await client.stop.call(StopRequest(owner="ann", reason=""))
    assert messages(caplog, "stopped by") == ["stopped by ann: on request"]


async def test_hold_of_an_operator_persists_and_that_of_a_watchdog_does_not() -> None:
    async with executor() as client:
        await client.hold.call(HoldRequest(hold=True, by="watchdog"))
        assert (await client.hold.call(HoldRequest(hold=True, owner="anna"))).held
    async with executor() as client:
        found = await latest(client.motion)
        assert found.held_by == ["operator"] and [hold.by for hold in found.interlocks] == ["anna"]
        assert (await client.release("bert")).held
        assert not (await client.release("anna")).held
    async with executor() as client:
        assert not (await latest(client.motion)).interlocks


async def test_log_names_the_operators_whose_hold_or_ownership_another_one_releases_or_overrides(caplog) -> None:
    async with executor() as client:
        await client.hold.call(HoldRequest(hold=True, owner="anna", reason="lunch"))
        await client.release("bert")
        await client.release("anna", reason="done")
        await client.own.call(OwnRequest(act="take", owner="anna"))
        await client.release("bert", stops=True, override=True)
    rejected, released, *_ = messages(caplog, "released")
    assert rejected.startswith("bert released no interlock: on request; still held since ")
    assert rejected.endswith("by anna (lunch)") and released == "released by anna: done"
    (line,) = messages(caplog, "starts the task")
    assert line.startswith("bert starts the task: the motion was owned by anna (operator)")


async def test_stop_blocks_arm_and_gripper_over_restarts_until_a_start() -> None:
    async with executor() as client:
        stop = StopRequest(owner="anna", reason="smoke")
        assert (await client.stop.call(stop)).stopped.endswith("UTC by anna (smoke)")
    async with executor() as client:
        refused = await client.start("a", NEAR)
        assert (refused.state, refused.error) == ("rejected", "stopped") and "by anna (smoke)" in refused.message
        fingers = await client.command.call(GripperCommand(id="g", width=0.02))
        assert (fingers.state, fingers.error) == ("rejected", "stopped")
        await client.release("bert", stops=True)
        assert (await client.start("a", NEAR)).state == "rejected", "its state does not change"
        await client.follow("b", NEAR)
        assert (await client.grip("h", 0.02)).state == "succeeded"


async def test_more_requests_to_stop_than_can_be_read_stop_the_robot() -> None:
    async with executor() as client:
        await client.move_slowly()
        by_requester = StopRequest(id="nothing", by="requester")
        flood = [asyncio.create_task(client.stop.call(by_requester)) for _ in range(60)]
        last = asyncio.create_task(client.stop.call(StopRequest(owner="anna")))
        status = await latest(client.motion, lambda m: bool(m.stopped))
        assert "by trajectory_executor (more requests to stop come than can be read" in status.stopped
        answers = await asyncio.gather(*flood, last, return_exceptions=True)
        refused = [str(answer) for answer in answers if isinstance(answer, RemoteError)]
        assert refused and all("requests wait already: the robot is stopped for all of them" in why for why in refused)
        await latest(client.motion, lambda m: m.state == "cancelled")
        assert not (await client.release("bert", stops=True)).stopped


async def test_stopped_goal_never_moves_even_if_it_arrives_later_or_after_a_restart() -> None:
    async with executor() as client:
        early = await client.stop.call(StopRequest(id="a", by="requester"))
        assert early.error == "unknown_goal" and "it will be refused" in early.message and not early.interlocks
        await client.move_slowly("b", until=0.1)
        await client.stop.call(StopRequest(id="b", by="requester"))
    async with executor() as client:
        for goal in ("a", "b"):
            refused = await client.start(goal, NEAR)
            assert (refused.state, refused.error) == ("rejected", "stopped")
        await client.follow("c", NEAR)


async def test_speed_that_was_set_live_persists() -> None:
    path = "services.trajectory_executor.speed_scaling"
    for new, found in ((0.05, 1.0), (1.0, 0.05), (None, 1.0)):
        async with executor() as client:
            assert (await latest(client.motion)).speed_scaling == found
            if new is not None:
                parameters = client.bus.client(topics.parameters_of("trajectory_executor"))
                await parameters.call(ParameterRequest(set={path: new}, by="anna"))


async def test_safety_stop_of_the_arm_persists_until_an_operator_has_it_recover(tmp_path, monkeypatch):
    monkeypatch.setenv(STATE_VARIABLE, str(tmp_path))
    backend = "robot.hardware.backend=tests.doubles.stopping_arm"
    async with executor(backend, speed=1.0) as client:
        await client.joints.next()
        assert not stopping_arm.created[-1].stopped
        stopping_arm.created[-1].stopped = True
        await latest(client.motion, lambda m: "stopped for safety" in m.fault)
        before = client.bus.header()
    async with executor(backend, speed=1.0) as client:  # the stop was ended at the pendant meanwhile
        arm, states = stopping_arm.created[-1], client.bus.reader(topics.ROBOT_STATUS)
        assert (await latest(states)).mode == "protective_stop" and arm.stopped
        order = client.bus.client(topics.ROBOT_COMMAND)
        with pytest.raises(RemoteError, match="before the executor started"):
            await order.call(RobotCommand(header=before, act="recover", owner="tester"))
        assert arm.stopped
        answer = await order.call(RobotCommand(header=client.bus.header(), act="recover", owner="tester"))
        assert answer.mode == "running"
        await latest(states, lambda status: status.mode == "running")
    async with executor(backend, speed=1.0) as client:
        await client.joints.next()
        assert not stopping_arm.created[-1].stopped


async def test_enable_is_rejected_in_a_safety_stop_and_recover_without_power(monkeypatch, tmp_path):
    monkeypatch.setenv(STATE_VARIABLE, str(tmp_path))
    async with executor("robot.hardware.backend=tests.doubles.stopping_arm", speed=1.0) as client:
        arm, order = stopping_arm.created[-1], client.bus.client(topics.ROBOT_COMMAND)
        arm.stopped = True
        with pytest.raises(RemoteError, match="enable: stopped for safety"):
            await order.call(RobotCommand(act="enable", owner="tester"))
        arm.powered = False
        with pytest.raises(RemoteError, match="recover: without power: `zencell robot enable`"):
            await order.call(RobotCommand(act="recover", owner="tester"))
        assert arm.stopped and not arm.powered and ("enable", 0.0) not in arm.orders
        answer = await order.call(RobotCommand(act="enable", owner="tester"))
        assert answer.mode == "protective_stop", "power alone ends no stop"
        assert (await order.call(RobotCommand(act="recover", owner="tester"))).mode == "running"


# --- the file ---


async def test_second_executor_of_the_same_cell_name_in_the_same_folder_is_refused(monkeypatch):
    monkeypatch.setattr(interlocks, "LOCK_TIMEOUT", 0.1)
    async with executor() as client:
        await client.stop.call(StopRequest(owner="anna"))
        holder = rf"ZENCELL_STATE: .* is in use by trajectory_executor of test, process {os.getpid()} on .+: each"
        with pytest.raises(ConfigError, match=holder) as caught:
            async with executor():
                pass
        assert "\n" not in str(caught.value)
        await cycles_continue(client)
        monkeypatch.setenv(STATE_VARIABLE, os.environ["XDG_STATE_HOME"])
        async with executor() as other:
            assert not (await latest(other.motion)).interlocks


async def test_interlock_that_cannot_be_saved_says_so_until_it_is(monkeypatch, caplog) -> None:
    monkeypatch.setattr(interlocks, "RETRY_PERIOD", 0.01)
    save, full = InterlockFile.save, True

    def fail(self, record):
        if full:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        save(self, record)

    async with executor() as client:
        monkeypatch.setattr(InterlockFile, "save", fail)
        for _ in range(2):
            answer = await client.stop.call(StopRequest(owner="anna", reason="smoke"))
            assert answer.message.count("inhibits.json cannot be written (No space left on device)") == 1
            assert "not saved on disk (No space left on device)" in answer.stopped and "smoke" in answer.stopped
        await latest(client.motion, lambda m: m.unsaved)
        held = await client.hold.call(HoldRequest(hold=True, owner="bert"))
        assert "cannot be written" in held.message and held.unsaved.count("not saved on disk") == 2
        await cycles_continue(client)
        assert len(messages(caplog, "inhibits.json")) == 1, "logged once"
        full = False
        status = await latest(client.motion, lambda m: len(m.interlocks) == 2 and not m.unsaved)
        assert status.stopped.endswith("by anna (smoke)")
        logged = messages(caplog, "inhibits.json")
        assert len(logged) == 2 and logged[1].endswith("is written again: all interlocks persist")
        answer = await client.stop.call(StopRequest(owner="anna", reason="smoke"))
        assert "written" not in answer.message
    async with executor() as client:
        found = await latest(client.motion)
        assert {one.by for one in found.interlocks} == {"anna", "bert"}


async def test_hold_applies_at_once_and_is_answered_when_a_hanging_disk_has_saved_it(monkeypatch) -> None:
    async with executor() as client, blocked(monkeypatch, InterlockFile, "save") as saving:
        request = asyncio.create_task(client.hold.call(HoldRequest(hold=True, owner="anna"), timeout=60))
        await saving.wait()
        await cycles_continue(client)
        assert (await latest(client.motion, lambda m: m.held)).interlocks[0].by == "anna"
        assert not request.done()


# --- the task vanishes ---


@pytest.mark.parametrize("policy", ["finish", "hold"])
async def test_arm_whose_task_vanishes_follows_the_configured_policy(policy: str) -> None:
    async with executor(f"services.trajectory_executor.when_alone={policy}") as client:
        task = client.net.bus("smart_pick_place", clock=client.bus.clock)
        await task.ready()
        await client.move_slowly(until=0.1)
        await task.close()
        if policy == "hold":
            held = await latest(client.motion, lambda m: m.message == "held: smart_pick_place is gone")
            assert held.held_by == ["controller"] and held.progress < 0.9 and not held.paused
            await client.net.bus("smart_pick_place", clock=client.bus.clock).ready()
        else:
            assert not (await latest(client.motion, lambda m: m.state != "active" or m.held)).held
        done = await client.ended("a")
        assert (done.id, done.state, done.held) == ("a", "succeeded", False)
