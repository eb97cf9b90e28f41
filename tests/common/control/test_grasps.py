"""A grasp is judged by what is between the fingers, however late they begin and say so; what is held is watched."""

from __future__ import annotations

from collections import deque

import msgpack
import pytest
from pydantic import ValidationError

from common.config import GripperConfig, load_cell
from common.control.gripper_controller import GripperController
from common.hardware.interface import GripperReading
from common.hardware.mock import SimulatedFingers
from common.messages import CollisionObject, GripperCommand, GripperState, Header, PlanningScene, Pose
from common.transport.codec import decode, encode

CONFIG = GripperConfig(joints=["left", "right"], links=[], max_effort=235.0)


class LateFingers:
    """Fingers that begin to move some time after they were told, and whose readings are old [s]."""

    def __init__(self, begin: float, age: float, width: float = 0.08) -> None:
        self.fingers, self.begin, self.age = SimulatedFingers(CONFIG, width), begin, age
        self.told: deque[tuple[float, float, float]] = deque()
        self.past: deque[tuple[float, GripperReading]] = deque()
        self.effort = 0.0

    def command(self, width: float, now: float, effort: float) -> None:
        self.told.append((now + self.begin, width, effort))

    def read(self, now: float) -> GripperReading:
        while self.told and self.told[0][0] <= now:
            when, width, self.effort = self.told.popleft()
            self.fingers.command(width, when, self.effort)
        self.past.append((now, self.fingers.read(now)))
        while len(self.past) > 1 and self.past[1][0] <= now - self.age:
            self.past.popleft()
        return self.past[0][1]


class Rig:
    def __init__(self, begin: float = 0.0, age: float = 0.0, width: float = 0.08) -> None:
        self.hand = LateFingers(begin, age, width)
        self.controller, self.now = GripperController(self.hand, CONFIG), 10.0
        self.run(0.2)

    def run(self, seconds: float) -> GripperState:
        for _ in range(round(seconds / 0.01)):
            self.now += 0.01
            self.controller.update(self.hand.read(self.now), self.now)
        return self.controller.state

    def told(self, width: float = 0.0, **more: float) -> GripperState:
        """The state when the goal is over."""
        self.controller.command(GripperCommand(id=f"goal {self.now:.2f}", width=width, **more), self.now)
        until = self.now + 5.0
        while self.run(0.01).state == "active":
            assert self.controller.state.moving and self.now < until
        return self.controller.state

    def between(self, width: float) -> None:
        self.hand.fingers.obstruct(width)


DELAYS = [(0.0, 0.0), (0.0, 0.1), (0.1, 0.0), (0.08, 0.1)]


@pytest.mark.parametrize(("begin", "age"), DELAYS)
@pytest.mark.parametrize(("width", "state", "outcome", "says"), [
    (0.060, "succeeded", "grasped", ""),
    (0.055, "succeeded", "grasped", ""),
    (0.066, "aborted", "too_wide", "the fingers closed on something too wide (0.0660 m, not 0.0600 m)"),
    (0.030, "aborted", "too_narrow", "the fingers closed on something too narrow (0.0300 m, not 0.0600 m)"),
    (0.0, "aborted", "empty", "the fingers closed on nothing"),
])
def test_grasp_is_judged_by_the_width_of_what_is_held(begin, age, width, state, outcome, says):
    rig = Rig(begin, age)
    rig.between(width)
    found = rig.told(expected_width=0.06, width_tolerance=0.0051)
    assert (found.state, found.outcome, found.message) == (state, outcome, says)
    assert found.holding == (width > 0) and found.width == pytest.approx(width) and not found.moving
    assert rig.run(1.0) == found, "what was said stays so"
    opened = rig.told(0.08)
    assert (opened.state, opened.outcome, opened.holding) == ("succeeded", "", False)


@pytest.mark.parametrize(("begin", "age"), DELAYS)
def test_fingers_that_are_late_have_not_missed(begin, age):
    rig = Rig(begin, age)
    rig.between(0.06)
    assert rig.told().outcome == "grasped"


class Script:
    """Readings as they are written down."""

    def __init__(self, *readings: GripperReading) -> None:
        self.readings = deque(readings)

    def command(self, width: float, now: float, effort: float) -> None:
        pass

    def read(self, now: float) -> GripperReading:
        return self.readings.popleft() if len(self.readings) > 1 else self.readings[0]


def test_fingers_that_tell_late_that_they_hold_something_have_not_missed():
    still = GripperReading(0.06, 0.0, False, False)
    script = Script(*[GripperReading(0.07, -0.1, True, False)] * 30, *[still] * 10, still._replace(holding=True))
    controller = GripperController(script, CONFIG)
    controller.command(GripperCommand(id="close", width=0.0, expected_width=0.06), 0.0)
    states = [controller.update(script.read(0.01 * k), 0.01 * k).state for k in range(1, 60)]
    assert set(states) == {"active", "succeeded"} and controller.state.outcome == "grasped"
    script = Script(GripperReading(0.07, -0.1, True, False), still)
    controller = GripperController(script, CONFIG)
    controller.command(GripperCommand(id="close", width=0.0), 0.0)
    states = [controller.update(script.read(0.01 * k), 0.01 * k).state for k in range(1, 60)]
    assert states.count("active") == pytest.approx(CONFIG.latency / 0.01, abs=2) and states[-1] == "aborted"


@pytest.mark.parametrize("expected", [{}, {"expected_width": 0.06}])
def test_what_is_held_and_slips_is_told_until_the_next_command(expected):
    rig = Rig()
    rig.between(0.06)
    goal = rig.told(**expected)
    rig.between(0.059)
    assert rig.run(0.5).outcome == "grasped", "what is soft gives way a little"
    rig.between(0.055)
    slipping = rig.run(0.5)
    assert (slipping.id, slipping.state, slipping.outcome, slipping.holding) == (
        goal.id, "succeeded", "slipping", True)
    assert slipping.message == "the held object slips: it was 0.0600 m wide, the fingers are 0.0550 m apart"
    rig.between(0.0)
    lost = rig.run(0.5)
    assert (lost.state, lost.outcome, lost.holding) == ("succeeded", "slipping", False)
    assert lost.message == "the held object slipped out: it was 0.0600 m wide, nothing is between the fingers now"
    assert rig.told(0.08).outcome == ""


def test_letting_go_is_no_slipping():
    rig = Rig()
    rig.between(0.06)
    rig.told()
    rig.controller.command(GripperCommand(id="open", width=0.08), rig.now)
    assert {rig.run(0.01).outcome for _ in range(100)} == {""}


def test_fingers_press_with_what_the_command_says_or_a_few_newtons():
    rig = Rig()
    rig.between(0.06)
    assert rig.told().effort == CONFIG.effort == 5.0
    assert rig.told(effort=40.0).effort == 40.0
    refused = rig.told(effort=300.0)
    assert refused.state == "succeeded" and rig.hand.effort == 40.0
    answer = rig.controller.command(GripperCommand(id="wide", width=0.0, expected_width=0.1), rig.now)
    assert (answer.state, answer.message) == (
        "rejected", "expected_width 0.1 m is more than the fingers open (0.08 m)")


def test_robot_file_says_how_hard_they_press():
    assert load_cell("ur5").robot.gripper.effort == 20.0  # the least that it can
    assert GripperConfig(joints=["a"], links=[], max_effort=3.0).effort == 3.0
    with pytest.raises(ValidationError, match=r"gripper\.effort is 9 N, more than max_effort 3 N"):
        GripperConfig(joints=["a"], links=[], max_effort=3.0, effort=9.0)


def test_on_the_wire_only_what_says_something_is_new():
    ball = {"id": "ball", "role": "target", "shape": "sphere", "dimensions": [0.03], "pose": Pose()}
    plain = [GripperCommand(id="a", width=0.0), GripperState(), CollisionObject.model_validate(ball)]
    new = {"expected_width", "width_tolerance", "outcome", "grip_effort"}
    for message in plain:
        assert not new & set(msgpack.unpackb(encode(message)))
    says = [GripperCommand(id="a", width=0.0, expected_width=0.05, width_tolerance=0.01),
            GripperState(outcome="empty"), CollisionObject.model_validate({**ball, "grip_effort": 2.0})]
    for message in plain + says:
        assert decode(type(message), encode(message)) == message
    scene = PlanningScene(header=Header(), objects=[says[2]])
    assert decode(PlanningScene, encode(scene)) == scene


def test_grasp_is_over_as_soon_as_fingers_that_were_seen_to_move_press_on_something() -> None:
    rig = Rig()
    rig.between(0.06)
    began = rig.now
    assert rig.told(expected_width=0.06).outcome == "grasped"
    there = rig.hand.read(rig.now)
    assert not there.moving and rig.now - began < CONFIG.latency, "readings say it already"


def test_fingers_that_need_not_move_to_press_on_something_are_waited_for() -> None:
    rig = Rig(width=0.06)
    rig.between(0.06)
    began = rig.now
    assert rig.told(expected_width=0.06).outcome == "grasped"
    assert rig.now - began >= CONFIG.latency - 1e-6, "readings may be of before"
