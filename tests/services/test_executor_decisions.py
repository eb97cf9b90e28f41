"""What persons decide about the arm: stops, holds and speed, which outlive the executor, and who is waited for."""

import asyncio
import errno
import os

import pytest

from common import topics
from common.clock import Clock
from common.control import interlocks
from common.control.interlocks import InterlockFile
from common.errors import ConfigError, RemoteError
from common.kept_file import STANDING_VARIABLE, STATE_VARIABLE
from common.messages import (
    GripperCommand,
    HoldRequest,
    OwnRequest,
    ParameterRequest,
    RobotCommand,
    StopRequest,
)
from common.process.in_process import running_service
from common.robot.model import RobotModel
from common.transport.local import LocalNetwork
from services import trajectory_executor
from tests.doubles import stopping_arm
from tests.services.executor_person import CELL, SPEED, Person, blocked, config, executor, goes_on, move


async def test_held_arm_stands_still_whoever_asked_for_it_and_goes_on_when_let_go(robot: RobotModel) -> None:
    home = robot.named("home")
    async with executor() as person:
        await person.execute.call(person.asks(id="a", trajectory=move(robot, home, home + 0.5, 0.02)))
        await person.see(person.motion, lambda m: m.progress > 0.2)
        asking = asyncio.create_task(person.hold.call(HoldRequest(hold=True, reason="tested")))
        status = await person.see(person.motion, lambda m: m.message == "held: tested")
        asking.cancel()
        assert (status.id, status.state, status.held) == ("a", "active", True) and status.progress < 0.9
        first = await person.see(person.joints, lambda s: s.header.stamp > status.header.stamp)
        later = await person.see(person.joints, lambda s: s.header.stamp > first.header.stamp + 5_000_000_000)
        assert first.position == later.position and not any(later.velocity)
        assert (await person.grip("g", 0.02)).state == "succeeded", "the fingers are not held"
        assert not (await person.hold.call(HoldRequest(hold=False))).held
        assert (await person.see(person.motion, lambda m: m.state != "active")).state == "succeeded"


async def test_who_has_the_answer_to_a_stop_or_a_hold_finds_it_in_the_state_already() -> None:
    async with executor("services.trajectory_executor.joint_state_rate=10", speed=1.0) as person:  # it tells seldom
        await person.see(person.motion, lambda m: not m.held)
        for hold in (True, False) * 5:
            await person.hold.call(HoldRequest(hold=hold, owner="ann"))
            assert person.motion.latest.held == hold
        await person.stop.call(StopRequest(owner="ann"))
        assert [one.by for one in person.motion.latest.interlocks] == ["ann"]


async def test_restarted_executor_holds_what_a_person_held_and_not_what_a_watchdog_did() -> None:
    async with executor() as person:
        await person.hold.call(HoldRequest(hold=True, by="watchdog"))
        assert (await person.hold.call(HoldRequest(hold=True, owner="anna"))).held
    async with executor() as person:
        found = await person.see(person.motion, lambda m: True)
        assert found.held_by == ["operator"] and [hold.by for hold in found.interlocks] == ["anna"]
        assert (await person.hold.call(HoldRequest(hold=False, owner="bert"))).held
        assert not (await person.hold.call(HoldRequest(hold=False, owner="anna"))).held
    async with executor() as person:
        assert not (await person.see(person.motion, lambda m: True)).interlocks


async def test_log_says_whose_hold_stays_when_another_asks_to_let_go(caplog) -> None:
    def told():
        return [text for text in (record.getMessage() for record in caplog.records) if "released" in text]

    async with executor() as person:
        await person.hold.call(HoldRequest(hold=True, owner="anna", reason="lunch"))
        await person.hold.call(HoldRequest(hold=False, owner="bert"))
        assert len(told()) == 1 and told()[0].startswith("bert released no interlock: on request; still held since ")
        assert told()[0].endswith("by anna (lunch)")
        await person.hold.call(HoldRequest(hold=True, owner="bert"))
        await person.hold.call(HoldRequest(hold=False, owner="bert", reason="done"))
        assert told()[1].startswith("bert released some interlocks: done; still held since ")
        await person.hold.call(HoldRequest(hold=False, owner="anna", reason="done"))
        assert told()[2:] == ["released by anna: done"]


async def test_log_names_both_when_somebody_starts_the_task_although_another_has_the_motion(caplog) -> None:
    async with executor() as person:
        await person.bus.client(topics.MOTION_OWN).call(OwnRequest(act="take", owner="anna"))
        await person.hold.call(HoldRequest(hold=False, owner="bert", stops=True))
        await person.hold.call(HoldRequest(hold=False, owner="bert", stops=True, override=True))
        told = [text for text in (record.getMessage() for record in caplog.records) if "starts the task" in text]
        assert len(told) == 1
        assert told[0].startswith("bert starts the task: the motion was owned by anna (operator)")


async def test_stopped_arm_and_fingers_stay_so_through_restarts_until_somebody_starts_them(robot: RobotModel) -> None:
    home = robot.named("home")
    there = move(robot, home, home + 0.2)
    async with executor() as person:
        stop = StopRequest(owner="anna", reason="smoke")
        assert (await person.stop.call(stop)).stopped.endswith("UTC by anna (smoke)")
    async with executor() as person:
        refused = await person.execute.call(person.asks(id="a", trajectory=there))
        assert (refused.state, refused.error) == ("rejected", "stopped") and "by anna (smoke)" in refused.message
        fingers = await person.command.call(GripperCommand(id="g", width=0.02))
        assert (fingers.state, fingers.error) == ("rejected", "stopped")
        await person.hold.call(HoldRequest(hold=False, owner="bert", stops=True))
        assert (await person.execute.call(person.asks(id="a", trajectory=there))).state == "rejected", "as before"
        assert (await person.follow("b", there)).state == "succeeded"
        assert (await person.grip("h", 0.02)).state == "succeeded"


async def test_task_whose_fingers_were_kept_from_moving_does_not_go_on_when_the_motion_is_given_back() -> None:
    async with executor() as person:
        own = person.bus.client(topics.MOTION_OWN)
        await own.call(OwnRequest(act="take", owner="ann"))
        refused = await person.command.call(GripperCommand(header=person.bus.header(), id="a", width=0.02))
        assert refused.error == "not_owner"
        await own.call(OwnRequest(act="give", owner="ann"))
    async with executor() as person:
        refused = await person.command.call(GripperCommand(header=person.bus.header(), id="b", width=0.02))
        assert refused.error == "stopped" and "by ann (the motion is owned by ann" in refused.message


async def test_robot_is_stopped_when_more_requests_to_stop_come_than_can_be_read(robot: RobotModel) -> None:
    home = robot.named("home")
    async with executor() as person:
        await person.execute.call(person.asks(id="a", trajectory=move(robot, home, home + 0.5, 0.02)))
        await person.see(person.motion, lambda m: m.progress > 0.2)
        nobodys = StopRequest(id="nothing", by="requester")
        flood = [asyncio.create_task(person.stop.call(nobodys)) for _ in range(60)]
        last = asyncio.create_task(person.stop.call(StopRequest(owner="anna")))
        told = await person.see(person.motion, lambda m: bool(m.stopped))
        assert "by trajectory_executor (more requests to stop come than can be read" in told.stopped
        answers = await asyncio.gather(*flood, last, return_exceptions=True)
        refused = [str(answer) for answer in answers if isinstance(answer, RemoteError)]
        assert refused and all("requests wait already: the robot is stopped for all of them" in why for why in refused)
        await person.see(person.motion, lambda m: m.state == "cancelled")
        assert not (await person.hold.call(HoldRequest(hold=False, owner="bert", stops=True))).stopped


async def test_goal_that_is_stopped_before_it_comes_never_moves_also_after_a_restart(robot: RobotModel) -> None:
    home = robot.named("home")
    there = move(robot, home, home + 0.2)
    async with executor() as person:
        early = await person.stop.call(StopRequest(id="a", by="requester"))
        assert early.error == "unknown_goal" and "it will be refused" in early.message and not early.interlocks
        await person.execute.call(person.asks(id="b", trajectory=move(robot, home, home + 0.5, 0.02)))
        await person.see(person.motion, lambda m: m.progress > 0.1)
        await person.stop.call(StopRequest(id="b", by="requester"))
    async with executor() as person:
        for goal in ("a", "b"):
            refused = await person.execute.call(person.asks(id=goal, trajectory=there))
            assert (refused.state, refused.error) == ("rejected", "stopped")
        assert (await person.follow("c", there)).state == "succeeded"


async def test_speed_that_was_set_live_is_found_again(robot: RobotModel) -> None:
    path = "services.trajectory_executor.speed_scaling"
    for set_to, found in ((0.05, 1.0), (1.0, 0.05), (None, 1.0)):
        async with executor() as person:
            assert (await person.see(person.motion, lambda m: True)).speed_scaling == found
            if set_to is not None:
                client = person.bus.client(topics.parameters_of("trajectory_executor"))
                await client.call(ParameterRequest(set={path: set_to}, by="anna"))


async def test_executor_that_cannot_keep_what_persons_decide_does_not_start(
    tmp_path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv(STATE_VARIABLE, str(tmp_path / "file"))
    monkeypatch.setenv(STANDING_VARIABLE, str(tmp_path))
    with pytest.raises(ConfigError, match=r"ZENCELL_STATE: .* cannot be written"):
        async with executor():
            pass


async def test_second_executor_that_would_keep_the_stops_of_another_cell_in_one_file_is_refused(
    monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(interlocks, "LOCK_TIMEOUT", 0.1)
    async with executor() as person:
        await person.stop.call(StopRequest(owner="anna"))
        who = rf"ZENCELL_STATE: .* is in use by trajectory_executor of {CELL}, process {os.getpid()} on .+: each would"
        with pytest.raises(ConfigError, match=who) as caught:
            async with executor():
                pass
        assert "\n" not in str(caught.value)
        await goes_on(person)
        monkeypatch.setenv(STATE_VARIABLE, os.environ["XDG_STATE_HOME"])
        async with executor() as other:
            assert not (await other.see(other.motion, lambda m: True)).interlocks


async def test_stop_that_cannot_be_kept_says_so_everywhere_until_it_is(monkeypatch, caplog) -> None:
    monkeypatch.setattr(interlocks, "RETRY_PERIOD", 0.01)
    save, full = InterlockFile.save, True

    def refuse(self, record):
        if full:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        save(self, record)

    def told():
        return [record.getMessage() for record in caplog.records if "inhibits.json" in record.getMessage()]

    async with executor() as person:
        monkeypatch.setattr(InterlockFile, "save", refuse)
        for _ in range(2):
            answer = await person.stop.call(StopRequest(owner="anna", reason="smoke"))
            assert answer.message.count("inhibits.json cannot be written (No space left on device)") == 1
            assert "not saved on disk (No space left on device)" in answer.stopped and "smoke" in answer.stopped
        await person.see(person.motion, lambda m: m.unsaved)
        held = await person.hold.call(HoldRequest(hold=True, owner="bert"))
        assert "cannot be written" in held.message and held.unsaved.count("not saved on disk") == 2
        await goes_on(person)
        assert len(told()) == 1, "said once, however often it is tried"
        full = False
        status = await person.see(person.motion, lambda m: len(m.interlocks) == 2 and not m.unsaved)
        assert status.stopped.endswith("by anna (smoke)")
        assert len(told()) == 2 and told()[1].endswith("is written again: all interlocks persist")
        answer = await person.stop.call(StopRequest(owner="anna", reason="smoke"))
        assert "written" not in answer.message
    async with executor() as person:
        found = await person.see(person.motion, lambda m: True)
        assert {one.by for one in found.interlocks} == {"anna", "bert"}


async def alone(net: LocalNetwork, clock: Clock, given: object, robot: RobotModel) -> tuple[Person, object]:
    """A person who sees an arm in the middle of a motion, whose task is still there."""
    person, task = Person(net, clock), net.bus("smart_pick_place", cell=CELL, clock=clock)
    await task.ready()
    await person.see(person.joints, lambda s: True)
    home = robot.named("home")
    assert (await person.execute.call(person.asks(id="a", trajectory=move(robot, home, home + 0.5, 0.02)))).error == ""
    await person.see(person.motion, lambda m: m.progress > 0.1)
    return person, task


async def test_arm_that_is_to_hold_when_alone_waits_on_its_path_for_the_task_and_goes_on(robot: RobotModel) -> None:
    net, clock, given = LocalNetwork(), Clock(SPEED), config("services.trajectory_executor.when_alone=hold")
    async with running_service(net, trajectory_executor.run, given, name="trajectory_executor", cell=CELL, clock=clock):
        person, task = await alone(net, clock, given, robot)
        await task.close()
        held = await person.see(person.motion, lambda m: m.message == "held: smart_pick_place is gone")
        assert held.held_by == ["controller"] and held.progress < 0.9 and not held.paused
        back = net.bus("smart_pick_place", cell=CELL, clock=clock)
        await back.ready()
        done = await person.see(person.motion, lambda m: m.state != "active")
        assert (done.id, done.state, done.held) == ("a", "succeeded", False)


async def test_arm_that_is_alone_finishes_its_motion_unless_told_otherwise(robot: RobotModel) -> None:
    net, clock, given = LocalNetwork(), Clock(SPEED), config()
    async with running_service(net, trajectory_executor.run, given, name="trajectory_executor", cell=CELL, clock=clock):
        person, task = await alone(net, clock, given, robot)
        await task.close()
        done = await person.see(person.motion, lambda m: m.state != "active" or m.held)
        assert (done.id, done.state) == ("a", "succeeded")


async def test_joint_states_go_on_while_a_hold_is_recorded_on_a_disk_that_is_stuck(monkeypatch) -> None:
    async with executor() as person, blocked(monkeypatch, InterlockFile, "save") as saving:
        asked = asyncio.create_task(person.hold.call(HoldRequest(hold=True, owner="anna"), timeout=60))
        await saving.wait()
        await goes_on(person)
        assert (await person.see(person.motion, lambda m: m.held)).interlocks[0].by == "anna", "it holds at once"
        assert not asked.done(), "what is answered outlives the executor"


async def test_a_stop_for_safety_outlives_the_executor_until_somebody_has_the_arm_recover(tmp_path, monkeypatch):
    monkeypatch.setenv(STATE_VARIABLE, str(tmp_path))
    own = "robot.hardware.backend=tests.doubles.stopping_arm"
    async with executor(own, speed=1.0) as person:
        await person.joints.next()
        assert not stopping_arm.made[-1].stopped
        stopping_arm.made[-1].stopped = True
        await person.see(person.motion, lambda m: "stopped for safety" in m.fault)
        asked = person.bus.header()
    async with executor(own, speed=1.0) as person:  # the stop was ended at the pendant meanwhile
        arm, told = stopping_arm.made[-1], person.bus.reader(topics.ROBOT_STATUS)
        assert (await person.see(told, lambda status: True)).mode == "protective_stop" and arm.stopped
        order = person.bus.client(topics.ROBOT_COMMAND)
        with pytest.raises(RemoteError, match="before the executor began"):  # of a stop of before
            await order.call(RobotCommand(header=asked, act="recover", owner="tester"))
        assert arm.stopped
        answer = await order.call(RobotCommand(header=person.bus.header(), act="recover", owner="tester"))
        assert answer.mode == "running"
        await person.see(told, lambda status: status.mode == "running")
    async with executor(own, speed=1.0) as person:
        await person.joints.next()
        assert not stopping_arm.made[-1].stopped
