"""Gripper commands sent before the arm arrives, also when it does not arrive."""

from __future__ import annotations

from typing import Any

import pytest

from common import messages as m
from common.tasks.stages import Command, Grip, Move, Stage, View
from common.transport.codec import decode, encode
from tests.common.tasks.test_engine import CELL, THERE, Cell, Fetch

SEEN = 0.05  # [m] wide


class Take(Fetch):
    """Take an object of known width, bring it, and release it."""

    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        self.did: list[str] = []

    def succeeded(self, stage: Stage, view: View) -> None:
        self.did.append(stage.name)

    def decide(self, view: View) -> None:
        if self.status.state == "DONE":
            return
        if view.holding:
            self.queue += [Move("bring", "BRINGING", goal=THERE, carries=True),
                         Grip("release", "BRINGING", width=0.08, holds=False, carries=True, early=True)]
        elif self.status.state == "BRINGING":
            self.end("DONE")
        else:
            self.queue += [
                Move("reach", "REACHING", goal=THERE),
                Grip("close", "REACHING", width=0.0, holds=True, early=True, expected_width=SEEN),
                Move("bring", "BRINGING", goal=THERE, carries=True),
                Grip("release", "BRINGING", width=0.08, holds=False, carries=True, early=True),
            ]


class Hand(Cell):
    """A cell in which a motion takes a second; a test says when fingers that wait for its end begin."""

    def __init__(self, **robot: Any) -> None:
        super().__init__(**robot)
        self.task = Take(self.task.p, m.TaskStatus(), "t")
        self.gripper = m.GripperState(width=0.08)
        self.waits: m.GripperCommand | None = None

    def answer(self, command: Command) -> None:
        if isinstance(command, m.GripperCommand) and command.after == self.motion.id:
            assert self.motion.state == "active"
            self.waits = command
            self.task.on_goal(m.GripperState(
                header=m.Header(stamp=self.stamp), id=command.id, state="active"), self.view)
        else:
            super().answer(command)

    @property
    def stamp(self) -> int:
        return int(self.now * 1e9)

    def grips(self) -> list[m.GripperCommand]:
        return [command for command in self.asked if isinstance(command, m.GripperCommand)]

    def until_waiting(self) -> m.GripperCommand:
        for _ in range(300):
            self.step()
            if self.waits is not None:
                return self.waits
        raise AssertionError("never")

    def begin(self) -> None:
        """The arm is about to arrive."""
        assert self.waits is not None
        self.fingers(self.gripper.width, holding=self.gripper.holding, state="active", id=self.waits.id)
        self.waits = None
        self.step()

    def call_off(self) -> None:
        assert self.waits is not None
        self.fingers(self.gripper.width, holding=self.gripper.holding, state="cancelled", id=self.waits.id)
        self.waits = None

    def fingers(self, width: float, *, holding: bool, state: str = "succeeded", **more: Any) -> None:
        self.gripper = self.gripper.model_copy(update={
            "header": m.Header(stamp=self.stamp), "state": state, "width": width, "holding": holding,
            "moving": state == "active", **more})

    def arm(self, state: str = "succeeded", **more: Any) -> None:
        self.motion = self.motion.model_copy(update={"header": m.Header(stamp=self.stamp), "state": state, **more})


@pytest.fixture
def closing() -> Hand:
    """The arm is about to arrive and the fingers have started to close."""
    hand = Hand()
    hand.until_waiting()
    hand.begin()
    return hand


@pytest.fixture
def releasing(closing: Hand) -> Hand:
    """The arm is about to arrive with its object, and the fingers have started to open."""
    closing.arm()
    closing.step()
    closing.fingers(SEEN, holding=True)
    closing.until_waiting()
    closing.begin()
    assert closing.task.did == ["reach", "close"]
    return closing


def stage(hand: Hand) -> str:
    return hand.task.running.stage.name if hand.task.running else ""


def test_early_close_starts_within_its_lead_and_touches_nothing_before() -> None:
    hand = Hand()
    command, gripper = hand.until_waiting(), hand.task.gripper
    assert command.after == hand.motion.id and stage(hand) == "reach" == hand.task.status.stage
    assert command.lead == pytest.approx(gripper.least_time(0.08 - SEEN)) and 0.1 < command.lead < 0.3
    hand.begin()
    hand.arm()
    hand.step()
    hand.fingers(SEEN, holding=True)
    release = hand.until_waiting()
    assert 0.0 < release.lead < 0.06 and release.within <= 0.005, "the object falls at its destination"


def test_lead_of_slow_fingers_is_limited() -> None:
    hand = Hand(gripper=CELL.robot.gripper.model_copy(update={"speed": 0.001}))
    command = hand.until_waiting()
    assert decode(m.GripperCommand, encode(command)) == command


def test_early_command_is_sent_late_in_a_long_motion() -> None:
    hand = Hand()
    while not hand.motion.id:
        hand.step()
    assert isinstance(hand.task.running.stage, Move) and not hand.grips()
    hand.task.running.stage.trajectory.points[-1].time_from_start = 10.0
    for progress, speed, asked in ((0.0, 1.0, 0), (0.85, 1.0, 0), (0.95, 0.3, 0), (0.95, 1.0, 1)):
        hand.motion = hand.motion.model_copy(update={"progress": progress, "speed_scaling": speed})
        hand.step()
        assert len(hand.grips()) == asked


def test_early_command_is_not_repeated_after_arrival(closing: Hand) -> None:
    closing.arm()
    closing.step()
    assert stage(closing) == "close" and closing.task.status.stage == "close"
    closing.fingers(SEEN, holding=True)
    closing.step()
    assert stage(closing) == "bring" and len(closing.grips()) == 1 and closing.task.status.failures == 0


def test_time_in_motion_is_counted_once(closing: Hand) -> None:
    closing.arm()
    closing.step()
    closing.fingers(SEEN, holding=True)
    closing.step()
    assert closing.task.status.moving_seconds <= closing.now - 100.0 + 1e-6


def test_release_just_before_standstill_is_no_loss(releasing: Hand) -> None:
    releasing.fingers(0.0506, holding=False, state="active")
    assert releasing.step() == [] and releasing.task.status.failures == 0
    releasing.arm()
    releasing.step()
    releasing.fingers(0.08, holding=False)
    releasing.step()
    releasing.step()
    assert releasing.task.status.state == "DONE" and releasing.task.status.failures == 0


def test_loss_while_the_fingers_wait_is_a_loss() -> None:
    hand = Hand()
    hand.until_waiting()
    hand.begin()
    hand.arm()
    hand.step()
    hand.fingers(SEEN, holding=True)
    hand.until_waiting()
    hand.fingers(0.0, holding=False, outcome="slipping")
    asked = hand.step()
    assert [type(command) for command in asked] == [m.StopRequest] and hand.task.status.failures == 1
    assert "fell" in hand.task.status.message


@pytest.mark.parametrize("end", ["aborted", "cancelled"])
@pytest.mark.parametrize("started", [True, False])
def test_interrupted_motion_waits_for_the_early_fingers(end: str, started: bool) -> None:
    hand = Hand()
    hand.until_waiting()
    if started:
        hand.begin()
    hand.arm(end)
    for _ in range(20 if started else 1):
        assert not [command for command in hand.step() if not isinstance(command, m.PlanRequest)]
        hand.task.status.paused = False  # resumed
    if started:
        hand.fingers(SEEN, holding=True)
    else:
        hand.call_off()
    for _ in range(3):
        hand.task.status.paused = False
        hand.step()
    assert stage(hand) == ("bring" if started else "reach") and hand.task.did == []


def test_stop_during_the_motion_starts_nothing(closing: Hand) -> None:
    for command in closing.task.command("stop", closing.view):
        assert isinstance(command, m.StopRequest)
    closing.arm("cancelled")
    closing.fingers(SEEN, holding=True)
    for _ in range(20):
        assert closing.step() == []


@pytest.mark.parametrize("holding", [True, False])
def test_start_after_a_stop_does_not_drop_an_object(
    closing: Hand, holding: bool
) -> None:
    closing.task.command("stop", closing.view)
    closing.arm("cancelled")
    closing.fingers(0.0, holding=False, state="aborted", outcome="empty")
    for _ in range(5):
        assert closing.step() == []
    closing.fingers(SEEN if holding else 0.0, holding=holding, id="by hand", outcome="")
    closing.task.command("start", closing.view)
    before = len(closing.grips())
    for _ in range(5):
        closing.step()
    assert [grip.width for grip in closing.grips()[before:] if not grip.after] == ([] if holding else [0.08])
    assert not holding or stage(closing) == "bring"


def test_waiting_fingers_commanded_by_another_client_are_decided_again() -> None:
    hand = Hand()
    hand.until_waiting()
    hand.waits = None
    hand.now += 0.05
    hand.fingers(0.07, holding=False, id="of another client")
    hand.now += 0.05
    hand.arm()
    before = len(hand.asked)
    for _ in range(4):
        hand.step()
    assert any(isinstance(one, m.PlanRequest) for one in hand.asked[before:]) and stage(hand) != "close"


@pytest.mark.parametrize("error", ["stale_request", "hardware_fault", "unknown_goal"])
def test_rejected_early_command_is_repeated_after_arrival(error: str) -> None:
    hand = Hand()
    hand.answer = lambda command: None if isinstance(command, m.GripperCommand) else Cell.answer(hand, command)
    while not hand.grips():
        hand.step()
    hand.task.on_goal(m.GripperState(id=hand.grips()[0].id, state="rejected", error=error, message="no"), hand.view)
    for _ in range(5):
        assert hand.step() == [] and stage(hand) == "reach"
    hand.arm()
    hand.step()
    assert len(hand.grips()) == 2 and not hand.grips()[1].after and stage(hand) == "close"


def test_fingers_that_already_hold_are_not_sent_early() -> None:
    hand = Hand()
    hand.gripper = m.GripperState(width=SEEN, holding=True)
    hand.task.queue += [Move("reach", "REACHING", goal=THERE),
                      Grip("close", "REACHING", width=0.0, holds=True, early=True, expected_width=SEEN)]
    for _ in range(10):
        hand.step()
    assert not hand.grips() and stage(hand) == "reach"


def test_early_release_counts_after_the_queue_is_cleared(releasing: Hand) -> None:
    releasing.task.clear()
    releasing.fingers(0.0506, holding=False, state="active")
    assert releasing.step() == [] and releasing.task.status.failures == 0
    releasing.arm()
    releasing.step()
    releasing.fingers(0.08, holding=False)
    releasing.step()
    assert releasing.task.did[2:] == ["bring", "release"] and releasing.task.status.failures == 0


@pytest.mark.parametrize("end", ["stop", "aborted", "cancelled"])
def test_early_release_of_an_interrupted_motion_counts_once(releasing: Hand, end: str) -> None:
    if end == "stop":
        releasing.task.command("stop", releasing.view)
        end = "cancelled"
    releasing.arm(end)
    releasing.fingers(0.0506, holding=False, state="active")
    releasing.step()
    assert releasing.task.did[2:] == []
    releasing.fingers(0.08, holding=False)
    for _ in range(3):
        releasing.step()
    assert releasing.task.did[2:] == ["release"] and not releasing.task.active_stages


def test_early_release_after_a_long_pause_counts(closing: Hand) -> None:
    closing.arm()
    closing.step()
    closing.fingers(SEEN, holding=True)
    closing.until_waiting()
    closing.arm("active", held=True)
    closing.step()
    closing.now += 60.0
    closing.step()
    closing.arm("active", held=False)
    closing.step()
    closing.begin()
    closing.fingers(0.0506, holding=False, state="active")
    closing.arm("aborted")
    closing.step()
    closing.step()
    closing.fingers(0.08, holding=False)
    closing.step()
    assert closing.task.did == ["reach", "close", "release"]


@pytest.mark.parametrize("end", ["forgotten", "refused", "forever"])
def test_silent_fingers_do_not_block_decisions(closing: Hand, end: str) -> None:
    closing.arm("aborted")
    closing.step()
    if end == "forgotten":
        closing.gripper = m.GripperState(header=m.Header(stamp=int((closing.now + 1.0) * 1e9)), width=0.08)
    elif end == "refused":
        closing.task.on_goal(m.GripperState(id=closing.grips()[0].id, state="rejected", error="stopped"), closing.view)
        closing.gripper = m.GripperState(width=0.08)
    else:
        closing.now += 60.0
        closing.gripper = closing.gripper.model_copy(update={"moving": False})
    for _ in range(3):
        closing.step()
    assert stage(closing) == "reach"


def test_fingers_closed_before_arrival_are_no_failure(closing: Hand) -> None:
    closing.arm("aborted", error=m.CLOSED_BEFORE, message="held up")
    closing.step()
    closing.fingers(0.0, holding=False, state="aborted", outcome="empty")
    closing.step()
    assert closing.task.status.failures == 0 and stage(closing) == "open", "it does not go down with closed fingers"
    closing.fingers(0.08, holding=False)
    for _ in range(3):
        closing.step()
    assert closing.task.status.failures == 0 and stage(closing) == "reach"


def test_next_close_waits_after_fingers_closed_before_arrival(closing: Hand) -> None:
    closing.arm("aborted", error=m.CLOSED_BEFORE, message="held up")
    closing.step()
    closing.fingers(0.08, holding=False, state="cancelled")
    while stage(closing) != "reach":
        closing.step()
    for _ in range(5):
        closing.step()
    assert len(closing.grips()) == 1
    closing.arm()
    closing.step()
    assert stage(closing) == "close" and not closing.grips()[-1].after
    closing.fingers(SEEN, holding=True)
    assert closing.until_waiting().after, "the release is early again"
    assert closing.task.status.failures == 0


def test_report_from_before_standstill_is_not_a_forgotten_command() -> None:
    hand = Hand()
    hand.until_waiting()
    waiting, hand.waits = hand.waits, None
    hand.now += 0.05
    hand.fingers(0.0799, holding=False, state="none")  # they jitter while they wait
    hand.now += 0.05
    hand.arm()
    hand.step()
    assert stage(hand) == "close"
    hand.waits = waiting
    hand.begin()
    hand.fingers(SEEN, holding=True)
    hand.step()
    assert stage(hand) == "bring" and hand.task.status.failures == 0


def test_release_by_a_restarted_controller_does_not_count(releasing: Hand) -> None:
    releasing.motion = m.MotionStatus(header=m.Header(stamp=int((releasing.now + 1.0) * 1e9)))
    releasing.step()
    releasing.fingers(0.08, holding=False)
    for _ in range(3):
        releasing.step()
    assert releasing.task.did[2:] == [] and releasing.task.status.failures == 1 and stage(releasing) != "bring"


@pytest.mark.parametrize("later", [0, 1_000_000_000], ids=["together", "the arm again"])
def test_restarted_executor_forgets_arm_and_fingers(later: int) -> None:
    hand = Hand()
    hand.until_waiting()
    stamp = int((hand.now + 1.0) * 1e9)
    hand.motion = m.MotionStatus(header=m.Header(stamp=stamp + later))
    hand.gripper = m.GripperState(header=m.Header(stamp=stamp), width=0.08)
    before = len(hand.asked)
    for _ in range(4):
        hand.step()
    assert any(isinstance(one, m.PlanRequest) for one in hand.asked[before:]), "it continues at once"
