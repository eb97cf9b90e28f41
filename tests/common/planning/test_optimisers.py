"""Planners that optimise a complete path, and the distances and gradients that they use."""

import numpy as np
import pytest

from common.planning.joint_paths import line
from common.planning.problem import Cancel
from common.planning.proximity import Proximity, SweptEdges
from tests.common.planning.checks import assert_refused, planned, with_planner
from tests.common.planning.requests import LEFT, RIGHT, above, to_joints, touching
from tests.common.planning.scenes import ROBOT, TABLE, held_scene, scene, wall, world

LOW_WALL = wall(height=0.3, depth=0.3)
either = pytest.mark.parametrize("planner", ["chomp", "trajopt"])


@either
def test_failure_reports_iterations_collision_and_the_other_first_guesses(planner):
    response = with_planner(planner, iterations=1, restarts=0).plan(to_joints(LEFT, RIGHT), LOW_WALL)
    assert_refused(response, "collision", "after 1 iterations")
    assert response.colliding[1] == "wall"
    response = with_planner(planner, iterations=1, restarts=2).plan(to_joints(LEFT, RIGHT), wall(height=2.0))
    assert response.error == "collision" and response.message.endswith("2 other first guesses also collide")


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


LOW = above(0.5, 0.1, 0.06)
MEASURED = world(TABLE, RIGHT)
WALL = wall(height=0.3, depth=0.4)


def by_pair(near):
    return dict(zip(near.pair.tolist(), near.distance.tolist(), strict=True))


def test_gradient_is_that_of_the_distance():
    near = Proximity(MEASURED, 0.15).measure(LOW[None])
    assert len(near.pair) > 5
    step = 1e-4
    for joint in range(ROBOT.dof):
        away = step * np.eye(ROBOT.dof)[joint]
        more, less = (by_pair(Proximity(MEASURED, 0.2).measure((LOW + s * away)[None])) for s in (1, -1))
        for pair, gradient in zip(near.pair.tolist(), near.gradient[:, joint], strict=True):
            assert (more[pair] - less[pair]) / (2 * step) == pytest.approx(gradient, abs=0.03)


def test_cached_measurement_equals_a_fresh_one():
    caching = Proximity(MEASURED, 0.1)
    rng = np.random.default_rng(0)
    path = np.linspace(RIGHT, LOW, 8)
    for _ in range(12):
        near = caching.measure(path)
        fresh = Proximity(MEASURED, 0.1).measure(path)
        assert np.array_equal(near.pair, fresh.pair) and np.array_equal(near.position, fresh.position)
        assert np.allclose(near.distance, fresh.distance, atol=1e-5)
        path = path + rng.normal(0, 0.05, path.shape)


def test_distance_agrees_with_collision():
    measured = world(TABLE, RIGHT, padding=0.003)
    for q in np.random.default_rng(1).uniform(ROBOT.lower, ROBOT.upper, (60, ROBOT.dof)):
        least = Proximity(measured, 0.05).measure(q[None]).distance.min(initial=1.0)
        if abs(least) > 1e-4:
            assert measured.collides(q) == (least < 0)


def test_allowed_contacts_are_not_measured():
    at_ball = above(0.45, -0.1, 0.03)
    of = scene([(0.45, -0.1)])
    every = by_pair(Proximity(world(of, at_ball), 0.02).measure(at_ball[None]))
    others = by_pair(Proximity(world(of, at_ball, allowed=touching("ball_0")), 0.02).measure(at_ball[None]))
    assert set(others) < set(every)
    held = world(held_scene(of, "ball_0"), at_ball)
    assert Proximity(held, 0.02).measure(LEFT[None]).distance.min(initial=1.0) > 0


@pytest.mark.parametrize("around", [WALL, TABLE, held_scene(scene([(0.5, 0.0)]), "ball_0")], ids=["wall", "", "held"])
def test_swept_distance_bounds_all_positions_between_the_waypoints(around):
    measured = world(around, RIGHT)
    rng = np.random.default_rng(1)
    joints = np.array([item.parentJoint for item in measured.bank.geometry.geometryObjects])
    compared = 0
    for _ in range(8):
        a = np.clip(RIGHT + rng.uniform(0, 1) * (LEFT - RIGHT) + rng.normal(0, 0.2, 7), ROBOT.lower, ROBOT.upper)
        b = np.clip(a + rng.normal(0, 0.06, 7), ROBOT.lower, ROBOT.upper)
        swept = SweptEdges(measured, 0.2).measure(np.array([a, b]))
        states = Proximity(measured, 0.3, nearest=True).measure(line(a, b, 20))
        for pair, distance in zip(swept.pair, swept.distance, strict=True):
            same = measured.bank.first[states.pair] == measured.bank.first[pair]
            fixed = same & (joints[measured.bank.second[states.pair]] == 0)
            if fixed.any():
                compared += 1
                assert distance < states.distance[fixed].min() + 2e-3  # a link that turns bulges out of its hull
    assert compared > 7


def test_blade_between_two_states_is_measured_and_avoided():
    around = wall(height=0.3, depth=0.4, width=0.002)
    measured = world(around, RIGHT)
    path = np.array([above(0.5, -0.15, 0.15), above(0.5, 0.16, 0.15)])
    assert Proximity(measured, 0.2).measure(path).distance.min() > 0
    near = SweptEdges(measured, 0.02).measure(path)
    assert min(near.distance) < -0.02
    assert {measured.pair(pair)[1] for pair in near.pair[near.distance < 0]} == {"wall"}
    for height in (0.15, 0.2):
        request = to_joints(above(0.5, 0.3, height), above(0.45, -0.3, height), planning_time=20.0)
        planned(with_planner("trajopt", steps=10), request, around)
