"""The floating gripper obeys Coulomb's law: what friction cannot carry is not held."""

from collections.abc import Sequence

import numpy as np
import pytest

from common.robot.transforms import tool_down
from tests.applications.sorting.shapes import TRAY, Block, SmallHand

pytest.importorskip("mujoco")

from applications.sorting.learning.floating import Bench, Conditions, Outcome

GRAVITY = 9.81  # [m/s^2]


def bench(*blocks: Block, at: Sequence[tuple[float, float]] = ((0.55, 0.0),)) -> Bench:
    made = Bench(blocks, [block.at(x, y) for block, (x, y) in zip(blocks, at, strict=True)], TRAY, SmallHand())
    assert made.settle()
    return made


def gripped(block: Block, conditions: Conditions, *, x: float = 0.55, opening: float = 0.06) -> Outcome:
    return bench(block).attempt(tool_down(x, 0.0, 0.02, 0.0), opening, conditions)


@pytest.mark.parametrize("friction, force", [(0.02, 20.0), (0.02, 40.0), (0.2, 20.0), (0.5, 20.0)])
def test_fingers_hold_what_friction_can_carry_and_no_more(friction: float, force: float) -> None:
    carried = 2 * friction * force / GRAVITY  # [kg]
    light, heavy = (gripped(Block((0.05, 0.04, 0.03), mass=factor * carried), Conditions(friction, force))
                    for factor in (0.6, 1.3))
    assert light.held and light.width == pytest.approx(0.04, abs=0.001)
    assert heavy.result == "slipped"


def test_null_friction_holds_almost_nothing() -> None:
    rng = np.random.default_rng(1)
    held = 0
    for _ in range(8):
        x, y, z = rng.uniform(0.025, 0.05, 3)
        held += gripped(Block((x, y, z), mass=rng.uniform(0.1, 0.5)), Conditions(0.02, 20.0)).held
    assert held <= 1


def test_fingers_next_to_the_object_close_empty() -> None:
    outcome = gripped(Block((0.03, 0.03, 0.03)), Conditions(), x=0.62)
    assert (outcome.result, outcome.lifted) == ("empty", ())


def test_two_objects_between_the_fingers_are_not_one() -> None:
    pair = bench(Block((0.04, 0.02, 0.03)), Block((0.04, 0.02, 0.03)), at=((0.55, -0.0101), (0.55, 0.0101)))
    assert pair.attempt(tool_down(0.55, 0.0, 0.02, 0.0), 0.06, Conditions(0.6)).result == "two"


def test_attempts_start_from_the_same_state_and_repeat() -> None:
    block = bench(Block((0.05, 0.03, 0.03)))
    before = block.positions().copy()
    results = [block.attempt(tool_down(0.555, 0.003, 0.02, 0.3), 0.06, Conditions()) for _ in range(2)]
    assert results[0] == results[1]
    block.cast(np.array([0.55, 0.0, 1.0]), np.array([[0.0, 0.0, -1.0]]))
    assert np.allclose(block.positions(), before, atol=1e-9)


def test_error_of_the_pose_moves_the_fingers() -> None:
    aside = np.eye(4)
    aside[0, 3] = 0.06  # beyond the end of the block
    assert gripped(Block((0.04, 0.03, 0.03)), Conditions(0.5, 20.0, aside)).result == "empty"


def test_rays_meet_objects_and_tray_but_not_the_gripper() -> None:
    made = bench(Block((0.04, 0.04, 0.03)))
    distance, geom = made.cast(np.array([0.55, 0.0, 1.0]), np.array([[0.0, 0.0, -1.0], [0.1, 0.0, -1.0], [0, 0, 1.0]]))
    assert distance[:2] == pytest.approx([1 - TRAY.floor_thickness - 0.03, 1 - TRAY.floor_thickness], abs=1e-3)
    assert geom[2] == -1 and np.isinf(distance[2])
