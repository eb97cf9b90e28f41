"""A grasp is checked by the measured width, also with late fingers and readings; a held object is watched."""

from __future__ import annotations

from collections import deque

import msgpack
import pytest
from pydantic import ValidationError

from common.config import GripperConfig, SuctionCup, load_cell
from common.control.gripper_controller import GripperController
from common.hardware.interface import GripperReading
from common.hardware.mock import SimulatedFingers
from common.messages import CollisionObject, GripperCommand, GripperState, Header, PlanningScene, Pose
from common.transport.codec import decode, encode

CONFIG = GripperConfig(joints=["left", "right"], links=[], max_effort=235.0)


class LateFingers:
    """Fingers that start to move after a delay, and whose readings are old [s]."""

    def __init__(self, begin: float, age: float, width: float) -> None:
        self.fingers, self.begin, self.age, self.effort = SimulatedFingers(CONFIG, width), begin, age, 0.0
        self.pending: deque[tuple[float, float, float]] = deque()
        self.past: deque[tuple[float, GripperReading]] = deque()

    def command(self, width: float, now: float, effort: float) -> None:
        self.pending.append((now + self.begin, width, effort))

    def read(self, now: float) -> GripperReading:
        while self.pending and self.pending[0][0] <= now:
            when, width, self.effort = self.pending.popleft()
            self.fingers.command(width, when, self.effort)
        self.past.append((now, self.fingers.read(now)))
        while len(self.past) > 1 and self.past[1][0] <= now - self.age:
            self.past.popleft()
        return self.past[0][1]


class Rig:
    """A gripper with an object of some width [m] between its fingers."""

    def __init__(self, between: float = 0.06, begin: float = 0.0, age: float = 0.0, width: float = 0.08) -> None:
        self.hand = LateFingers(begin, age, width)
        self.controller, self.now = GripperController(self.hand, CONFIG), 10.0
        self.run(0.2)
        self.between(between)

    def between(self, width: float) -> None:
        self.hand.fingers.obstruct(width)

    def run(self, seconds: float) -> GripperState:
        for _ in range(round(seconds / 0.01)):
            self.now += 0.01
            self.controller.update(self.hand.read(self.now), self.now)
        return self.controller.state

    def grip(self, width: float = 0.0, **more: float) -> GripperState:
        """Return the state at the end of the goal."""
        self.controller.command(GripperCommand(id=f"goal {self.now:.2f}", width=width, **more), self.now)
        until = self.now + 5.0
        while self.run(0.01).state == "active":
            assert self.controller.state.moving and self.now < until
        return self.controller.state


@pytest.mark.parametrize(("begin", "age"), [(0.0, 0.0), (0.0, 0.1), (0.1, 0.0), (0.08, 0.1)])
@pytest.mark.parametrize(("width", "state", "outcome", "message"), [
    (0.060, "succeeded", "grasped", ""),
    (0.055, "succeeded", "grasped", ""),
    (0.066, "aborted", "too_wide", "the fingers closed on something too wide (0.0660 m, not 0.0600 m)"),
    (0.030, "aborted", "too_narrow", "the fingers closed on something too narrow (0.0300 m, not 0.0600 m)"),
    (0.0, "aborted", "empty", "the fingers closed on nothing"),
])
def test_grasp_is_checked_by_the_width_of_the_held_object(begin, age, width, state, outcome, message):
    rig = Rig(width, begin, age)
    found = rig.grip(expected_width=0.06, width_tolerance=0.0051)
    assert (found.state, found.outcome, found.message) == (state, outcome, message)
    assert found.holding == (width > 0) and found.width == pytest.approx(width) and not found.moving
    assert rig.run(1.0) == found, "the result stays"
    opened = rig.grip(0.08)
    assert (opened.state, opened.outcome, opened.holding) == ("succeeded", "", False)
    plain = rig.grip()  # any width will do if none is expected
    assert (plain.state, plain.outcome, plain.holding) == ("succeeded", "grasped" if width else "", width > 0)


def test_fingers_that_report_late_that_they_hold_have_not_missed_the_object():
    def states(readings: list[GripperReading], **command: float) -> list[GripperState]:
        """Return the states of a command while the fingers report these, the last one for good."""
        controller, left = GripperController(SimulatedFingers(CONFIG), CONFIG), deque(readings)
        controller.command(GripperCommand(id="close", width=0.0, **command), 0.0)
        return [controller.update(left.popleft() if len(left) > 1 else left[0], 0.01 * k) for k in range(1, 60)]

    moving, still = GripperReading(0.07, -0.1, True, False), GripperReading(0.06, 0.0, False, False)
    held = states([moving] * 30 + [still] * 10 + [still._replace(holding=True)], expected_width=0.06)
    assert {one.state for one in held} == {"active", "succeeded"} and held[-1].outcome == "grasped"
    missed = [one.state for one in states([moving, still])]
    assert missed.count("active") == pytest.approx(CONFIG.latency / 0.01, abs=2) and missed[-1] == "aborted"


@pytest.mark.parametrize("expected", [{}, {"expected_width": 0.06}])
def test_slipping_object_is_reported_until_the_next_command(expected):
    rig = Rig()
    goal = rig.grip(**expected)
    rig.between(0.059)
    assert rig.run(0.5).outcome == "grasped", "a soft object gives way a little"
    rig.between(0.055)
    slipping = rig.run(0.5)
    assert (slipping.id, slipping.state, slipping.outcome, slipping.holding) == (goal.id, "succeeded", "slipping", True)
    assert slipping.message == "the held object slips: it was 0.0600 m wide, the fingers are 0.0550 m apart"
    rig.between(0.0)
    lost = rig.run(0.5)
    assert (lost.state, lost.outcome, lost.holding) == ("succeeded", "slipping", False)
    assert lost.message == "the held object slipped out: it was 0.0600 m wide, nothing is between the fingers now"
    assert rig.grip(0.08).outcome == ""


def test_release_is_no_slipping():
    rig = Rig()
    rig.grip()
    rig.controller.command(GripperCommand(id="open", width=0.08), rig.now)
    assert {rig.run(0.01).outcome for _ in range(100)} == {""}


def test_fingers_press_with_the_commanded_effort_or_the_default():
    rig = Rig()
    assert rig.grip().effort == CONFIG.effort == 5.0
    assert rig.grip(effort=40.0).effort == 40.0
    refused = rig.grip(effort=300.0)
    assert refused.state == "succeeded" and rig.hand.effort == 40.0


@pytest.mark.parametrize(("command", "message"), [
    ({"width": 0.0, "expected_width": 0.1}, "expected_width 0.1 m is more than the fingers open (0.08 m)"),
    ({"width": 0.1}, "width 0.1 m is more than the fingers open (0.08 m)"),
])
def test_width_beyond_the_fingers_is_rejected(command, message):
    rig = Rig()
    answer = rig.controller.command(GripperCommand(id="wide", **command), rig.now)
    assert (answer.state, answer.message) == ("rejected", message)
    assert (rig.run(0.5).id, rig.controller.state.width) == ("", 0.08)


def test_new_command_replaces_the_running_one_and_a_repeated_id_moves_nothing():
    def command(goal, width):
        return rig.controller.command(GripperCommand(id=goal, width=width), rig.now)

    rig = Rig(between=0.0)
    command("close", 0.0)
    rig.run(0.1)
    command("open", 0.08)
    replaced = command("close", 0.0)
    assert replaced.state == "cancelled" and "open" in replaced.message
    assert (rig.run(1.0).id, rig.controller.state.state) == ("open", "succeeded")
    command("half", 0.07)
    rig.run(1.0)
    again = command("open", 0.08)
    assert (again.id, again.state) == ("open", "succeeded")
    assert (rig.run(0.5).id, rig.controller.state.width) == ("half", pytest.approx(0.07))


def test_robot_file_sets_the_default_effort():
    assert load_cell("ur5").robot.gripper.effort == 20.0  # its minimum
    assert GripperConfig(joints=["a"], links=[], max_effort=3.0).effort == 3.0
    with pytest.raises(ValidationError, match=r"gripper\.effort is 9 N, more than max_effort 3 N"):
        GripperConfig(joints=["a"], links=[], max_effort=3.0, effort=9.0)


def test_fields_of_grasps_are_sent_only_when_they_are_set():
    ball = {"id": "ball", "role": "target", "shape": "sphere", "dimensions": [0.03], "pose": Pose()}
    plain = [GripperCommand(id="a", width=0.0), GripperState(), CollisionObject.model_validate(ball)]
    heavy = CollisionObject.model_validate({**ball, "grip_effort": 2.0})
    full = [GripperCommand(id="a", width=0.0, expected_width=0.05, width_tolerance=0.01), GripperState(outcome="empty"),
            heavy, PlanningScene(header=Header(), objects=[heavy])]
    for message in plain:
        assert not {"expected_width", "width_tolerance", "outcome", "grip_effort"} & set(
            msgpack.unpackb(encode(message)))
    for message in plain + full:
        assert decode(type(message), encode(message)) == message


@pytest.mark.parametrize(("width", "at_once"), [(0.08, True), (0.06, False)], ids=["moving", "touching already"])
def test_only_fingers_that_press_without_having_moved_are_given_their_latency(width, at_once):
    rig = Rig(width=width)
    began = rig.now
    assert rig.grip(expected_width=0.06).outcome == "grasped" and not rig.hand.read(rig.now).moving
    assert (rig.now - began < CONFIG.latency - 1e-6) == at_once, "readings may be older than the command"


def test_cup_reports_why_it_holds_nothing_and_that_an_object_came_off() -> None:
    config = GripperConfig(cup=SuctionCup(), links=["cup"])
    cup, now = SimulatedFingers(config), 10.0
    controller = GripperController(cup, config)

    def run(between: float, command: GripperCommand | None = None) -> GripperState:
        nonlocal now
        if command is not None:
            controller.command(command, now)
        cup.obstruct(between)
        for _ in range(150):
            now += 0.01
            state = controller.update(cup.read(now), now)
        return state

    cup.no_seal = "box: the surface is not flat"
    missed = run(0.0, GripperCommand(id="a", width=0.0, expected_width=config.held_width))
    assert (missed.state, missed.outcome, missed.message) == ("aborted", "empty", "box: the surface is not flat")
    assert run(0.0, GripperCommand(id="b", width=0.0)).message == "", "it draws already"
    assert run(0.0, GripperCommand(id="c", width=config.max_width)).message == ""
    assert run(0.0, GripperCommand(id="d", width=0.0)).message == "box: the surface is not flat"
    assert run(config.held_width).holding
    run(0.0, GripperCommand(id="e", width=config.max_width))
    held = run(config.held_width, GripperCommand(id="f", width=0.0, expected_width=config.held_width))
    assert (held.outcome, held.message) == ("grasped", "")
    lost = run(0.0)
    assert (lost.outcome, lost.message) == ("slipping", "the held object came off the cup")
