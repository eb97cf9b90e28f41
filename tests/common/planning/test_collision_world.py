import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.errors import UnknownName
from common.planning.collision import interpolate
from tests.common.planning.requests import above, touching
from tests.common.planning.scenes import BLOCK, HOME, ROBOT, TABLE, ball, cache, held_scene, only, scene, solid, world

AROUND = world(TABLE)
GRASP, LOW = above(0.50, -0.10, 0.03), above(0.35, -0.09, 0.03)


def next_to_finger(q, gap) -> tuple[float, float, float]:
    """Centre of a ball at the outer side of the left finger, with a gap [m] within 0.5 mm."""
    finger = ROBOT.link_poses(q)["panda_leftfinger"][:3, 3]
    tip = ROBOT.fk(q)[:3, 3]
    outwards = np.sign(finger[1] - tip[1])
    for away in np.arange(0.0, 0.2, 0.0005):
        centre = (float(tip[0]), float(finger[1] + outwards * away), float(tip[2]))
        if not world(only(ball(0, *centre))).collides(q):
            return centre[0], float(centre[1] + outwards * gap), centre[2]
    raise AssertionError("no position next to the finger")


def test_colliding_pair_names_link_and_object():
    assert AROUND.colliding_pair(HOME) is None
    nearby = scene([(0.35, -0.05)])
    assert world(nearby).colliding_pair(above(0.35, -0.09, 0.10)) is None
    assert world(nearby).colliding_pair(above(0.35, -0.05, 0.03)) is None  # between the open fingers
    assert world(nearby).colliding_pair(LOW) == ("panda_rightfinger", "ball_0")
    assert world(scene()).colliding_pair(above(0.4, 0.1, -0.02))[1] == "table"
    folded = world(only()).colliding_pair(np.array([0, 0, 0, -3.07, 0, -0.01, 0.0]))
    assert all(link.startswith("panda_") for link in folded)
    assert not world(only(ball(0, 0.0, 0.05))).collides(HOME), "the base link may touch objects"


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31))
def test_free_edge_is_free_at_every_small_step(seed):
    rng = np.random.default_rng(seed)
    a = rng.uniform(ROBOT.lower, ROBOT.upper)
    b = np.clip(a + rng.normal(0, 0.4, 7), ROBOT.lower, ROBOT.upper)
    samples = interpolate([a, b], 0.01)
    colliding = [AROUND.collides(q) for q in samples]
    assert not (AROUND.edge_free(a, b) and any(colliding))
    hit = AROUND.first_collision(samples)
    assert (hit is not None) == any(colliding)
    if hit is not None:
        assert hit.index == colliding.index(True)


def test_padding_applies_to_perceived_objects_only():
    place = next_to_finger(GRASP, 0.001)
    for role, expected in (("target", True), ("contained", True), ("fixture", False)):
        nearby = only(solid("ball", role, "sphere", [0.03], place))
        assert not world(nearby).collides(GRASP) and not world(nearby, padding=0.0005).collides(GRASP)
        assert world(nearby, padding=0.003).collides(GRASP) is expected


def test_padding_alone_does_not_put_the_start_in_collision():
    nearby = only(ball(0, *next_to_finger(GRASP, 0.001)))
    assert not world(nearby, GRASP, padding=0.005).collides(GRASP)
    assert world(nearby, HOME, padding=0.005).collides(GRASP)


def test_allowed_pairs_may_touch_in_either_order():
    base = scene([(0.35, -0.05)])
    assert not world(base, allowed=touching("ball_0")).collides(LOW)
    assert not world(base, allowed=[(b, a) for a, b in touching("ball_0")]).collides(LOW)
    assert not world(base.model_copy(update={"allowed_collisions": touching("ball_0")})).collides(LOW)
    assert world(base, allowed=touching("ball_9")).colliding_pair(LOW) == world(base).colliding_pair(LOW) is not None


def test_attached_object_moves_with_the_tool():
    lone = world(scene(BLOCK[:1]), GRASP, attach="ball_0")
    assert lone.attached == ["ball_0"] and not lone.collides(GRASP)
    assert lone.colliding_pair(above(0.55, 0.174, 0.09)) == ("ball_0", "box_east")
    for z in (0.02, 0.025):
        assert lone.colliding_pair(above(0.45, 0.1, z))[0] == "ball_0"
    assert not lone.collides(above(0.45, 0.05, 0.035))
    with pytest.raises(UnknownName, match=r"ball_9.*ball_0"):
        world(scene(BLOCK), attach="ball_9")


def test_contact_at_the_start_ends_after_the_contact_distance():
    close = scene([(0.50, -0.10), (0.561, -0.10)])
    rules = {"padding": 0.003, "contact_distance": 0.02, "allowed": touching("ball_1")}
    lifted = world(close, GRASP, attach="ball_0", **rules)
    assert not lifted.collides(GRASP) and not lifted.collides(above(0.50, -0.10, 0.045))
    assert lifted.collides(above(0.50, -0.10, 0.0505))  # 64.4 mm between the centres, padded radii 66 mm
    assert not lifted.collides(above(0.50, -0.10, 0.06))
    assert lifted.colliding_pair(above(0.50, -0.075, 0.03)) == ("ball_0", "table")


def blocked(of, *ends):
    """Return the colliding pair of a straight edge; all kinds of checks agree."""
    path = interpolate(ends, 0.005)
    hit = of.first_collision(path)
    assert (hit is None) is of.edge_free(*ends) is all(not of.collides(q) for q in path)
    return None if hit is None else hit.pair


@pytest.mark.usefixtures("backend")
@pytest.mark.parametrize("overlap", [0.002, 0.0, -0.0005])
def test_attached_object_penetrates_no_deeper_than_at_the_start(overlap):
    held = world(scene([(0.50, -0.10), (0.56 - overlap, -0.10)]), GRASP, attach="ball_0", padding=0.003)
    assert not held.collides(GRASP) and blocked(held, GRASP, above(0.50, -0.10, 0.045)) is None
    assert blocked(held, GRASP, above(0.50, -0.11, 0.035)) is None
    assert blocked(held, GRASP, above(0.504, -0.10, 0.0301)) == ("ball_0", "ball_1")
    assert blocked(held, GRASP, above(0.515, -0.10, 0.031)) == ("ball_0", "ball_1")
    assert held.colliding_pair(above(0.50, -0.10, 0.029)) == ("ball_0", "table")


@pytest.mark.usefixtures("backend")
def test_turning_attached_object_is_checked():
    grasp = above(0.50, 0.0, 0.2)
    bar = solid("bar", "target", "box", [0.2, 0.02, 0.02], (0.5, 0.0, 0.19))
    post = solid("post", "fixture", "box", [0.04, 0.04, 0.04], (0.58, 0.03, 0.19))
    held = world(scene((), bar, post, box=False), grasp, attach="bar", allowed=touching("bar"))
    assert not held.collides(grasp)
    assert {blocked(held, grasp, above(0.50, 0.0, 0.2, yaw)) for yaw in (-0.3, 0.3)} == {None, ("bar", "post")}


def test_new_contact_near_the_start_is_a_collision():
    grasp = above(0.50, -0.10, 0.06)
    near = scene((), ball(0, 0.50, -0.10, 0.06), ball(1, 0.572, -0.10, 0.06))
    held = world(near, grasp, attach="ball_0", allowed=touching("ball_1"))
    assert not held.collides(grasp)
    assert held.colliding_pair(above(0.515, -0.10, 0.06)) == ("ball_0", "ball_1")


def test_attached_object_of_the_scene_stays_attached_until_release():
    held, low = held_scene(scene(BLOCK), "ball_0"), above(0.45, 0.1, 0.02)
    assert world(held).colliding_pair(low) == ("ball_0", "table")
    assert world(held, attach="ball_0").colliding_pair(low) == ("ball_0", "table")
    assert world(held, release=True).colliding_pair(low) is None


def test_worlds_of_one_cache_are_independent():
    shared = cache()
    here, there = scene([(0.35, -0.05)]), scene([(0.60, -0.30)])
    for of, more, colliding in (
        (here, {}, True), (here, {"allowed": touching("ball_0")}, False), (here, {}, True), (there, {}, False),
        (scene(), {}, False), (here, {"padding": 0.003}, True), (here, {"start": LOW, "attach": "ball_0"}, False),
        (here, {}, True),
    ):
        assert world(of, cache=shared, **more).collides(LOW) is colliding
