"""TrajOpt's swept pieces."""

import numpy as np
import pytest

from common.planning.collision import CollisionWorld
from common.planning.joint_paths import line
from common.planning.proximity import Proximity, SweptEdges
from tests.common.planning.planner_checks import AROUND, LEFT, RIGHT, assert_sound, with_planner
from tests.common.planning.planning_scenes import ROBOT, above, cache, held_scene, scene, solid, to_joints

WALL = scene(box=False)
WALL.objects.append(solid("wall", "fixture", "box", [0.4, 0.02, 0.3], (0.55, 0.0, 0.15)))


def worlds():
    held = held_scene(scene([(0.5, 0.0)]), "ball_0")
    return [WALL, AROUND, held]


@pytest.mark.parametrize("which", range(3))
def test_what_is_swept_is_as_near_as_any_position_between_the_waypoints(which):
    around = worlds()[which]
    world = CollisionWorld(ROBOT, around, start=RIGHT, cache=cache())
    rng = np.random.default_rng(which)
    joints = np.array([item.parentJoint for item in world.bank.geometry.geometryObjects])
    compared = 0
    for _ in range(12):
        a = np.clip(RIGHT + rng.uniform(0, 1) * (LEFT - RIGHT) + rng.normal(0, 0.2, 7), ROBOT.lower, ROBOT.upper)
        b = np.clip(a + rng.normal(0, 0.06, 7), ROBOT.lower, ROBOT.upper)
        swept = SweptEdges(world, 0.2).measure(np.array([a, b]))
        states = Proximity(world, 0.3, nearest=True).measure(line(a, b, 20))
        for pair, distance in zip(swept.pair, swept.distance, strict=True):
            same = world.bank.first[states.pair] == world.bank.first[pair]
            fixed = same & (joints[world.bank.second[states.pair]] == 0)
            if fixed.any():
                compared += 1
                assert distance < states.distance[fixed].min() + 2e-3  # what turns bulges out of its hull
    assert compared > 10


def test_step_along_the_gradient_moves_what_is_swept_away():
    world = CollisionWorld(ROBOT, WALL, start=RIGHT, cache=cache())
    path = np.array([above(0.5, -0.25, 0.15), above(0.5, -0.15, 0.15), above(0.5, -0.25, 0.15)])
    pieces = SweptEdges(world, 0.5)
    near = pieces.measure(path)
    tried = 0
    for position, pair, distance, gradient in zip(near.position, near.pair, near.distance, near.gradient, strict=True):
        if world.pair(pair)[1] != "wall" or position != 2:  # the waypoint in the middle reaches farthest
            continue
        moved = path.copy()
        moved[1] += 0.01 * gradient / np.linalg.norm(gradient)
        then = pieces.measure(moved)
        gained = then.distance[then.pair == pair].min() - distance
        assert 0.3 < gained / (0.01 * np.linalg.norm(gradient)) < 1.5
        tried += 1
    assert tried


def test_blade_between_two_states_is_seen_and_gone_round():
    around = scene(box=False)
    around.objects.append(solid("blade", "fixture", "box", [0.4, 0.002, 0.3], (0.55, 0.0, 0.15)))
    world = CollisionWorld(ROBOT, around, start=RIGHT, cache=cache())
    path = np.array([above(0.5, -0.15, 0.15), above(0.5, 0.16, 0.15)])
    ends = Proximity(world, 0.2).measure(path)
    assert ends.distance.min() > 0
    near = SweptEdges(world, 0.02).measure(path)
    assert min(near.distance) < -0.02
    assert {world.pair(pair)[1] for pair in near.pair[near.distance < 0]} == {"blade"}
    pipeline = with_planner("trajopt", steps=10)
    for height in (0.15, 0.2):
        request = to_joints(above(0.5, 0.3, height), above(0.45, -0.3, height), planning_time=20.0)
        assert_sound(pipeline, request, around, pipeline.plan(request, around))
