"""The operator model of a simulated cell jogs only where the arm has room."""

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
LIFTING, STILL = [0.0, 1.0, 0.0, 0.0, 0.0, 0.0], [0.0] * 6


@pytest.fixture(scope="module")
def clearance():
    return ClearanceCheck(CELL)


@pytest.mark.parametrize(("q", "dq", "scene", "jog", "seconds", "clear"), [
    pytest.param(HOME, STILL, SCENE, {LIFT: 1.0}, 0.3, True, id="free"),
    pytest.param(NEAR, STILL, SCENE, {WRIST: 1.0}, 0.5, True, id="past a fixture"),
    pytest.param(NEAR, STILL, SCENE, {LIFT: -1.0}, 0.5, True, id="away from a fixture"),
    pytest.param(NEAR, STILL, EMPTY, {LIFT: 1.0}, 0.5, True, id="no fixture"),
    pytest.param(NEAR, STILL, SCENE, {LIFT: 1.0}, 0.5, False, id="into a fixture"),
    pytest.param(HOME, STILL, SCENE, {LIFT: 1.0}, 2.0, False, id="through a fixture"),
    pytest.param(NEAR, LIFTING, SCENE, {WRIST: 1.0}, 0.5, False, id="another joint still moves"),
    pytest.param(NEAR, LIFTING, SCENE, {LIFT: -1.0}, 0.5, True, id="that joint is jogged back"),
    pytest.param(INSIDE, STILL, SCENE, {LIFT: -1.0}, 0.0, False, id="inside a fixture"),
    pytest.param([], [], SCENE, {LIFT: 1.0}, 0.1, False, id="unknown position"),
])
def test_arm_is_jogged_only_while_its_path_is_free(clearance, q, dq, scene, jog, seconds, clear):
    state = JointState(header=Header(), name=NAMES[:len(q)], position=q, velocity=dq)
    assert clearance.clear(state, scene, jog, seconds) == clear
