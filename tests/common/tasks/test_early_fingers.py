"""Fingers that begin while the arm comes to rest: they are there when it is, and nothing is lost where it does not."""

from __future__ import annotations

from typing import Any

import pytest

from common import messages as m
from common.tasks.stages import Command, Grip, Move, Stage, View
from tests.common.tasks.test_engine import THERE, Cell, Fetch

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
            self.row += [Move("bring", "BRINGING", goal=THERE, carries=True),
                         Grip("release", "BRINGING", width=0.08, holds=False, carries=True, early=True)]
        elif self.status.state == "BRINGING":
            self.end("DONE")
        else:
            self.row += [
                Move("reach", "REACHING", goal=THERE),
                Grip("close", "REACHING", width=0.0, holds=True, early=True, expected_width=SEEN),
                Move("bring", "BRINGING", goal=THERE, carries=True),
                Grip("release", "BRINGING", width=0.08, holds=False, carries=True, early=True),
            ]


class Hand(Cell):
    """A cell in which a motion takes a second and a step a hundredth of one."""

    def __init__(self) -> None:
        super().__init__()
        self.task = Take(self.task.p, m.TaskStatus(), "t")
        self.began = self.told = 0.0
        self.silent = False

    def step(self) -> list[object]:
        self.now -= 0.09
        if self.motion.state == "active" and not (self.motion.held or self.silent) and self.now - self.told > 0.09:
            self.told = self.now
            self.motion = self.motion.model_copy(update={"progress": min(self.now + 0.1 - self.began, 1.0)})
        return list(super().step())

    def answer(self, command: Command) -> None:
        if isinstance(command, m.ExecuteRequest):
            self.began = self.told = self.now
        super().answer(command)

    def grips(self) -> list[m.GripperCommand]:
        return [command for command in self.asked if isinstance(command, m.GripperCommand)]

    def until_grip(self) -> float:
        """Step until the fingers are asked for something more; how long after the begin of the arm's motion [s]."""
        before = len(self.grips())
        for _ in range(300):
            self.step()
            if len(self.grips()) > before:
                return self.now - self.motion.header.stamp * 1e-9
        raise AssertionError("never")

    def fingers(self, width: float, *, holding: bool, state: str = "succeeded") -> None:
        self.gripper = self.gripper.model_copy(update={
            "state": state, "width": width, "holding": holding, "moving": state == "active"})

    def arm(self, state: str = "succeeded") -> None:
        self.motion = self.motion.model_copy(update={"state": state})


@pytest.fixture
def closing() -> Hand:
    """The arm is about to arrive and the fingers have begun to close."""
    hand = Hand()
    hand.gripper = m.GripperState(width=0.08)
    hand.until_grip()
    return hand


@pytest.fixture
def releasing(closing: Hand) -> Hand:
    """The arm is about to arrive with what it took, and the fingers have begun to open."""
    closing.arm()
    closing.step()
    closing.fingers(SEEN, holding=True)
    closing.until_grip()
    assert closing.task.did == ["reach", "close"]
    return closing


def stage(hand: Hand) -> str:
    return hand.task.running.stage.name if hand.task.running else ""


def test_fingers_close_so_late_that_they_touch_nothing_before_the_arm_stands() -> None:
    hand = Hand()
    began = hand.until_grip()
    least = hand.task.gripper.least_time(0.08 - SEEN)
    assert 1.0 - least <= began < 1.0 - least + 0.021 and 0.1 < least < 0.3
    assert stage(hand) == "reach" and hand.task.status.stage == "reach" and hand.motion.state == "active"


def test_who_waits_for_the_right_time_says_when_that_is() -> None:
    hand = Hand()
    while not hand.motion.id:
        hand.step()
    hand.step()
    least = hand.task.gripper.least_time(0.08 - SEEN)
    assert hand.task.due == pytest.approx(hand.now + 1.0 - least)
    hand.motion = hand.motion.model_copy(update={"speed_scaling": 0.5})
    hand.step()
    assert hand.task.due == pytest.approx(hand.now + 2.0 - least), "at half the speed it takes two"
    hand.motion = hand.motion.model_copy(update={"held": True})
    hand.step()
    assert hand.task.due == float("inf"), "as long as it is held nobody knows"


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
    reached = closing.task.status.moving_seconds
    assert reached <= closing.now - 100.0 + 1e-6


def test_what_is_let_go_a_moment_before_the_arm_stands_did_not_fall(closing: Hand) -> None:
    closing.arm()
    closing.step()
    closing.fingers(SEEN, holding=True)
    began = closing.until_grip()
    assert 0.9 < began < 1.0 and closing.grips()[-1].width == 0.08
    closing.fingers(0.0506, holding=False, state="active")
    assert closing.step() == [] and closing.task.status.failures == 0
    closing.arm()
    closing.step()
    closing.fingers(0.08, holding=False)
    closing.step()
    closing.step()
    assert closing.task.status.state == "DONE" and closing.task.status.failures == 0


def test_held_arm_has_no_fingers_begin() -> None:
    hand = Hand()
    for _ in range(70):
        hand.step()
    hand.motion = hand.motion.model_copy(update={"held": True})
    for _ in range(100):
        assert hand.step() == []
    assert not hand.grips()


@pytest.mark.parametrize("end", ["aborted", "cancelled"])
def test_arm_that_does_not_arrive_has_the_fingers_end_before_anything_else_is_decided(closing: Hand, end: str) -> None:
    closing.arm(end)
    for _ in range(20):
        assert not [command for command in closing.step() if not isinstance(command, m.PlanRequest)]
        closing.task.status.paused = False  # resumed
    closing.fingers(SEEN, holding=True)
    closing.step()
    closing.step()
    assert stage(closing) == "bring", "with what they took meanwhile"


def test_stop_on_the_way_begins_nothing_more(closing: Hand) -> None:
    for command in closing.task.command("stop", closing.view):
        assert isinstance(command, m.StopRequest)
    closing.arm("cancelled")
    closing.fingers(SEEN, holding=True)
    for _ in range(20):
        assert closing.step() == []


@pytest.mark.parametrize("error", ["stale_request", "hardware_fault"])
def test_fingers_that_refuse_let_the_arm_arrive_and_are_asked_anew(closing: Hand, error: str) -> None:
    refused = m.GripperState(id=closing.grips()[0].id, state="rejected", error=error, message="no")
    closing.task.on_goal(refused, closing.view)
    closing.gripper = m.GripperState(width=0.08)
    assert closing.step() == [] and stage(closing) == "reach"
    closing.arm()
    closing.until_grip()
    assert len(closing.grips()) == 2 and closing.task.status.failures == (error == "hardware_fault")


def test_fingers_that_stand_open_or_hold_already_are_not_begun_early() -> None:
    hand = Hand()
    hand.gripper = m.GripperState(width=0.08)
    for _ in range(50):
        hand.step()
    hand.fingers(SEEN, holding=True)  # something came between them by itself
    for _ in range(100):
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
    assert releasing.task.did[2:] == ["release"] and not releasing.task.under_way


def test_fingers_whose_command_is_on_its_way_end_before_anything_is_decided_when_the_arm_does_not_arrive() -> None:
    hand = Hand()
    hand.gripper = m.GripperState(width=0.08)
    answer, waiting = hand.answer, list[Any]()
    hand.answer = lambda command: waiting.append(command) if isinstance(command, m.GripperCommand) else answer(command)
    hand.until_grip()
    hand.arm("aborted")
    for _ in range(20):
        assert hand.step() == []
    answer(waiting[0])
    assert hand.step() == [] and not hand.task.running
    hand.fingers(SEEN, holding=True)
    hand.step()
    hand.step()
    assert stage(hand) == "bring"


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


@pytest.mark.parametrize("ahead", [-0.18, 0.18])
def test_fingers_touch_nothing_before_the_arm_stands_whatever_its_clock_says(ahead: float) -> None:
    hand = Hand()
    while not hand.motion.id:
        hand.step()
    began, stamp = hand.now, int((hand.now + ahead) * 1e9)
    hand.motion = hand.motion.model_copy(update={"header": m.Header(stamp=stamp)})
    hand.until_grip()
    least = hand.task.gripper.least_time(0.08 - SEEN)
    assert 1.0 - least <= hand.now - began < 1.0 - least + 0.021


def test_arm_that_is_being_stopped_has_no_fingers_begin() -> None:
    hand = Hand()
    for _ in range(60):
        hand.step()
    hand.motion = hand.motion.model_copy(update={"message": "stopping: j1 is 0.2000 rad off its path"})
    for _ in range(60):
        assert hand.step() == []
    hand.arm("aborted")
    assert not hand.grips()


@pytest.mark.parametrize("before", [{"held": True}, {"speed_scaling": 0.1}])
def test_arm_that_goes_on_by_a_ramp_has_the_fingers_begin_when_it_stands(before: dict[str, Any]) -> None:
    hand = Hand()
    for _ in range(50):
        hand.step()
    going = hand.motion.model_copy(update={"progress": 0.9})
    hand.motion = going.model_copy(update=before)
    hand.step()
    hand.motion = going
    for _ in range(50):
        hand.step()
    assert not hand.grips()
    hand.arm()
    hand.step()
    assert stage(hand) == "close"


@pytest.mark.parametrize("late", [{"held": True, "message": "held"}, {"speed_scaling": 0.1}])
def test_arm_does_not_go_on_down_with_fingers_that_closed_while_it_was_held_or_slowed(
    closing: Hand, late: dict[str, Any],
) -> None:
    going = closing.motion
    closing.motion = going.model_copy(update=late)
    asked = closing.step()
    assert [(c.id, c.by) for c in asked if isinstance(c, m.StopRequest)] == [(going.id, "requester")]
    closing.arm("cancelled")
    closing.fingers(SEEN, holding=True)
    for _ in range(5):
        closing.step()
    closing.motion = going.model_copy(update={"state": "cancelled"})
    closing.step()
    closing.step()
    assert stage(closing) == "bring" and closing.task.status.failures == 0


def test_arm_that_is_held_as_the_fingers_let_go_goes_on_to_where_it_was_going(releasing: Hand) -> None:
    releasing.motion = releasing.motion.model_copy(update={"held": True})
    assert releasing.step() == [] and stage(releasing) == "bring"


def test_arm_of_which_nothing_is_heard_any_more_has_no_fingers_begin() -> None:
    hand = Hand()
    for _ in range(20):
        hand.step()
    hand.silent = True
    for _ in range(200):
        hand.step()
    assert not hand.grips() and stage(hand) == "reach" and hand.task.due == float("inf")


def test_what_was_let_go_is_not_done_when_the_controller_has_forgotten_where_the_arm_was_going(releasing: Hand) -> None:
    releasing.motion = m.MotionStatus(header=m.Header(stamp=int((releasing.now + 1.0) * 1e9)))
    releasing.step()
    releasing.fingers(0.08, holding=False)
    for _ in range(3):
        releasing.step()
    assert releasing.task.did[2:] == [] and releasing.task.status.failures == 1 and stage(releasing) != "bring"
