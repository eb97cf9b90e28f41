"""Planners that optimise a whole path."""

from types import SimpleNamespace

import numpy as np
import pytest

from common.planning.collision import CollisionWorld
from common.planning.joint_paths import evenly_spaced, line, quintic
from common.planning.planners.chomp import accelerations, obstacle_gradient
from common.planning.planners.trajopt import _chain, _step
from common.planning.problem import Cancel
from common.planning.proximity import NearPairs, Proximity
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


def test_even_spacing_preserves_the_ends():
    path = quintic(RIGHT, LEFT, 30)
    even = evenly_spaced(path, 0.05)
    steps = np.linalg.norm(np.diff(even, axis=0), axis=1)
    assert np.allclose(steps, steps[0])
    assert steps[0] == pytest.approx(0.05, rel=0.1)
    assert np.allclose(even[[0, -1]], path[[0, -1]])
    assert len(evenly_spaced(np.array([RIGHT, RIGHT, RIGHT]))) == 2


def test_cost_of_accelerations_is_zero_at_rest_only():
    A = accelerations(10)
    assert np.allclose(A @ np.ones(10), 0)
    path = np.linspace(0, 1, 10)
    bends = np.diff(np.concatenate([[0], path, [1]]), 2)
    assert path @ A @ path == pytest.approx(bends @ bends)


def test_obstacles_push_within_their_clearance_and_hardest_inside():
    distances = np.array([-0.1, 0.0, 0.1, 0.2])
    near = NearPairs(np.arange(4), np.arange(4), distances, np.full(4, 0.2), np.ones((4, 1)))
    assert np.allclose(obstacle_gradient(near, 4)[:, 0], [-1, -1, -0.5, 0])


@pytest.mark.parametrize("planner", ["chomp", "trajopt"])
def test_free_straight_edge_is_not_changed(planner):
    pipeline = with_planner(planner)
    request = to_joints(LEFT, RIGHT)
    timed = assert_sound(pipeline, request, AROUND, pipeline.plan(request, AROUND))
    span = LEFT - RIGHT
    shares = (timed.positions - RIGHT) @ span / (span @ span)
    assert np.allclose(timed.positions, RIGHT + shares[:, None] * span, atol=1e-9)


@pytest.mark.parametrize("planner", ["chomp", "trajopt"])
def test_too_few_iterations_report_the_remaining_collision(planner):
    response = with_planner(planner, iterations=1, restarts=0).plan(to_joints(LEFT, RIGHT), LOW_WALL)
    assert response.error == "collision"
    assert response.colliding[1] == "wall"
    assert "after 1 iterations" in response.message


@pytest.mark.parametrize("planner", ["chomp", "trajopt"])
def test_failure_counts_the_other_first_guesses(planner):
    response = with_planner(planner, iterations=1, restarts=2).plan(to_joints(LEFT, RIGHT), wall(height=2.0))
    assert response.error == "collision"
    assert response.message.endswith("2 other first guesses also collide")


@pytest.mark.parametrize("planner", ["chomp", "trajopt"])
def test_larger_clearance_leads_farther_from_the_wall(planner):
    least = []
    for clearance in (0.01, 0.1):
        pipeline = with_planner(planner, clearance=clearance)
        request = to_joints(LEFT, RIGHT)
        timed = assert_sound(pipeline, request, LOW_WALL, pipeline.plan(request, LOW_WALL))
        world = CollisionWorld(ROBOT, LOW_WALL, start=RIGHT, cache=cache())
        middle = timed.positions[len(timed.positions) // 4 : -len(timed.positions) // 4]
        least.append(Proximity(world, 0.5, own_reach=0.0).measure(middle).distance.min())
    assert least[0] < least[1]


@pytest.mark.parametrize("planner", ["chomp", "trajopt"])
def test_optimisation_ends_when_it_is_cancelled(planner):
    class AfterAWhile(Cancel):
        left = 5

        def reason(self, problem):
            self.left -= 1
            return "cancelled" if self.left < 0 else ""

    response = with_planner(planner, iterations=10000).plan(
        to_joints(LEFT, RIGHT), wall(height=2.0), cancel=AfterAWhile()
    )
    assert response.error == "cancelled"


def test_chain_has_waypoints_and_middles_and_measures_edges():
    path = line(RIGHT, LEFT, 6)
    chain = _chain(RIGHT, LEFT, 6)
    positions = chain.positions(path[1:-1])
    assert np.allclose(positions[::2], path)
    assert np.allclose(positions[1::2], 0.5 * (path[:-1] + path[1:]))
    other = path.copy()
    other[1:-1] += np.random.default_rng(0).normal(0, 0.1, other[1:-1].shape)
    edges = [0.5 * (np.diff(p, axis=0) ** 2).sum() for p in (path, other)]
    assert chain.cost(other[1:-1]) - chain.cost(path[1:-1]) == pytest.approx(edges[1] - edges[0])


def test_step_changes_the_shortest_path_only_near_obstacles():
    chain = _chain(np.zeros(7), np.ones(7), 10)
    waypoints = line(np.zeros(7), np.ones(7), 10)[1:-1]
    problem = SimpleNamespace(robot=SimpleNamespace(lower=np.full(7, -3), upper=np.full(7, 3)))
    nothing = NearPairs(np.zeros(0, dtype=int), np.zeros(0, dtype=int), np.zeros(0), np.zeros(0), np.zeros((0, 7)))
    same, merit = _step(problem, chain, waypoints, nothing, 0.1, 10.0, 0.02)
    assert np.allclose(same, waypoints, atol=1e-6)
    assert merit == pytest.approx(chain.cost(waypoints))
    something = NearPairs(np.array([10]), np.array([3]), np.array([-0.01]), np.array([0.07]), np.eye(7)[:1])
    moved, merit = _step(problem, chain, waypoints, something, 0.1, 10.0, 0.02)
    assert moved[4, 0] - waypoints[4, 0] == pytest.approx(0.03, abs=1e-4)
    assert np.allclose(moved[:, 1:], waypoints[:, 1:], atol=1e-6)
    little, _ = _step(problem, chain, waypoints, something, 0.01, 10.0, 0.02)
    assert np.abs(little - waypoints).max() == pytest.approx(0.01)
