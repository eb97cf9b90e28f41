"""Gripper commands sent before the arm arrives, also when it does not arrive."""

from __future__ import annotations

from typing import Any

import pytest

from common import messages as m
from common.tasks.engine import Task
from common.tasks.stages import Grip, Move, Stage, View
from common.transport.codec import decode, encode
from tests.common.tasks.engine_cell import CELL, THERE, Cell, stops

SEEN = 0.05  # [m] wide


def take(lead: float = 0.0) -> list[Stage]:
    return [Move("reach", "REACHING", goal=THERE),
            Grip("close", "REACHING", width=0.0, holds=True, early=True, lead=lead, expected_width=SEEN)]


class Take(Task[View]):
    """Take an object of known width, bring it, and release it."""

    lead = 0.0

    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        self.did: list[str] = []

    def succeeded(self, stage: Stage, view: View) -> None:
        self.did.append(stage.name)

    def decide(self, view: View) -> None:
        if self.status.state == "BRINGING" and not view.holding:
            self.end("DONE")
        elif self.status.state != "DONE":
            self.queue += [*([] if view.holding else take(self.lead)),
                           Move("bring", "BRINGING", goal=THERE, carries=True),
                           Grip("release", "BRINGING", width=0.08, holds=False, carries=True, early=True)]


class Hand(Cell):
    """A cell in which a motion takes a second; a test starts the fingers that wait for its end."""

    def __init__(self, **robot: Any) -> None:
        super().__init__(Take, **robot)
        self.waits: m.GripperCommand | None = None

    def answer(self, command: m.Message) -> None:
        if isinstance(command, m.GripperCommand) and command.after == self.motion.id:
            assert self.motion.state == "active"
            self.requests.append(command)
            self.waits = command
            self.task.on_goal(m.GripperState(header=self.header, id=command.id, state="active"), self.view())
        else:
            super().answer(command)

    @property
    def did(self) -> list[str]:
        return self.task.did

    def until_waiting(self) -> m.GripperCommand:
        for _ in range(300):
            self.step()
            if self.waits is not None:
                return self.waits
        raise AssertionError("never")

    def begin(self, state: str = "active") -> None:
        """The arm is about to arrive, or the waiting command is cancelled."""
        assert self.waits is not None
        self.fingers(state=state, id=self.waits.id)
        self.waits = None

    def resume(self, count: int) -> list[m.Message]:
        """Step, after a pause by an interrupted motion."""
        asked = []
        for _ in range(count):
            self.status.paused = False
            asked += self.step()
        return asked

    def grasp(self) -> None:
        """The arm arrives, and the fingers hold the object."""
        self.arm()
        self.step()
        self.fingers(SEEN, holding=True)


@pytest.fixture
def waiting() -> Hand:
    """The arm is on its way, and the command to close waits for its arrival."""
    hand = Hand()
    hand.until_waiting()
    return hand


@pytest.fixture
def closing(waiting: Hand) -> Hand:
    """The arm is about to arrive and the fingers have started to close."""
    waiting.begin()
    waiting.step()
    return waiting


@pytest.fixture
def releasing(closing: Hand) -> Hand:
    """The arm is about to arrive with its object, and the fingers have started to open."""
    closing.grasp()
    closing.until_waiting()
    closing.begin()
    closing.step()
    assert closing.did == ["reach", "close"]
    return closing


def test_early_close_starts_within_its_lead_and_touches_nothing_before(waiting: Hand) -> None:
    command = waiting.waits
    assert command is not None and command.after == waiting.motion.id
    assert waiting.stage == "reach" == waiting.status.stage
    assert command.lead == pytest.approx(waiting.task.gripper.least_time(0.08 - SEEN)) and 0.1 < command.lead < 0.3
    waiting.begin()
    waiting.grasp()
    release = waiting.until_waiting()
    assert 0.0 < release.lead < 0.06 and release.within <= 0.005, "the object falls at its destination"


def test_lead_of_slow_fingers_is_limited() -> None:
    command = Hand(gripper=CELL.robot.gripper.model_copy(update={"speed": 0.001})).until_waiting()
    assert decode(m.GripperCommand, encode(command)) == command


def test_early_command_is_sent_late_in_a_long_motion() -> None:
    hand = Hand()
    while not hand.motion.id:
        hand.step()
    assert isinstance(hand.task.running.stage, Move) and not hand.grips
    hand.task.running.stage.trajectory.points[-1].time_from_start = 10.0
    for progress, speed, asked in ((0.0, 1.0, 0), (0.85, 1.0, 0), (0.95, 0.3, 0), (0.95, 1.0, 1)):
        hand.arm("active", progress=progress, speed_scaling=speed)
        hand.step()
        assert len(hand.grips) == asked


def test_early_command_is_not_repeated_after_arrival_and_its_time_counts_once(closing: Hand) -> None:
    closing.arm()
    closing.step()
    assert closing.stage == "close" and closing.status.stage == "close"
    closing.fingers(SEEN, holding=True)
    closing.step()
    assert closing.stage == "bring" and len(closing.grips) == 1 and closing.status.failures == 0
    assert closing.status.moving_seconds <= closing.now - 100.0 + 1e-6


def test_loss_while_the_fingers_wait_is_a_loss(closing: Hand) -> None:
    closing.grasp()
    closing.until_waiting()
    closing.fingers(0.0, holding=False, outcome="slipping")
    asked = closing.step()
    assert len(asked) == len(stops(asked)) == 1 and closing.status.failures == 1
    assert "fell" in closing.status.message


@pytest.mark.parametrize("end", ["aborted", "cancelled"])
@pytest.mark.parametrize("started", [True, False])
def test_interrupted_motion_waits_for_the_early_fingers(waiting: Hand, end: str, started: bool) -> None:
    if started:
        waiting.begin()
        waiting.step()
    waiting.arm(end)
    assert all(isinstance(command, m.PlanRequest) for command in waiting.resume(20 if started else 1))
    if started:
        waiting.fingers(SEEN, holding=True)
    else:
        waiting.begin("cancelled")
    waiting.resume(3)
    assert waiting.stage == ("bring" if started else "reach") and waiting.did == []


@pytest.mark.parametrize("holding", [True, False])
def test_stop_during_the_motion_starts_nothing_and_a_start_does_not_drop_an_object(
    closing: Hand, holding: bool
) -> None:
    assert all(isinstance(command, m.StopRequest) for command in closing.task.command("stop", closing.view()))
    closing.arm("cancelled")
    closing.fingers(0.0, "aborted", holding=False, outcome="empty")
    assert closing.steps(20) == []
    closing.fingers(SEEN if holding else 0.0, holding=holding, id="by hand", outcome="")
    closing.task.command("start", closing.view())
    asked = closing.steps(5)
    assert [grip.width for grip in asked if isinstance(grip, m.GripperCommand) and not grip.after] == (
        [] if holding else [0.08])
    assert not holding or closing.stage == "bring"


def test_waiting_fingers_commanded_by_another_client_are_decided_again(waiting: Hand) -> None:
    waiting.waits = None
    waiting.now += 0.05
    waiting.fingers(0.07, holding=False, id="of another client")
    waiting.now += 0.05
    waiting.arm()
    assert any(isinstance(one, m.PlanRequest) for one in waiting.steps(4)) and waiting.stage != "close"


@pytest.mark.parametrize("error", ["stale_request", "hardware_fault", "unknown_goal"])
def test_rejected_early_command_is_repeated_after_arrival(error: str) -> None:
    hand = Hand()
    hand.grip = lambda command: m.GripperState(id="unrelated")  # its answer comes later
    hand.answer = lambda command: Cell.answer(hand, command)
    while not hand.grips:
        hand.step()
    hand.task.on_goal(m.GripperState(id=hand.grips[0].id, state="rejected", error=error, message="no"), hand.view())
    assert hand.steps(5) == [] and hand.stage == "reach"
    hand.arm()
    hand.step()
    assert len(hand.grips) == 2 and not hand.grips[1].after and hand.stage == "close"


def test_fingers_that_already_hold_are_not_sent_early() -> None:
    hand = Hand()
    hand.gripper = m.GripperState(width=SEEN, holding=True)
    hand.task.queue += take()
    hand.steps(10)
    assert not hand.grips and hand.stage == "reach"


@pytest.mark.parametrize("cleared", [False, True])
def test_release_just_before_standstill_is_no_loss_also_after_the_queue_is_cleared(
    releasing: Hand, cleared: bool
) -> None:
    if cleared:
        releasing.task.clear()
    releasing.fingers(0.0506, "active", holding=False)
    assert releasing.step() == [] and releasing.status.failures == 0
    releasing.arm()
    releasing.step()
    releasing.fingers(0.08, holding=False)
    releasing.steps(2)
    assert releasing.did[2:] == ["bring", "release"]
    assert releasing.status.state == "DONE" and releasing.status.failures == 0


@pytest.mark.parametrize("end", ["stop", "aborted", "cancelled"])
def test_early_release_of_an_interrupted_motion_counts_once(releasing: Hand, end: str) -> None:
    if end == "stop":
        releasing.task.command("stop", releasing.view())
    releasing.arm("cancelled" if end == "stop" else end)
    releasing.fingers(0.0506, "active", holding=False)
    releasing.step()
    assert releasing.did[2:] == []
    releasing.fingers(0.08, holding=False)
    releasing.steps(3)
    assert releasing.did[2:] == ["release"] and not releasing.task.active_stages


def test_early_release_after_a_long_pause_counts(closing: Hand) -> None:
    closing.grasp()
    closing.until_waiting()
    closing.arm("active", held=True)
    closing.step()
    closing.now += 60.0
    closing.step()
    closing.arm("active", held=False)
    closing.step()
    closing.begin()
    closing.step()
    closing.fingers(0.0506, "active", holding=False)
    closing.arm("aborted")
    closing.steps(2)
    closing.fingers(0.08, holding=False)
    closing.step()
    assert closing.did == ["reach", "close", "release"]


@pytest.mark.parametrize("end", ["forgotten", "refused", "forever"])
def test_silent_fingers_do_not_block_decisions(closing: Hand, end: str) -> None:
    closing.arm("aborted")
    closing.step()
    if end == "forgotten":
        closing.gripper = m.GripperState(header=m.Header(stamp=int((closing.now + 1.0) * 1e9)), width=0.08)
    elif end == "refused":
        closing.task.on_goal(m.GripperState(id=closing.grips[0].id, state="rejected", error="stopped"), closing.view())
        closing.gripper = m.GripperState(width=0.08)
    else:
        closing.now += 60.0
        closing.gripper = closing.gripper.model_copy(update={"moving": False})
    closing.steps(3)
    assert closing.stage == "reach"


def test_fingers_closed_before_arrival_are_no_failure_and_the_next_close_is_not_early(closing: Hand) -> None:
    closing.arm("aborted", error=m.CLOSED_BEFORE, message="held up")
    closing.step()
    closing.fingers(0.0, "aborted", holding=False, outcome="empty")
    closing.step()
    assert closing.status.failures == 0 and closing.stage == "open", "it does not go down with closed fingers"
    closing.fingers(0.08, holding=False)
    closing.steps(8)
    assert closing.stage == "reach" and [grip.width for grip in closing.grips] == [0.0, 0.08]
    closing.arm()
    closing.step()
    assert closing.stage == "close" and not closing.grips[-1].after
    closing.fingers(SEEN, holding=True)
    assert closing.until_waiting().after, "the release is early again"
    assert closing.status.failures == 0


def test_fingers_timed_within_a_motion_are_so_again_after_they_closed_before_arrival(closing: Hand) -> None:
    closing.arm("aborted", error=m.CLOSED_BEFORE, message="held up")
    closing.step()
    closing.fingers(0.0, "aborted", holding=False, outcome="empty")
    closing.task.lead = 0.4
    closing.step()
    closing.fingers(0.08, holding=False)
    assert closing.until_waiting().lead == 0.4


def test_report_from_before_standstill_is_not_a_forgotten_command(waiting: Hand) -> None:
    waiting.now += 0.05
    waiting.fingers(0.0799, "none", holding=False)  # they jitter while they wait
    waiting.now += 0.05
    waiting.arm()
    waiting.step()
    assert waiting.stage == "close"
    waiting.begin()
    waiting.step()
    waiting.fingers(SEEN, holding=True)
    waiting.step()
    assert waiting.stage == "bring" and waiting.status.failures == 0


def test_release_by_a_restarted_controller_does_not_count(releasing: Hand) -> None:
    releasing.motion = m.MotionStatus(header=m.Header(stamp=int((releasing.now + 1.0) * 1e9)))
    releasing.step()
    releasing.fingers(0.08, holding=False)
    releasing.steps(3)
    assert releasing.did[2:] == [] and releasing.status.failures == 1 and releasing.stage != "bring"


@pytest.mark.parametrize("later", [0, 1_000_000_000], ids=["together", "the arm again"])
def test_restarted_executor_forgets_arm_and_fingers(waiting: Hand, later: int) -> None:
    stamp = int((waiting.now + 1.0) * 1e9)
    waiting.motion = m.MotionStatus(header=m.Header(stamp=stamp + later))
    waiting.gripper = m.GripperState(header=m.Header(stamp=stamp), width=0.08)
    assert any(isinstance(one, m.PlanRequest) for one in waiting.steps(4)), "it continues at once"
