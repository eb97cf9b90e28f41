import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.errors import UnknownName
from common.messages import PlanningScene
from common.planning.collision import CollisionWorld, interpolate
from common.planning.obstacles import ObstacleCache
from tests.common.planning.planning_scenes import (
    BLOCK,
    FINGERS,
    GEOMETRY,
    HOME,
    ROBOT,
    SPREAD,
    WORLD,
    above,
    ball,
    cache,
    held_scene,
    scene,
    solid,
    touching,
)

AROUND = CollisionWorld(ROBOT, scene(SPREAD), start=HOME, cache=cache())


def world(of: PlanningScene, start=HOME, **more) -> CollisionWorld:
    return CollisionWorld(ROBOT, of, start=start, cache=cache(), **more)


def next_to_finger(q, gap) -> tuple[float, float, float]:
    """Centre of a ball at the outer side of the left finger, with a gap [m] within 0.5 mm."""
    finger = ROBOT.link_poses(q)["panda_leftfinger"][:3, 3]
    tip = ROBOT.fk(q)[:3, 3]
    outwards = np.sign(finger[1] - tip[1])
    for away in np.arange(0.0, 0.2, 0.0005):
        centre = (float(tip[0]), float(finger[1] + outwards * away), float(tip[2]))
        if not world(PlanningScene(header=WORLD, objects=[ball(0, *centre)])).collides(q):
            return centre[0], float(centre[1] + outwards * gap), centre[2]
    raise AssertionError("no position next to the finger")


def test_home_is_free_above_the_table():
    assert not AROUND.collides(HOME)
    assert AROUND.colliding_pair(HOME) is None


def test_colliding_pair_names_link_and_object():
    nearby = scene([(0.35, -0.05)])
    assert world(nearby).colliding_pair(above(0.35, -0.09, 0.10)) is None
    assert world(nearby).colliding_pair(above(0.35, -0.05, 0.03)) is None  # between the open fingers
    assert world(nearby).colliding_pair(above(0.35, -0.09, 0.03)) == ("panda_rightfinger", "ball_0")
    assert world(scene()).colliding_pair(above(0.4, 0.1, -0.02))[1] == "table"


def test_links_that_fold_into_each_other_collide():
    folded = np.array([0, 0, 0, -3.07, 0, -0.01, 0.0])
    a, b = world(PlanningScene(header=WORLD)).colliding_pair(folded)
    assert a.startswith("panda_")
    assert b.startswith("panda_")


def test_object_at_the_base_link_is_no_collision():
    nearby = PlanningScene(header=WORLD, objects=[ball(0, 0.0, 0.05, z=0.03)])
    assert not world(nearby).collides(HOME)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31))
def test_free_edge_is_free_at_every_small_step(seed):
    rng = np.random.default_rng(seed)
    a = rng.uniform(ROBOT.lower, ROBOT.upper)
    b = np.clip(a + rng.normal(0, 0.4, 7), ROBOT.lower, ROBOT.upper)
    samples = interpolate([a, b], 0.01)
    colliding = [AROUND.collides(q) for q in samples]
    if AROUND.edge_free(a, b):
        assert not any(colliding)
    hit = AROUND.first_collision(samples)
    assert (hit is not None) == any(colliding)
    if hit is not None:
        assert hit.index == colliding.index(True)


def test_levers_bound_the_motion_of_link_origins():
    rng = np.random.default_rng(0)
    for _ in range(50):
        a = rng.uniform(ROBOT.lower, ROBOT.upper)
        b = np.clip(a + rng.normal(0, 0.3, 7), ROBOT.lower, ROBOT.upper)
        one, other = ROBOT.link_poses(a), ROBOT.link_poses(b)
        for link, lever in zip(GEOMETRY.links, GEOMETRY.levers, strict=True):
            moved = np.linalg.norm(one[link][:3, 3] - other[link][:3, 3])
            assert moved <= np.abs(b - a) @ lever + 1e-9


def test_padding_applies_to_perceived_objects_only():
    q = above(0.50, -0.10, 0.03)
    x, y, z = next_to_finger(q, 0.001)
    for role, expected in (("target", True), ("contained", True), ("fixture", False)):
        nearby = PlanningScene(header=WORLD, objects=[solid("ball", role, "sphere", [0.03], (x, y, z))])
        assert not world(nearby).collides(q)
        assert not world(nearby, padding=0.0005).collides(q)
        assert world(nearby, padding=0.003).collides(q) is expected


def test_allowed_pairs_may_touch_in_either_order():
    low = above(0.35, -0.09, 0.03)
    base = scene([(0.35, -0.05)])
    pair = world(base).colliding_pair(low)
    assert not world(base, allowed=touching("ball_0")).collides(low)
    assert not world(base, allowed=[(b, a) for a, b in touching("ball_0")]).collides(low)
    in_scene = base.model_copy(update={"allowed_collisions": touching("ball_0")})
    assert not world(in_scene).collides(low)
    assert world(base, allowed=touching("ball_9")).colliding_pair(low) == pair


def test_attached_object_moves_with_the_tool():
    grasp = above(0.50, -0.10, 0.03)
    lone = world(scene(BLOCK[:1]), start=grasp, attach="ball_0")
    assert lone.attached == ["ball_0"]
    assert not lone.collides(grasp)
    assert lone.colliding_pair(above(0.55, 0.174, 0.09)) == ("ball_0", "box_east")
    names = {lone.colliding_pair(above(0.45, 0.1, z))[0] for z in (0.02, 0.025)}
    assert names == {"ball_0"}
    assert not lone.collides(above(0.45, 0.05, 0.035))


def test_contact_at_the_start_ends_after_the_contact_distance():
    grasp = above(0.50, -0.10, 0.03)
    close = scene([(0.50, -0.10), (0.561, -0.10)])
    lifted = world(
        close, start=grasp, attach="ball_0", padding=0.003, contact_distance=0.02, allowed=touching("ball_1")
    )
    assert not lifted.collides(grasp)
    assert not lifted.collides(above(0.50, -0.10, 0.045))
    assert lifted.collides(above(0.50, -0.10, 0.0505))  # 64.4 mm between the centres, padded radii 66 mm
    assert not lifted.collides(above(0.50, -0.10, 0.06))
    dragged = above(0.50, -0.075, 0.03)
    assert lifted.colliding_pair(dragged) == ("ball_0", "table")


def blocked(world, *ends):
    """Return the colliding pair of a straight edge; all kinds of checks agree."""
    path = interpolate(ends, 0.005)
    hit = world.first_collision(path)
    assert (hit is None) is world.edge_free(*ends) is all(not world.collides(q) for q in path)
    return None if hit is None else hit.pair


@pytest.mark.usefixtures("backend")
@pytest.mark.parametrize("overlap", [0.002, 0.0, -0.0005])
def test_attached_object_penetrates_no_deeper_than_at_the_start(overlap):
    grasp = above(0.50, -0.10, 0.03)
    held = world(scene([(0.50, -0.10), (0.56 - overlap, -0.10)]), start=grasp, attach="ball_0", padding=0.003)
    assert not held.collides(grasp)
    assert blocked(held, grasp, above(0.50, -0.10, 0.045)) is None
    assert blocked(held, grasp, above(0.50, -0.11, 0.035)) is None
    assert blocked(held, grasp, above(0.504, -0.10, 0.0301)) == ("ball_0", "ball_1")
    assert blocked(held, grasp, above(0.515, -0.10, 0.031)) == ("ball_0", "ball_1")
    assert held.colliding_pair(above(0.50, -0.10, 0.029)) == ("ball_0", "table")


@pytest.mark.usefixtures("backend")
def test_turning_attached_object_is_checked():
    grasp = above(0.50, 0.0, 0.2)
    objects = scene(box=False)
    objects.objects += [
        solid("bar", "target", "box", [0.2, 0.02, 0.02], (0.5, 0.0, 0.19)),
        solid("post", "fixture", "box", [0.04, 0.04, 0.04], (0.58, 0.03, 0.19)),
    ]
    held = world(objects, start=grasp, attach="bar", allowed=[(link, "bar") for link in FINGERS])
    assert not held.collides(grasp)
    assert {blocked(held, grasp, above(0.50, 0.0, 0.2, yaw)) for yaw in (-0.3, 0.3)} == {None, ("bar", "post")}


def test_new_contact_near_the_start_is_a_collision():
    grasp = above(0.50, -0.10, 0.06)
    near = scene([(0.50, -0.10), (0.572, -0.10)])
    near.objects[-2].pose.position.z = 0.06
    near.objects[-1].pose.position.z = 0.06
    held = world(near, start=grasp, attach="ball_0", allowed=touching("ball_1"))
    assert not held.collides(grasp)
    assert held.colliding_pair(above(0.515, -0.10, 0.06)) == ("ball_0", "ball_1")


def test_attached_object_of_the_scene_stays_attached_until_release():
    held = held_scene(scene(BLOCK), "ball_0")
    low = above(0.45, 0.1, 0.02)
    assert world(held).colliding_pair(low) == ("ball_0", "table")
    assert world(held, attach="ball_0").colliding_pair(low) == ("ball_0", "table")
    assert world(held, release=True).colliding_pair(low) is None


def test_padding_alone_does_not_put_the_start_in_collision():
    grasp = above(0.50, -0.10, 0.03)
    x, y, z = next_to_finger(grasp, 0.001)
    nearby = PlanningScene(header=WORLD, objects=[ball(0, x, y, z)])
    padded = world(nearby, start=grasp, padding=0.005)
    assert not padded.collides(grasp)
    assert world(nearby, start=HOME, padding=0.005).collides(grasp)


def test_unknown_object_cannot_be_attached():
    with pytest.raises(UnknownName, match=r"ball_9.*ball_0"):
        world(scene(BLOCK), attach="ball_9")


def test_worlds_of_one_cache_are_independent():
    shared = ObstacleCache(GEOMETRY)
    low = above(0.35, -0.09, 0.03)

    def colliding(of: PlanningScene, **more) -> bool:
        return CollisionWorld(ROBOT, of, start=HOME, cache=shared, **more).collides(low)

    here, there = scene([(0.35, -0.05)]), scene([(0.60, -0.30)])
    assert colliding(here)
    assert not colliding(here, allowed=touching("ball_0"))
    assert colliding(here)
    assert not colliding(there)
    assert not colliding(scene())
    assert colliding(here, padding=0.003)
    grasp = CollisionWorld(ROBOT, here, start=low, attach="ball_0", cache=shared)
    assert not grasp.collides(low)
    assert colliding(here)
