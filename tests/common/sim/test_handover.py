"""Two grippers in one kinematic world: what each holds, and how an object changes hands."""

import numpy as np
import pytest

from common.config import load_cell
from common.robot.transforms import tool_down
from common.sim.interface import GraspTolerances
from common.sim.kinematic import KinematicWorld
from common.sim.several_arms import SeveralArmsState, SharedSaver
from common.sim.state_file import SimulationState

CELL = load_cell("panda", ["world.balls=[[0.5, 0.0], [0.5, -0.3]]"])
R = CELL.world.ball_radius
OPEN, CLOSED = 0.08, 2 * R


class Hands:
    """Two grippers whose poses and widths the test sets."""

    def __init__(self) -> None:
        self.world = KinematicWorld(CELL.world, CELL.world.objects, GraspTolerances(), CELL.robot.gripper)
        self.hands = {arm: self.world.hand(arm, CELL.robot.gripper) for arm in ("left", "right")}
        self.now = 0.0

    def step(self, arm: str, T: np.ndarray, width: float) -> float:
        self.now += 0.01
        hand = self.hands[arm]
        blocked = hand.obstruction(T, OPEN if width == OPEN else width + 0.01)
        hand.tick(self.now, T, max(width, blocked), width <= blocked)
        return blocked

    def held(self, arm: str) -> str:
        body = self.world.held_by(arm)
        return body.name if body is not None else ""


def at(x: float, y: float, z: float = R) -> np.ndarray:
    return tool_down(x, y, z, 0.0)


def test_both_grippers_hold_an_object_at_a_time() -> None:
    rig = Hands()
    rig.step("left", at(0.5, 0.0), CLOSED)
    rig.step("right", at(0.5, -0.3), CLOSED)
    assert (rig.held("left"), rig.held("right")) == ("ball_1", "ball_2")
    rig.step("left", at(0.5, 0.0, 0.3), CLOSED)
    assert rig.world.bodies["ball_1"].T[2, 3] == pytest.approx(0.3)
    assert rig.world.bodies["ball_2"].T[2, 3] == pytest.approx(R)


def test_object_stays_with_its_holder_until_that_releases_it_and_then_follows_the_other() -> None:
    rig = Hands()
    rig.step("left", at(0.5, 0.0), CLOSED)
    high = at(0.5, 0.0, 0.4)
    rig.step("left", high, CLOSED)
    across = high @ np.block([[np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]]), np.zeros((3, 1))],
                              [np.zeros((1, 3)), np.eye(1)]])  # the other fingers close at a right angle
    assert rig.step("right", across, CLOSED) == pytest.approx(CLOSED)
    assert (rig.held("left"), rig.held("right")) == ("ball_1", "")
    rig.step("left", high, OPEN)
    assert (rig.held("left"), rig.held("right")) == ("", "ball_1")
    rig.step("right", at(0.3, 0.1, 0.5), CLOSED)
    assert rig.world.bodies["ball_1"].T[:3, 3] == pytest.approx([0.3, 0.1, 0.5])
    rig.step("right", at(0.3, 0.1, 0.5), OPEN)
    assert rig.world.bodies["ball_1"].state == "falling"


def test_object_falls_when_the_other_gripper_released_it_first() -> None:
    rig = Hands()
    rig.step("left", at(0.5, 0.0), CLOSED)
    high = at(0.5, 0.0, 0.4)
    rig.step("left", high, CLOSED)
    rig.step("right", high, CLOSED)
    rig.step("right", at(0.5, 0.3, 0.4), OPEN)
    rig.step("left", high, OPEN)
    assert (rig.held("left"), rig.held("right")) == ("", "")
    assert rig.world.bodies["ball_1"].state == "falling"


def test_holder_of_each_object_is_the_same_after_a_restart() -> None:
    rig = Hands()
    rig.step("right", at(0.5, 0.0), CLOSED)
    rig.step("right", at(0.5, 0.0, 0.4), CLOSED)
    again = Hands()
    again.world.restore(rig.world.snapshot())
    again.step("left", at(0.2, 0.0, 0.4), CLOSED)
    again.step("right", at(0.4, 0.1, 0.4), CLOSED)
    assert (again.held("left"), again.held("right")) == ("", "ball_1")
    assert again.world.bodies["ball_1"].T[:3, 3] == pytest.approx([0.4, 0.1, 0.4])


def test_states_of_both_arms_are_saved_together_and_only_when_both_are_known() -> None:
    saved: list[SimulationState] = []

    class Saver:
        def save(self, state: SimulationState) -> None:
            saved.append(state)

        def close(self) -> None:
            saved.clear()

    shared = SharedSaver(Saver(), ["left", "right"])
    left, right = (SimulationState(layout={}, q=[q], width=q) for q in (0.1, 0.2))
    shared.part("right").save(right)
    assert saved == []
    shared.part("left").save(left)
    (state,) = saved
    assert isinstance(state, SeveralArmsState) and (state.q, state.others["right"].q) == ([0.1], [0.2])
    shared.part("left").close()
    assert saved
    shared.part("right").close()
    assert not saved
