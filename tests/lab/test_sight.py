"""What a person sees who jogs a simulated arm: with nothing in the way it may go on, else not."""

import pytest

from common.config import Surroundings, load_cell
from common.messages import Header, JointState, PlanningScene
from common.scene.fixtures import fixture_objects
from lab.operator_model import ClearanceCheck

CELL = load_cell("ur5")
NAMES = CELL.robot.joints
HOME = CELL.robot.named_poses["home"]
SCENE = PlanningScene(header=Header(frame_id="world"), objects=fixture_objects(CELL.section(Surroundings)))
EMPTY = PlanningScene(header=Header(frame_id="world"))
LIFT, WRIST = NAMES[1], NAMES[5]
BESIDE = [0.358, -1.63, 1.57, -1.57, -1.57, 1.566]  # above the pedestal, but for a few hundredths of a radian
INSIDE = [0.358, -0.454, 1.57, -1.57, -1.57, 1.566]


@pytest.fixture(scope="module")
def sight() -> ClearanceCheck:
    return ClearanceCheck(CELL)


def state(q: list[float], velocity: list[float] | None = None) -> JointState:
    return JointState(header=Header(), name=NAMES, position=q, velocity=velocity or [0.0] * len(q))


def test_arm_is_jogged_where_nothing_is_in_its_way(sight: ClearanceCheck) -> None:
    assert sight.clear(state(HOME), SCENE, {LIFT: 1.0}, 0.3)
    assert sight.clear(state(BESIDE), SCENE, {WRIST: 1.0}, 0.5)


def test_arm_is_not_jogged_into_or_through_a_fixture(sight: ClearanceCheck) -> None:
    assert not sight.clear(state(BESIDE), SCENE, {LIFT: 1.0}, 0.5)
    assert not sight.clear(state(HOME), SCENE, {LIFT: 1.0}, 2.0)
    assert sight.clear(state(BESIDE), EMPTY, {LIFT: 1.0}, 0.5)
    assert sight.clear(state(BESIDE), SCENE, {LIFT: -1.0}, 0.5)


def test_what_a_joint_still_does_counts_until_it_is_asked_for_something_else(sight: ClearanceCheck) -> None:
    lifting = [0.0, 1.0, 0.0, 0.0, 0.0, 0.0]
    assert not sight.clear(state(BESIDE, lifting), SCENE, {WRIST: 1.0}, 0.5)
    assert sight.clear(state(BESIDE, lifting), SCENE, {LIFT: -1.0}, 0.5)


def test_arm_in_a_fixture_or_not_seen_is_not_jogged(sight: ClearanceCheck) -> None:
    assert not sight.clear(state(INSIDE), SCENE, {LIFT: -1.0}, 0.0)
    assert not sight.clear(JointState(header=Header(), name=["finger"], position=[0.0]), SCENE, {LIFT: 1.0}, 0.1)
