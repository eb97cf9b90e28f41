"""Planners that optimise a whole path."""

import numpy as np
import pytest

from common.planning.collision import CollisionWorld
from common.planning.optimised_path import evenly_spaced, quintic
from common.planning.planners.chomp import accelerations, obstacle_gradient
from common.planning.problem import Cancel
from common.planning.proximity import Near, Proximity
from tests.common.planning.planner_checks import AROUND, LEFT, RIGHT, assert_sound, wall, with_planner
from tests.common.planning.planning_scenes import ROBOT, cache, to_joints

LOW_WALL = wall(height=0.3, depth=0.3)


def test_quintic_is_at_rest_at_its_ends():
    path = quintic(RIGHT, LEFT, 101)
    assert np.array_equal(path[[0, -1]], [RIGHT, LEFT])
    speed, bend = np.diff(path, axis=0) * 100, np.diff(path, 2, axis=0) * 100**2
    span = np.abs(LEFT - RIGHT)
    assert (np.abs(speed[[0, -1]]) < 0.01 * span + 1e-9).all()
    assert (np.abs(bend[[0, -1]]) < 0.8 * span + 1e-9).all()
    assert np.allclose(speed.max(axis=0)[LEFT > RIGHT], 1.875 * span[LEFT > RIGHT], rtol=0.01)


def test_even_spacing_keeps_the_ends_and_the_way():
    path = quintic(RIGHT, LEFT, 30)
    even = evenly_spaced(path, 0.05)
    steps = np.linalg.norm(np.diff(even, axis=0), axis=1)
    assert np.allclose(steps, steps[0])
    assert steps[0] == pytest.approx(0.05, rel=0.1)
    assert np.allclose(even[[0, -1]], path[[0, -1]])
    assert len(evenly_spaced(np.array([RIGHT, RIGHT, RIGHT]))) == 2


def test_cost_of_accelerations_is_zero_for_rest_only():
    A = accelerations(10)
    assert np.allclose(A @ np.ones(10), 0)
    path = np.linspace(0, 1, 10)
    bends = np.diff(np.concatenate([[0], path, [1]]), 2)
    assert path @ A @ path == pytest.approx(bends @ bends)


def test_obstacles_push_within_their_clearance_and_hardest_inside():
    distances = np.array([-0.1, 0.0, 0.1, 0.2])
    near = Near(np.arange(4), np.arange(4), distances, np.full(4, 0.2), np.ones((4, 1)))
    assert np.allclose(obstacle_gradient(near, 4)[:, 0], [-1, -1, -0.5, 0])


def test_straight_way_that_is_free_is_kept():
    pipeline = with_planner("chomp")
    request = to_joints(LEFT, RIGHT)
    timed = assert_sound(pipeline, request, AROUND, pipeline.plan(request, AROUND))
    span = LEFT - RIGHT
    shares = (timed.positions - RIGHT) @ span / (span @ span)
    assert np.allclose(timed.positions, RIGHT + shares[:, None] * span, atol=1e-9)


def test_descent_that_has_too_few_iterations_says_what_still_collides():
    response = with_planner("chomp", iterations=1).plan(to_joints(LEFT, RIGHT), LOW_WALL)
    assert response.error == "collision"
    assert response.colliding[1] == "wall"
    assert response.message.endswith("after 1 iterations")


def test_larger_clearance_keeps_farther_from_the_wall():
    least = []
    for clearance in (0.02, 0.3):
        pipeline = with_planner("chomp", clearance=clearance)
        request = to_joints(LEFT, RIGHT)
        timed = assert_sound(pipeline, request, LOW_WALL, pipeline.plan(request, LOW_WALL))
        world = CollisionWorld(ROBOT, LOW_WALL, start=RIGHT, cache=cache())
        middle = timed.positions[len(timed.positions) // 4 : -len(timed.positions) // 4]
        least.append(Proximity(world, 0.5, own_reach=0.0).measure(middle).distance.min())
    assert least[0] < least[1]


def test_descent_ends_when_it_is_cancelled():
    class AfterAWhile(Cancel):
        left = 5

        def reason(self, problem):
            self.left -= 1
            return "cancelled" if self.left < 0 else ""

    response = with_planner("chomp", iterations=10000).plan(
        to_joints(LEFT, RIGHT), wall(height=2.0), cancel=AfterAWhile()
    )
    assert response.error == "cancelled"
