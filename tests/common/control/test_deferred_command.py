"""Gripper commands deferred to the end of a motion: they start by the time of the arm, near its end only."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common import messages as m
from common.hardware.interface import HardwareFault
from common.hardware.mock import SimulatedFingers
from common.messages import GripperCommand, HoldRequest, StopRequest
from tests.common.control.rig import GRIPPER, START, ExecutorRig, LateArm
from tests.common.control.test_holding import FEW
from tests.common.control.trajectories import LIMITS, rest_to_rest

DOWN, AWAY = 0.4, 0.3  # [m] that the arm goes
CLOSE = GRIPPER.least_time(0.08 - 0.06)  # [s] from open fingers to the ball
OPEN = GRIPPER.least_time(0.5e-3)
WITHIN = 0.005  # [m]


class Hand(ExecutorRig):
    """A hand that goes down to a ball to take it, or goes away with the ball to release it there."""

    def __init__(self, holding: bool, delay: float = 0.0) -> None:
        start = START if holding else np.array([0.0, DOWN])
        super().__init__(LIMITS, LateArm(start, SimulatedFingers(GRIPPER), delay))
        self.executor.arm.history.delay = delay
        self.step()
        if holding:
            self.grip("close", 0.0)
            self.run(1.0)
            assert self.gripper.holding
            self.execute("go", rest_to_rest([0, 0], [-AWAY, 0.0]))
            self.begin = self.command("open", width=0.08, lead=OPEN, within=WITHIN)
        else:
            self.execute("go", rest_to_rest([0, DOWN], [0, 0.0]))
            self.begin = self.command("close", width=0.0, expected_width=0.06, lead=CLOSE, within=0.05)

    def command(self, goal: str, after: str = "go", **more: float) -> m.GripperState:
        return self.executor.command_gripper(GripperCommand(id=goal, after=after, **more), self.now)

    def hold(self, hold: bool) -> None:
        self.executor.authority.hold(HoldRequest(hold=hold, by="operator"), self.now)

    def stop(self, by: str, goal: str = "go") -> None:
        self.executor.authority.stop(StopRequest(id="" if by == "operator" else goal, by=by, reason="enough"), self.now)

    @property
    def gripper(self) -> m.GripperState:
        return self.executor.gripper.state

    @property
    def motion(self) -> m.MotionStatus:
        return self.executor.arm.status

    @property
    def height(self) -> float:
        return float(self.executor._q[1])

    @property
    def left(self) -> float:
        """Distance to the place of the release [m]."""
        return abs(float(self.executor._q[0]) + AWAY)

    def until(self, condition: Callable[[], bool], most: float = 10.0) -> float:
        """Step until the condition holds; return how long that took [s]."""
        began = self.now
        while not condition():
            self.step()
            assert self.now - began < most, (self.motion, self.gripper)
        return self.now - began

    def until_started(self, goal: str) -> None:
        self.until(lambda: self.gripper.id == goal)

    def until_grasped(self) -> float:
        waited = self.until(lambda: self.gripper.state == "succeeded" and self.gripper.id == "close")
        assert self.gripper.outcome == "grasped" and self.motion.state == "succeeded"
        return waited

    def until_arrived(self) -> float:
        return self.until(lambda: self.motion.state == "succeeded")


def broken(*_given: object) -> None:
    raise HardwareFault("no answer from the hand")


@pytest.fixture
def taking() -> Hand:
    return Hand(holding=False)


@pytest.fixture
def carrying() -> Hand:
    return Hand(holding=True)



@pytest.mark.parametrize("delay", [0.0, 0.05, 0.15, 0.3, 0.5])
def test_closing_fingers_touch_the_object_just_after_an_arm_with_any_delay_has_arrived(delay: float) -> None:
    hand = Hand(holding=False, delay=delay)
    assert (hand.begin.state, hand.begin.id) == ("active", "close") and "go" in hand.begin.message
    hand.until(lambda: hand.gripper.width < 0.079)
    assert hand.motion.state == "active" and hand.gripper.id == "close"
    hand.until(lambda: hand.gripper.width <= 0.061)
    assert hand.height <= 1e-3
    hand.until_arrived()
    assert hand.until_grasped() <= 0.05



def test_fingers_start_within_the_allowed_distance_of_the_end(carrying: Hand) -> None:
    carrying.command("wide", width=0.08, lead=10.0, within=0.002)
    carrying.until_started("wide")
    assert 0 < carrying.left <= 0.002


@pytest.mark.parametrize("share", [0.3, 1.0])
def test_slower_arm_starts_the_fingers_later(taking: Hand, share: float) -> None:
    taking.executor.speed_scaling = share
    taking.until_started("close")
    assert taking.until_arrived() == pytest.approx(CLOSE, abs=0.03)


def test_held_arm_starts_no_fingers_before_it_continues(taking: Hand) -> None:
    taking.until(lambda: taking.motion.progress > 0.5)
    taking.hold(True)
    taking.run(5.0)
    assert taking.gripper.width == 0.08 and taking.gripper.id != "close"
    taking.hold(False)
    taking.until_grasped()


@pytest.mark.parametrize("by", ["operator", "requester"])
def test_stop_cancels_a_deferred_command(taking: Hand, by: str) -> None:
    taking.until(lambda: taking.motion.progress > 0.3)
    taking.stop(by)
    taking.run(5.0)
    assert taking.gripper.width == 0.08 and taking.motion.state == "cancelled"
    assert (taking.grippers[-1].id, taking.grippers[-1].state) == ("close", "cancelled")
    assert taking.command("close", width=0.0).state == "cancelled", "a repeated request moves nothing"
    taking.run(1.0)
    assert taking.gripper.width == 0.08


def test_stop_of_a_deferred_command_lets_the_arm_arrive_without_it(taking: Hand) -> None:
    taking.stop("requester", "close")
    taking.until_arrived()
    taking.run(1.0)
    assert taking.gripper.width == 0.08 and (taking.gripper.id, taking.gripper.state) == ("close", "cancelled")


@pytest.mark.parametrize("by", ["operator", "requester"])
def test_stop_while_the_fingers_close_is_reported_as_a_stop(taking: Hand, by: str) -> None:
    taking.until_started("close")
    taking.stop(by)
    taking.until(lambda: taking.motion.state != "active")
    assert (taking.motion.state, taking.motion.error, taking.motion.message) == ("cancelled", "cancelled", "enough")


def test_command_deferred_to_an_unknown_goal_is_refused_and_to_a_reached_one_starts_at_once(taking: Hand) -> None:
    refused = taking.command("other", after="unknown", width=0.0)
    assert (refused.state, refused.error) == ("rejected", "unknown_goal") and "unknown" in refused.message
    taking.until_grasped()
    assert taking.command("open", width=0.08).state == "active"
    taking.run(0.5)
    assert taking.gripper.id == "open" and taking.gripper.state == "succeeded"



def test_failing_newer_command_replaces_a_deferred_one(carrying: Hand, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as faulty:
        faulty.setattr(carrying.hardware.gripper, "command", broken)
        assert carrying.command("firmer", after="", width=0.0).error == "hardware_fault"
    assert carrying.command("open", width=0.08).state == "cancelled"
    carrying.until(lambda: carrying.motion.state != "active")
    carrying.run(1.0)
    assert carrying.gripper.holding, "the object is still held"


def test_running_command_is_checked_while_another_is_deferred(carrying: Hand) -> None:
    assert carrying.gripper.outcome == "grasped" and carrying.gripper.id == "close"
    carrying.world.edit(m.WorldEdit(op="remove", id="ball_1"), carrying.now)
    carrying.run(0.02)
    assert carrying.gripper.outcome == "slipping" and carrying.gripper.id == "close"


def test_fingers_that_fail_to_start_stop_the_arm(taking: Hand, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(taking.hardware.gripper, "command", broken)
    taking.until(lambda: taking.motion.state == "aborted")
    assert taking.motion.error == "hardware_fault" and "no answer" in taking.motion.message
    state = taking.command("close", width=0.0)
    assert (state.state, state.error) == ("aborted", "hardware_fault")


@pytest.mark.parametrize("how", ["held", "slowed", "no processor"])
def test_arm_does_not_continue_with_fingers_that_closed_early(taking: Hand, how: str) -> None:
    taking.until_started("close")
    if how == "held":
        taking.hold(True)
    elif how == "slowed":
        taking.executor.speed_scaling = 0.1
    else:
        taking.step(0.3)
    taking.until(lambda: taking.motion.state != "active")
    before = taking.height
    assert (taking.motion.state, taking.motion.error) == ("aborted", m.CLOSED_BEFORE)
    taking.executor.speed_scaling = 1.0
    taking.hold(False)
    taking.run(3.0)
    assert taking.height == pytest.approx(before, abs=1e-3) and taking.gripper.state != "active"


def test_arm_does_not_continue_with_fingers_that_closed_early_on_any_width(taking: Hand) -> None:
    taking.command("any width", width=0.0, lead=CLOSE, within=0.05)
    taking.until_started("any width")
    taking.hold(True)
    taking.run(1.0)
    before = taking.height
    taking.hold(False)
    taking.run(1.0)
    assert taking.motion.error == m.CLOSED_BEFORE and taking.height == pytest.approx(before, abs=1e-3)


def test_arm_held_while_the_fingers_open_still_arrives(carrying: Hand) -> None:
    carrying.until_started("open")
    carrying.hold(True)
    carrying.run(1.0)
    assert carrying.motion.state == "active" and not carrying.gripper.holding and carrying.left <= WITHIN
    carrying.hold(False)
    carrying.until_arrived()


@FEW
@given(stalls=st.lists(st.tuples(st.floats(0.0, 1.5), st.floats(0.03, 0.6)), max_size=5), speed=st.floats(0.2, 1.0),
       lead=st.floats(0.0, 1.0))
def test_stall_at_any_time_does_not_displace_a_released_object(
    stalls: list[tuple[float, float]], speed: float, lead: float,
) -> None:
    hand = Hand(holding=True)
    hand.command("sooner", width=0.08, lead=lead, within=WITHIN)
    hand.executor.speed_scaling = speed
    began, left = hand.now, sorted(stalls)
    while hand.gripper.holding:
        due = bool(left) and (hand.now - began) * speed >= left[0][0]
        hand.step(left.pop(0)[1] if due else 0.01)
        assert hand.now - began < 120.0
    hand.run(1.0)
    assert math.dist((hand.balls[-1].poses[0].position.x, hand.balls[-1].poses[0].position.y), (0.2, 0.0)) <= WITHIN


@FEW
@given(at=st.floats(0.0, 0.15), stall=st.floats(0.03, 0.6), speed=st.floats(0.2, 1.0))
def test_stall_at_any_time_does_not_let_the_arm_continue_with_closed_fingers(
    at: float, stall: float, speed: float,
) -> None:
    hand = Hand(holding=False)
    hand.executor.speed_scaling = speed
    hand.until_started("close")
    hand.run(at)
    hand.step(stall)
    closed = list[float]()
    while hand.motion.state == "active":
        closed += [hand.height] if hand.gripper.width <= 0.061 else []
        hand.step()
    hand.run(1.0)
    assert not closed or np.ptp([*closed, hand.height]) <= 0.002
