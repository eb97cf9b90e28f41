"""Recorded motions are checked for contacts: each is found, and nothing else."""

from functools import cache

import pytest

from applications.pick_place.contact_check import ContactCheck, RecordedMotion
from common.application import find_application
from common.config import load_cell
from common.messages import GripperState, Header, JointState, Pose, PoseArray, Vector3
from common.planning.ik import solve_ik
from common.robot.transforms import tool_down
from recording.report.aggregator import RunAggregator

CELL = load_cell("panda")
BALL = (0.5, 0.0, 0.03)
SECOND = 1_000_000_000


@cache
def check() -> ContactCheck:
    return ContactCheck(CELL)


def at(x: float, y: float, z: float):
    robot = check().robot
    return solve_ik(robot, tool_down(x, y, z, 0.0), robot.named("home"))


def arm(*path):
    """Return joint states of one position each second."""
    return [JointState(header=Header(stamp=k * SECOND), name=CELL.robot.joints, position=q.tolist())
            for k, q in enumerate(path)]


def truth(second: float, label: str, *place: float) -> PoseArray:
    pose = Pose(position=Vector3(x=place[0], y=place[1], z=place[2]))
    return PoseArray(header=Header(stamp=int(second * SECOND)), poses=[pose], ids=["ball"], labels=[label])


def fingers(second: float, name: str, *, holding: bool) -> GripperState:
    return GripperState(header=Header(stamp=int(second * SECOND)), id=name, holding=holding, width=0.06)


def test_motion_through_a_ball_is_a_contact() -> None:
    joints = arm(at(0.5, -0.25, 0.04), at(0.5, -0.25, 0.3), at(0.5, -0.25, 0.04), at(0.5, 0.1, 0.04))
    contacts = check().contacts(RecordedMotion(joints, [], [truth(0, "table", *BALL)]))
    assert {(contact.time, contact.pair[1]) for contact in contacts} == {(2.0, "ball")}  # one finger after the other


@pytest.mark.parametrize("label", ["falling", "elsewhere"])
def test_motion_above_or_without_a_ball_is_no_contact(label: str) -> None:
    high = arm(at(0.5, -0.2, 0.2), at(0.5, 0.2, 0.2))
    assert check().contacts(RecordedMotion(high, [], [truth(0, "table", *BALL)])) == []
    low = arm(at(0.5, -0.2, 0.04), at(0.5, 0.0, 0.04))
    assert check().contacts(RecordedMotion(low, [], [truth(0, label, *BALL)])) == []


def test_motion_into_table_or_container_is_a_contact() -> None:
    balls = [truth(0, "elsewhere", 0, 0, -0.7)]
    for low, high, name in ((at(0.5, 0.0, -0.02), at(0.5, 0.0, 0.2), "table"),
                            (at(0.55, 0.17, 0.03), at(0.55, 0.17, 0.3), "box_wall_right")):
        contacts = check().contacts(RecordedMotion(arm(high, low), [], balls))
        assert [contact.pair[1] for contact in contacts] == [name]


def test_held_ball_may_touch_the_table_only_at_the_grasp() -> None:
    down, up, across = at(0.5, 0.0, 0.03), at(0.5, 0.0, 0.2), at(0.5, -0.3, 0.2)
    taken = [truth(0, "table", *BALL), truth(1, "held", *BALL)]
    grips = [fingers(1, "close", holding=True)]
    assert check().contacts(RecordedMotion(arm(up, down, up, across), grips, taken)) == []
    dragged = arm(up, down, at(0.5, -0.15, 0.025), across)
    assert {c.pair for c in check().contacts(RecordedMotion(dragged, grips, taken))} == {("ball", "table")}


def test_repeated_states_count_once() -> None:
    recording = RecordedMotion()
    aggregator = RunAggregator("panda", find_application("pick_place"), listeners=recording.listeners())
    for second in (0, 0, 1):
        aggregator.on("scene_balls", truth(second, "table", *BALL), 0.0, 0)
        aggregator.on("joint_states", arm(at(0.5, 0.0, 0.2))[0], 0.0, 0)
    assert (len(recording.balls), len(recording.joints)) == (2, 1)
    assert aggregator.summary.as_dict()["truth"]["on_table"] == 1
