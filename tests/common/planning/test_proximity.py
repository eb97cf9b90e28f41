import numpy as np
import pytest

from common.planning.collision import CollisionWorld
from common.planning.proximity import Proximity
from tests.common.planning.planner_checks import AROUND, LEFT, RIGHT
from tests.common.planning.planning_scenes import ROBOT, above, cache, held_scene, scene, touching

LOW = above(0.5, 0.1, 0.06)


def world(of=AROUND, start=RIGHT, **more) -> CollisionWorld:
    return CollisionWorld(ROBOT, of, start=start, cache=cache(), **more)


def by_pair(near):
    return dict(zip(near.pair.tolist(), near.distance.tolist(), strict=True))


def test_gradient_is_that_of_the_distance():
    measured = world()
    near = Proximity(measured, 0.15).measure(LOW[None])
    assert len(near.pair) > 5
    step = 1e-4
    for joint in range(ROBOT.dof):
        away = step * np.eye(ROBOT.dof)[joint]
        more, less = (by_pair(Proximity(measured, 0.2).measure((LOW + s * away)[None])) for s in (1, -1))
        for pair, gradient in zip(near.pair.tolist(), near.gradient[:, joint], strict=True):
            assert (more[pair] - less[pair]) / (2 * step) == pytest.approx(gradient, abs=0.03)


def test_pairs_within_reach_are_found_again_wherever_the_path_moves():
    measured = world()
    remembering = Proximity(measured, 0.1)
    rng = np.random.default_rng(0)
    path = np.linspace(RIGHT, LOW, 8)
    for _ in range(12):
        near = remembering.measure(path)
        fresh = Proximity(measured, 0.1).measure(path)
        assert np.array_equal(near.pair, fresh.pair)
        assert np.array_equal(near.position, fresh.position)
        assert np.allclose(near.distance, fresh.distance, atol=1e-5)
        path = path + rng.normal(0, 0.05, path.shape)


def test_distance_agrees_with_collision():
    measured = world(padding=0.003)
    rng = np.random.default_rng(1)
    for _ in range(60):
        q = rng.uniform(ROBOT.lower, ROBOT.upper)
        near = Proximity(measured, 0.05).measure(q[None])
        least = near.distance.min(initial=1.0)
        if abs(least) > 1e-4:
            assert measured.collides(q) == (least < 0)


def test_nearest_pair_of_each_link_is_the_nearest():
    measured = world()
    every = Proximity(measured, 0.2).measure(LOW[None])
    nearest = Proximity(measured, 0.2, nearest=True).measure(LOW[None])
    first = measured.bank.first
    assert len(set(first[nearest.pair])) == len(nearest.pair) < len(every.pair)
    for pair, distance in by_pair(nearest).items():
        assert distance == pytest.approx(every.distance[first[every.pair] == first[pair]].min())


def test_links_of_the_robot_have_a_reach_of_their_own():
    measured = world(scene(box=False))
    near = Proximity(measured, 0.3, own_reach=0.01).measure(RIGHT[None])
    assert all(measured.bank.second[pair] >= measured.bank.robot_count for pair in near.pair)
    assert len(near.pair)


def test_what_may_touch_pushes_nothing_away():
    at_ball = above(0.45, -0.1, 0.03)
    of = scene([(0.45, -0.1)])
    with_ball = by_pair(Proximity(world(of, at_ball), 0.02).measure(at_ball[None]))
    allowed = world(of, at_ball, allowed=touching("ball_0"))
    without = by_pair(Proximity(allowed, 0.02).measure(at_ball[None]))
    assert set(without) < set(with_ball)
    held = world(held_scene(of, "ball_0"), at_ball)
    assert Proximity(held, 0.02).measure(LEFT[None]).distance.min(initial=1.0) > 0


def test_nothing_within_reach_is_no_pair():
    near = Proximity(world(scene([(0.9, 0.6)], box=False)), 0.001).measure(np.array([LEFT, RIGHT]))
    assert near.gradient.shape == (0, ROBOT.dof)
