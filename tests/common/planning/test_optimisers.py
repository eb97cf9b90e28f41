"""Planners that optimise a whole path."""

import numpy as np
import pytest

from common.planning.joint_paths import evenly_spaced, quintic
from common.planning.problem import Cancel
from common.planning.proximity import Proximity
from tests.common.planning.checks import assert_refused, planned, with_planner
from tests.common.planning.requests import LEFT, RIGHT, to_joints
from tests.common.planning.scenes import wall, world

LOW_WALL = wall(height=0.3, depth=0.3)
either = pytest.mark.parametrize("planner", ["chomp", "trajopt"])


def test_quintic_is_at_rest_at_its_ends():
    path = quintic(RIGHT, LEFT, 101)
    assert np.array_equal(path[[0, -1]], [RIGHT, LEFT])
    speed, bend = np.diff(path, axis=0) * 100, np.diff(path, 2, axis=0) * 100**2
    span = np.abs(LEFT - RIGHT)
    assert (np.abs(speed[[0, -1]]) < 0.01 * span + 1e-9).all()
    assert (np.abs(bend[[0, -1]]) < 0.8 * span + 1e-9).all()
    assert np.allclose(speed.max(axis=0)[LEFT > RIGHT], 1.875 * span[LEFT > RIGHT], rtol=0.01)


def test_even_spacing_preserves_the_ends():
    path = quintic(RIGHT, LEFT, 30)
    even = evenly_spaced(path, 0.05)
    steps = np.linalg.norm(np.diff(even, axis=0), axis=1)
    assert np.allclose(steps, steps[0])
    assert steps[0] == pytest.approx(0.05, rel=0.1)
    assert np.allclose(even[[0, -1]], path[[0, -1]])
    assert len(evenly_spaced(np.array([RIGHT, RIGHT, RIGHT]))) == 2


@either
def test_failure_reports_iterations_collision_and_the_other_first_guesses(planner):
    response = with_planner(planner, iterations=1, restarts=0).plan(to_joints(LEFT, RIGHT), LOW_WALL)
    assert_refused(response, "collision", "after 1 iterations")
    assert response.colliding[1] == "wall"
    response = with_planner(planner, iterations=1, restarts=2).plan(to_joints(LEFT, RIGHT), wall(height=2.0))
    assert response.error == "collision"
    assert response.message.endswith("2 other first guesses also collide")


@either
def test_larger_clearance_leads_farther_from_the_wall(planner):
    least = []
    for clearance in (0.01, 0.1):
        positions = planned(with_planner(planner, clearance=clearance), to_joints(LEFT, RIGHT), LOW_WALL).positions
        middle = positions[len(positions) // 4 : -len(positions) // 4]
        least.append(Proximity(world(LOW_WALL, RIGHT), 0.5, own_reach=0.0).measure(middle).distance.min())
    assert least[0] < least[1]


@either
def test_optimisation_ends_when_it_is_cancelled(planner):
    class AfterAWhile(Cancel):
        left = 5

        def reason(self, problem):
            self.left -= 1
            return "cancelled" if self.left < 0 else ""

    endless = with_planner(planner, iterations=10000)
    assert endless.plan(to_joints(LEFT, RIGHT), wall(height=2.0), cancel=AfterAWhile()).error == "cancelled"
