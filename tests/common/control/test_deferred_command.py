"""Gripper commands deferred to the end of a motion: they start by the time of the arm, near its end only."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common import messages as m
from common.hardware.interface import HardwareFault, Limits, Vector
from common.hardware.mock import MockHardware, SimulatedFingers
from common.messages import GripperCommand, HoldRequest, StopRequest
from tests.common.control.rig import GRIPPER, START, ExecutorRig
from tests.common.hardware.conftest import Make

DOWN, AWAY = 0.4, 0.3  # [m] that the arm goes
CLOSE = GRIPPER.least_time(0.08 - 0.06)  # [s] from open fingers to the ball
OPEN = GRIPPER.least_time(0.5e-3)
WITHIN = 0.005  # [m]


class LateArm(MockHardware):
    """At each set-point so much later [s]."""

    def __init__(self, start: Vector, delay: float, gripper: SimulatedFingers) -> None:
        super().__init__(start, gripper)
        self._delay = delay
        self._sent = [(-math.inf, start, 0.0 * start)]

    def read(self, now: float) -> tuple[Vector, Vector]:
        while len(self._sent) > 1 and self._sent[1][0] <= now - self._delay + 1e-6:
            self._sent.pop(0)
        return self._sent[0][1].copy(), self._sent[0][2].copy()

    def write(self, positions: Vector, velocities: Vector, now: float) -> None:
        self._sent.append((now, positions.copy(), velocities.copy()))


class Hand(ExecutorRig):
    """The hand above a ball, or with the ball in it and on its way somewhere else."""

    def __init__(self, limits: Limits, trajectory: Make, holding: bool, delay: float = 0.0) -> None:
        super().__init__(limits, LateArm(START, delay, SimulatedFingers(GRIPPER)))
        self.executor.arm.history.delay = delay
        self.step()
        if holding:
            self.grip("close", 0.0)
            self.run(1.0)
            assert self.grippers[-1].holding
            self.execute("go", trajectory([0, 0], [-AWAY, 0.0]))
            self.begin = self.command("open", width=0.08, lead=OPEN, within=WITHIN)
        else:
            self.execute("up", trajectory([0, 0], [0, DOWN]))
            self.run(3.0)
            self.execute("go", trajectory([0, DOWN], [0, 0.0]))
            self.begin = self.command("close", width=0.0, expected_width=0.06, lead=CLOSE, within=0.05)

    def command(self, goal: str, after: str = "go", **more: float) -> m.GripperState:
        return self.executor.command_gripper(GripperCommand(id=goal, after=after, **more), self.now)

    @property
    def width(self) -> float:
        return self.executor.gripper.state.width

    @property
    def gripper(self) -> m.GripperState:
        return self.executor.gripper.state

    @property
    def motion(self) -> m.MotionStatus:
        return self.executor.arm.status

    def until(self, condition, most: float = 10.0) -> float:
        """Step until the condition holds; return how long that took [s]."""
        began = self.now
        while not condition():
            self.step()
            assert self.now - began < most, (self.motion, self.gripper)
        return self.now - began

    @property
    def height(self) -> float:
        return float(self.executor._q[1])


def broken(*_given: object) -> None:
    raise HardwareFault("no answer from the hand")


@pytest.fixture(scope="session")
def taking(limits: Limits, rest_to_rest: Make) -> Callable[[], Hand]:
    return lambda: Hand(limits, rest_to_rest, holding=False)


@pytest.fixture(scope="session")
def carrying(limits: Limits, rest_to_rest: Make) -> Callable[[], Hand]:
    return lambda: Hand(limits, rest_to_rest, holding=True)


def test_closing_fingers_touch_the_object_just_after_the_arm_has_arrived(taking: Callable[[], Hand]) -> None:
    hand = taking()
    assert (hand.begin.state, hand.begin.id) == ("active", "close") and "go" in hand.begin.message
    hand.until(lambda: hand.width < 0.079)
    assert hand.motion.state == "active" and hand.gripper.id == "close"
    hand.until(lambda: hand.motion.state == "succeeded")
    assert not hand.gripper.holding, "they touch nothing before it has arrived"
    waited = hand.until(lambda: hand.gripper.state == "succeeded")
    assert waited <= 0.05 and hand.gripper.outcome == "grasped"


@pytest.mark.parametrize("delay", [0.05, 0.15, 0.3, 0.5])
def test_fingers_touch_nothing_before_an_arm_with_a_delay_has_arrived(
    limits: Limits, rest_to_rest: Make, delay: float,
) -> None:
    hand = Hand(limits, rest_to_rest, holding=False, delay=delay)
    hand.until(lambda: hand.width <= 0.061)
    assert hand.height <= 1e-3
    hand.until(lambda: hand.motion.state == "succeeded")
    assert hand.until(lambda: hand.gripper.state == "succeeded") <= 0.05


def test_opening_fingers_release_the_object_where_the_arm_comes_to_rest(carrying: Callable[[], Hand]) -> None:
    hand = carrying()
    hand.until(lambda: not hand.gripper.holding)
    assert hand.motion.state == "active" and abs(hand.executor._q[0] + AWAY) <= WITHIN
    hand.run(1.0)
    assert hand.motion.state == "succeeded" and hand.balls[-1].poses[0].position.x == pytest.approx(0.2, abs=WITHIN)


def test_fingers_start_within_the_allowed_distance_of_the_end(carrying: Callable[[], Hand]) -> None:
    hand = carrying()
    hand.command("wide", width=0.08, lead=10.0, within=0.002)
    hand.until(lambda: hand.gripper.id == "wide")
    assert 0 < abs(hand.executor._q[0] + AWAY) <= 0.002


@pytest.mark.parametrize("share", [0.3, 1.0])
def test_slower_arm_starts_the_fingers_later(taking: Callable[[], Hand], share: float) -> None:
    hand = taking()
    hand.executor.speed_scaling = share
    hand.until(lambda: hand.gripper.id == "close")
    left = hand.until(lambda: hand.motion.state == "succeeded")
    assert left == pytest.approx(CLOSE, abs=0.03)


def test_held_arm_starts_no_fingers_before_it_continues(taking: Callable[[], Hand]) -> None:
    hand = taking()
    hand.until(lambda: hand.motion.progress > 0.5)
    hand.executor.authority.hold(HoldRequest(hold=True, by="operator"), hand.now)
    hand.run(5.0)
    assert hand.width == 0.08 and hand.gripper.id != "close"
    hand.executor.authority.hold(HoldRequest(hold=False, by="operator"), hand.now)
    hand.until(lambda: hand.gripper.state == "succeeded" and hand.gripper.id == "close")
    assert hand.gripper.outcome == "grasped" and hand.motion.state == "succeeded"


@pytest.mark.parametrize("by", ["operator", "requester"])
def test_stop_cancels_a_deferred_command(taking: Callable[[], Hand], by: str) -> None:
    hand = taking()
    hand.until(lambda: hand.motion.progress > 0.3)
    hand.executor.authority.stop(StopRequest(id="" if by == "operator" else "go", by=by), hand.now)
    hand.run(5.0)
    assert hand.width == 0.08 and hand.motion.state == "cancelled"
    assert (hand.grippers[-1].id, hand.grippers[-1].state) == ("close", "cancelled")
    assert hand.command("close", width=0.0).state == "cancelled", "asked for again it moves nothing"
    hand.run(1.0)
    assert hand.width == 0.08


def test_stop_of_a_deferred_command_lets_the_arm_arrive_without_it(taking: Callable[[], Hand]) -> None:
    hand = taking()
    hand.executor.authority.stop(StopRequest(id="close", by="requester"), hand.now)
    hand.until(lambda: hand.motion.state == "succeeded")
    hand.run(1.0)
    assert hand.width == 0.08 and (hand.gripper.id, hand.gripper.state) == ("close", "cancelled")


@pytest.mark.parametrize("by", ["operator", "requester"])
def test_stop_while_the_fingers_close_is_reported_as_a_stop(taking: Callable[[], Hand], by: str) -> None:
    hand = taking()
    hand.until(lambda: hand.gripper.id == "close")
    hand.executor.authority.stop(StopRequest(id="" if by == "operator" else "go", by=by, reason="enough"), hand.now)
    hand.until(lambda: hand.motion.state != "active")
    assert (hand.motion.state, hand.motion.error, hand.motion.message) == ("cancelled", "cancelled", "enough")


def test_command_deferred_to_an_unknown_goal_is_refused(taking: Callable[[], Hand]) -> None:
    hand = taking()
    refused = hand.command("other", after="unknown", width=0.0)
    assert (refused.state, refused.error) == ("rejected", "unknown_goal") and "unknown" in refused.message
    hand.until(lambda: hand.gripper.state == "succeeded" and hand.gripper.id == "close")


def test_command_deferred_to_a_reached_goal_starts_at_once(taking: Callable[[], Hand]) -> None:
    hand = taking()
    hand.until(lambda: hand.motion.state == "succeeded" and hand.gripper.state == "succeeded")
    assert hand.command("open", width=0.08).state == "active"
    hand.run(0.5)
    assert hand.gripper.id == "open" and hand.gripper.state == "succeeded"


def test_newer_command_replaces_a_deferred_one(taking: Callable[[], Hand]) -> None:
    hand = taking()
    hand.command("half", after="", width=0.07)
    hand.run(5.0)
    assert hand.width == pytest.approx(0.07) and hand.gripper.id == "half"
    assert hand.command("close", width=0.0).state == "cancelled"


def test_newer_command_that_fails_replaces_a_deferred_one_too(
    carrying: Callable[[], Hand], monkeypatch: pytest.MonkeyPatch
) -> None:
    hand = carrying()
    with monkeypatch.context() as faulty:
        faulty.setattr(hand.hardware.gripper, "command", broken)
        assert hand.command("firmer", after="", width=0.0).error == "hardware_fault"
    assert hand.command("open", width=0.08).state == "cancelled"
    hand.until(lambda: hand.motion.state != "active")
    hand.run(1.0)
    assert hand.gripper.holding, "the object is still held"


def test_running_command_is_checked_while_another_is_deferred(carrying: Callable[[], Hand]) -> None:
    hand = carrying()
    assert hand.gripper.outcome == "grasped" and hand.gripper.id == "close"
    hand.world.edit(m.WorldEdit(op="remove", id="ball_1"), hand.now)
    hand.step()
    hand.step()
    assert hand.gripper.outcome == "slipping" and hand.gripper.id == "close"


def test_fingers_that_fail_to_start_stop_the_arm(
    taking: Callable[[], Hand], monkeypatch: pytest.MonkeyPatch,
) -> None:
    hand = taking()
    monkeypatch.setattr(hand.hardware.gripper, "command", broken)
    hand.until(lambda: hand.motion.state == "aborted")
    assert hand.motion.error == "hardware_fault" and "no answer" in hand.motion.message
    state = hand.command("close", width=0.0)
    assert (state.state, state.error) == ("aborted", "hardware_fault")


@pytest.mark.parametrize("how", ["held", "slowed", "no processor"])
def test_arm_does_not_continue_with_fingers_that_closed_early(taking: Callable[[], Hand], how: str) -> None:
    hand = taking()
    hand.until(lambda: hand.gripper.id == "close")
    if how == "held":
        hand.executor.authority.hold(HoldRequest(hold=True, by="operator"), hand.now)
    elif how == "slowed":
        hand.executor.speed_scaling = 0.1
    else:
        hand.step(0.3)
    hand.until(lambda: hand.motion.state != "active")
    before = hand.height
    assert (hand.motion.state, hand.motion.error) == ("aborted", m.CLOSED_BEFORE)
    hand.executor.speed_scaling = 1.0
    hand.executor.authority.hold(HoldRequest(hold=False, by="operator"), hand.now)
    hand.run(3.0)
    assert hand.height == pytest.approx(before, abs=1e-3) and hand.gripper.state != "active"


def test_arm_does_not_continue_with_fingers_that_closed_early_on_any_width(
    taking: Callable[[], Hand],
) -> None:
    hand = taking()
    hand.command("whatever", width=0.0, lead=CLOSE, within=0.05)
    hand.until(lambda: hand.gripper.id == "whatever")
    hand.executor.authority.hold(HoldRequest(hold=True, by="operator"), hand.now)
    hand.run(1.0)
    before = hand.height
    hand.executor.authority.hold(HoldRequest(hold=False, by="operator"), hand.now)
    hand.run(1.0)
    assert hand.motion.error == m.CLOSED_BEFORE and hand.height == pytest.approx(before, abs=1e-3)


def test_arm_held_while_the_fingers_open_still_arrives(carrying: Callable[[], Hand]) -> None:
    hand = carrying()
    hand.until(lambda: hand.gripper.id == "open")
    hand.executor.authority.hold(HoldRequest(hold=True, by="operator"), hand.now)
    hand.run(1.0)
    hand.executor.authority.hold(HoldRequest(hold=False, by="operator"), hand.now)
    hand.until(lambda: hand.motion.state == "succeeded")


@settings(deadline=None, max_examples=25)
@given(stalls=st.lists(st.tuples(st.floats(0.0, 1.5), st.floats(0.03, 0.6)), max_size=5), speed=st.floats(0.2, 1.0),
       lead=st.floats(0.0, 1.0))
def test_stall_at_any_time_does_not_displace_a_released_object(
    carrying: Callable[[], Hand], stalls: list[tuple[float, float]], speed: float, lead: float,
) -> None:
    hand = carrying()
    hand.command("sooner", width=0.08, lead=lead, within=WITHIN)
    hand.executor.speed_scaling = speed
    began, left = hand.now, sorted(stalls)
    while hand.gripper.holding:
        due = bool(left) and (hand.now - began) * speed >= left[0][0]
        hand.step(left.pop(0)[1] if due else 0.01)
        assert hand.now - began < 120.0
    hand.run(1.0)
    assert math.dist((hand.balls[-1].poses[0].position.x, hand.balls[-1].poses[0].position.y), (0.2, 0.0)) <= WITHIN


@settings(deadline=None, max_examples=25)
@given(at=st.floats(0.0, 0.15), stall=st.floats(0.03, 0.6), speed=st.floats(0.2, 1.0))
def test_stall_at_any_time_does_not_let_the_arm_continue_with_closed_fingers(
    taking: Callable[[], Hand], at: float, stall: float, speed: float,
) -> None:
    hand = taking()
    hand.executor.speed_scaling = speed
    hand.until(lambda: hand.gripper.id == "close")
    hand.run(at)
    hand.step(stall)
    closed = list[float]()
    while hand.motion.state == "active":
        closed += [hand.height] if hand.width <= 0.061 else []
        hand.step()
    hand.run(1.0)
    assert not closed or np.ptp([*closed, hand.height]) <= 0.002
