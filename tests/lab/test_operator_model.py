"""Clearance check of an operator who jogs a simulated arm."""

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
NEAR = [0.358, -1.63, 1.57, -1.57, -1.57, 1.566]  # a few hundredths of a radian above the pedestal
INSIDE = [0.358, -0.454, 1.57, -1.57, -1.57, 1.566]
LIFTING = [0.0, 1.0, 0.0, 0.0, 0.0, 0.0]


@pytest.fixture(scope="module")
def clearance() -> ClearanceCheck:
    return ClearanceCheck(CELL)


@pytest.mark.parametrize(("q", "dq", "scene", "jog", "seconds", "clear"), [
    pytest.param(HOME, None, SCENE, {LIFT: 1.0}, 0.3, True, id="free"),
    pytest.param(NEAR, None, SCENE, {WRIST: 1.0}, 0.5, True, id="past a fixture"),
    pytest.param(NEAR, None, SCENE, {LIFT: -1.0}, 0.5, True, id="away from a fixture"),
    pytest.param(NEAR, None, EMPTY, {LIFT: 1.0}, 0.5, True, id="no fixture"),
    pytest.param(NEAR, None, SCENE, {LIFT: 1.0}, 0.5, False, id="into a fixture"),
    pytest.param(HOME, None, SCENE, {LIFT: 1.0}, 2.0, False, id="through a fixture"),
    pytest.param(NEAR, LIFTING, SCENE, {WRIST: 1.0}, 0.5, False, id="another joint still moves"),
    pytest.param(NEAR, LIFTING, SCENE, {LIFT: -1.0}, 0.5, True, id="that joint is jogged back"),
    pytest.param(INSIDE, None, SCENE, {LIFT: -1.0}, 0.0, False, id="inside a fixture"),
])
def test_arm_is_jogged_only_while_its_path_is_free(
    clearance: ClearanceCheck, q: list[float], dq: list[float] | None, scene: PlanningScene, jog: dict[str, float],
    seconds: float, clear: bool,
) -> None:
    state = JointState(header=Header(), name=NAMES, position=q, velocity=dq or [0.0] * len(q))
    assert clearance.clear(state, scene, jog, seconds) == clear


def test_arm_of_unknown_position_is_not_jogged(clearance: ClearanceCheck) -> None:
    assert not clearance.clear(JointState(header=Header(), name=["finger"], position=[0.0]), SCENE, {LIFT: 1.0}, 0.1)
