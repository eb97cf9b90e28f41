"""Fingers that wait for the arm: they are there when it is, and nothing is lost where it does not arrive."""

from __future__ import annotations

from typing import Any

import pytest

from common import messages as m
from common.tasks.stages import Command, Grip, Move, Stage, View
from common.transport.codec import decode, encode
from tests.common.tasks.test_engine import CELL, THERE, Cell, Fetch

SEEN = 0.05  # [m] wide


class Take(Fetch):
    """Takes what is so wide, brings it there, and lets go."""

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
    """The arm is about to arrive and the fingers have begun to close."""
    hand = Hand()
    hand.until_waiting()
    hand.begin()
    return hand


@pytest.fixture
def releasing(closing: Hand) -> Hand:
    """The arm is about to arrive with what it took, and the fingers have begun to open."""
    closing.arm()
    closing.step()
    closing.fingers(SEEN, holding=True)
    closing.until_waiting()
    closing.begin()
    assert closing.task.did == ["reach", "close"]
    return closing


def stage(hand: Hand) -> str:
    return hand.task.running.stage.name if hand.task.running else ""


def test_fingers_are_asked_to_be_there_when_the_arm_is_and_to_touch_nothing_before() -> None:
    hand = Hand()
    command, gripper = hand.until_waiting(), hand.task.gripper
    assert command.after == hand.motion.id and stage(hand) == "reach" == hand.task.status.stage
    assert command.lead == pytest.approx(gripper.least_time(0.08 - SEEN)) and 0.1 < command.lead < 0.3
    hand.begin()
    hand.arm()
    hand.step()
    hand.fingers(SEEN, holding=True)
    release = hand.until_waiting()
    assert 0.0 < release.lead < 0.06 and release.within <= 0.005, "what is let go falls where it was to"


def test_fingers_that_take_very_long_are_asked_for_with_a_lead_that_a_command_may_have() -> None:
    hand = Hand(gripper=CELL.robot.gripper.model_copy(update={"speed": 0.001}))
    command = hand.until_waiting()
    assert decode(m.GripperCommand, encode(command)) == command


def test_fingers_are_asked_for_late_in_a_long_motion() -> None:
    hand = Hand()
    while not hand.motion.id:
        hand.step()
    assert isinstance(hand.task.running.stage, Move) and not hand.grips()
    hand.task.running.stage.trajectory.points[-1].time_from_start = 10.0
    for progress, speed, asked in ((0.0, 1.0, 0), (0.85, 1.0, 0), (0.95, 0.3, 0), (0.95, 1.0, 1)):
        hand.motion = hand.motion.model_copy(update={"progress": progress, "speed_scaling": speed})
        hand.step()
        assert len(hand.grips()) == asked


def test_arm_that_arrives_has_the_fingers_followed_and_asks_them_for_nothing_twice(closing: Hand) -> None:
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


def test_what_is_let_go_a_moment_before_the_arm_stands_did_not_fall(releasing: Hand) -> None:
    releasing.fingers(0.0506, holding=False, state="active")
    assert releasing.step() == [] and releasing.task.status.failures == 0
    releasing.arm()
    releasing.step()
    releasing.fingers(0.08, holding=False)
    releasing.step()
    releasing.step()
    assert releasing.task.status.state == "DONE" and releasing.task.status.failures == 0


def test_what_falls_while_the_fingers_still_wait_fell() -> None:
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
@pytest.mark.parametrize("begun", [True, False])
def test_arm_that_does_not_arrive_has_the_fingers_end_before_anything_else_is_decided(end: str, begun: bool) -> None:
    hand = Hand()
    hand.until_waiting()
    if begun:
        hand.begin()
    hand.arm(end)
    for _ in range(20 if begun else 1):
        assert not [command for command in hand.step() if not isinstance(command, m.PlanRequest)]
        hand.task.status.paused = False  # resumed
    if begun:
        hand.fingers(SEEN, holding=True)
    else:
        hand.call_off()
    for _ in range(3):
        hand.task.status.paused = False
        hand.step()
    assert stage(hand) == ("bring" if begun else "reach") and hand.task.did == []


def test_stop_on_the_way_begins_nothing_more(closing: Hand) -> None:
    for command in closing.task.command("stop", closing.view):
        assert isinstance(command, m.StopRequest)
    closing.arm("cancelled")
    closing.fingers(SEEN, holding=True)
    for _ in range(20):
        assert closing.step() == []


@pytest.mark.parametrize("holding", [True, False])
def test_start_after_a_stop_lets_nothing_fall_that_somebody_put_in_the_hand_meanwhile(
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


def test_fingers_that_somebody_told_something_else_while_they_waited_are_decided_about_anew_at_once() -> None:
    hand = Hand()
    hand.until_waiting()
    hand.waits = None
    hand.now += 0.05
    hand.fingers(0.07, holding=False, id="of somebody")
    hand.now += 0.05
    hand.arm()
    before = len(hand.asked)
    for _ in range(4):
        hand.step()
    assert any(isinstance(one, m.PlanRequest) for one in hand.asked[before:]) and stage(hand) != "close"


@pytest.mark.parametrize("error", ["stale_request", "hardware_fault", "unknown_goal"])
def test_fingers_that_refuse_let_the_arm_arrive_and_are_asked_once_more_then(error: str) -> None:
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


def test_fingers_that_hold_already_are_not_asked_to_wait() -> None:
    hand = Hand()
    hand.gripper = m.GripperState(width=SEEN, holding=True)
    hand.task.queue += [Move("reach", "REACHING", goal=THERE),
                      Grip("close", "REACHING", width=0.0, holds=True, early=True, expected_width=SEEN)]
    for _ in range(10):
        hand.step()
    assert not hand.grips() and stage(hand) == "reach"


def test_row_that_is_thrown_away_has_what_was_let_go_early_be_let_go_and_not_fallen(releasing: Hand) -> None:
    releasing.task.clear()
    releasing.fingers(0.0506, holding=False, state="active")
    assert releasing.step() == [] and releasing.task.status.failures == 0
    releasing.arm()
    releasing.step()
    releasing.fingers(0.08, holding=False)
    releasing.step()
    assert releasing.task.did[2:] == ["bring", "release"] and releasing.task.status.failures == 0


@pytest.mark.parametrize("end", ["stop", "aborted", "cancelled"])
def test_what_is_let_go_by_an_arm_that_does_not_arrive_is_let_go_once(releasing: Hand, end: str) -> None:
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


def test_what_is_let_go_after_a_long_pause_by_an_arm_that_does_not_arrive_is_let_go(closing: Hand) -> None:
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
def test_fingers_that_are_never_heard_of_again_keep_nothing_from_being_decided(closing: Hand, end: str) -> None:
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


def test_arm_that_its_fingers_closed_ahead_of_is_no_failure(closing: Hand) -> None:
    closing.arm("aborted", error=m.CLOSED_BEFORE, message="held up")
    closing.step()
    closing.fingers(0.0, holding=False, state="aborted", outcome="empty")
    closing.step()
    assert closing.task.status.failures == 0 and stage(closing) == "open", "it does not go down with closed fingers"
    closing.fingers(0.08, holding=False)
    for _ in range(3):
        closing.step()
    assert closing.task.status.failures == 0 and stage(closing) == "reach"


def test_arm_that_is_held_up_each_time_its_fingers_close_is_waited_for_the_next_time(closing: Hand) -> None:
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
    assert closing.until_waiting().after, "what was taken is let go early again"
    assert closing.task.status.failures == 0


def test_report_of_before_the_arm_stood_is_not_taken_for_fingers_that_forgot() -> None:
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


def test_what_was_let_go_is_not_done_when_the_controller_has_forgotten_where_the_arm_was_going(releasing: Hand) -> None:
    releasing.motion = m.MotionStatus(header=m.Header(stamp=int((releasing.now + 1.0) * 1e9)))
    releasing.step()
    releasing.fingers(0.08, holding=False)
    for _ in range(3):
        releasing.step()
    assert releasing.task.did[2:] == [] and releasing.task.status.failures == 1 and stage(releasing) != "bring"


@pytest.mark.parametrize("later", [0, 1_000_000_000], ids=["together", "the arm again"])
def test_executor_that_was_started_again_tells_in_its_first_reports_that_it_forgot_both(later: int) -> None:
    hand = Hand()
    hand.until_waiting()
    stamp = int((hand.now + 1.0) * 1e9)
    hand.motion = m.MotionStatus(header=m.Header(stamp=stamp + later))
    hand.gripper = m.GripperState(header=m.Header(stamp=stamp), width=0.08)
    before = len(hand.asked)
    for _ in range(4):
        hand.step()
    assert any(isinstance(one, m.PlanRequest) for one in hand.asked[before:]), "it goes on at once"
