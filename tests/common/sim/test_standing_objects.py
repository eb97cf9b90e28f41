"""Objects that a person moves about: they stand where they are put, whole, and nowhere where they could not."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.config import ObjectConfig, World, check, config_root, read_yaml
from common.errors import Refused
from common.messages import Header, Vector3, WorldEdit, WorldObject
from common.sim import footprints
from common.sim.footprints import overlap, within
from common.sim.interface import StandingObject
from common.sim.kinematic import KinematicWorld
from common.sim.objects import centre_of

WORLDS = ("w1", "w2", "w3", "w4", "w5", "w6")
SQUARE = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])


def config_of(name: str) -> World:
    world: World = check(World, read_yaml(config_root() / "worlds" / f"{name}.yaml"))
    return world


def world_of(name: str) -> KinematicWorld:
    return KinematicWorld(config_of(name))


def move(world: KinematicWorld, name: str, x: float, y: float) -> str:
    return world.edit(WorldEdit(op="move", id=name, position=Vector3(x=x, y=y)), 0.0)


def solids(world: KinematicWorld) -> dict[str, WorldObject]:
    return {thing.id: thing for thing in world.objects(Header()).objects}


@pytest.mark.parametrize("name", WORLDS)
def test_every_object_of_the_worlds_can_be_moved_and_keeps_its_shape(name: str) -> None:
    world = world_of(name)
    for thing, before in solids(world).items():
        x, y, z = centre_of(before)
        assert move(world, thing, x + 0.002, y - 0.003) == thing
        after = solids(world)[thing]
        assert centre_of(after) == pytest.approx((x + 0.002, y - 0.003, z))
        np.testing.assert_allclose(np.array(after.outline) - (0.002, -0.003), before.outline, atol=1e-12)
        if before.hole:
            np.testing.assert_allclose(np.array(after.hole) - (0.002, -0.003), before.hole, atol=1e-12)
        where = {"outline": before.outline, "hole": before.hole, "pose": before.pose}
        assert after.model_copy(update=where) == before


def test_move_is_news_and_what_is_refused_is_none() -> None:
    world = world_of("w5")
    version = world.version
    move(world, "red_cylinder", 0.5, 0.05)
    assert world.version > version
    assert [update.data for update in world.take_events()] == ["remove:red_cylinder", "add:red_cylinder"]
    version = world.version
    with pytest.raises(Refused):
        move(world, "red_cylinder", 5.0, 0.0)
    assert world.version == version


@pytest.mark.parametrize(
    ("op", "name", "at", "code", "text"),
    [
        ("move", "green_bx", (0.5, 0.0), "unknown_id", "did you mean 'green_box'"),
        ("move", "ball_1", (0.5, 0.0), "unknown_id", "choices: blue_prism, green_box, red_cylinder"),
        ("move", "green_box", (0.9, 0.0), "off_table", "target_base is x 0.375 to 0.625, y -0.375 to 0.375"),
        ("move", "green_box", (0.4, -0.12), "off_table", "for green_box, which takes 0.06 x 0.09 m"),
        ("move", "green_box", (0.52, -0.01), "occupied", "would overlap red_cylinder"),
        ("move", "green_box", None, "no_position", "position"),
        ("remove", "green_bx", None, "unknown_id", "did you mean 'green_box'"),
        ("add", "", (0.52, 0.02), "occupied", "would overlap red_cylinder"),
        ("add", "green_box", (0.5, 0.3), "id_exists", "green_box"),
    ],
)
def test_what_can_not_be_is_refused_in_one_line_and_changes_nothing(
    op: str, name: str, at: tuple[float, float] | None, code: str, text: str
) -> None:
    world = world_of("w5")
    before = solids(world)
    request = {"op": op, "id": name, "position": {"x": at[0], "y": at[1]} if at else None}
    with pytest.raises(Refused) as refusal:
        world.edit(WorldEdit.model_validate(request), 0.0)
    assert refusal.value.code == code and text in str(refusal.value) and "\n" not in str(refusal.value)
    assert solids(world) == before


def test_object_on_the_ground_may_stand_anywhere_but_not_in_a_fixture() -> None:
    post = ObjectConfig(id="post", shape="cylinder", x=1.5, y=1.5, radius=0.05, height=0.3)
    world = KinematicWorld(config_of("w2").model_copy(update={"objects": [post]}))
    move(world, "post", -3.0, 2.0)
    with pytest.raises(Refused, match="would overlap target_base"):
        move(world, "post", 0.5, 0.0)
    assert centre_of(solids(world)["post"])[:2] == pytest.approx((-3.0, 2.0))


def places(world: KinematicWorld) -> dict[str, tuple[float, ...]]:
    return {name: centre_of(thing) for name, thing in solids(world).items()}


def test_reset_and_restore_bring_objects_back_to_where_they_were() -> None:
    world = world_of("w5")
    first = places(world)
    move(world, "red_cylinder", 0.5, 0.05)
    again = world_of("w5")
    stranger = StandingObject(pose=(0, 0, 0, 0, 0, 0, 1))
    again.restore(world.standing() | {"stranger": stranger})
    assert places(again) == places(world) and places(again)["red_cylinder"][:2] == pytest.approx((0.5, 0.05))
    assert world.layout == world_of("w5").layout
    assert world.edit(WorldEdit(op="reset"), 0.0) == ""
    assert places(world) == first


@given(st.floats(-2, 2), st.floats(-2, 2), st.floats(0, math.pi), st.floats(0.1, 1.5))
def test_squares_overlap_where_a_point_of_one_is_within_the_other(x: float, y: float, yaw: float, s: float) -> None:
    turn = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])
    other = (s * (SQUARE - 0.5)) @ turn + (x, y)
    grid = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 41)] * 2), axis=-1).reshape(-1, 2)
    points = (s * grid) @ turn + (x, y)
    shared = bool(((points > 1e-3) & (points < 1 - 1e-3)).all(axis=1).any())
    if shared:
        assert overlap(SQUARE, other) and overlap(other, SQUARE)
    apart = (points < -0.1).any(axis=1) | (points > 1.1).any(axis=1)
    if apart.all():
        assert not overlap(SQUARE, other) and not overlap(other, SQUARE)


def test_touching_is_no_overlap_and_lying_within_is() -> None:
    assert not overlap(SQUARE, SQUARE + np.array([1.0, 0.0]))
    assert overlap(SQUARE, SQUARE)
    assert overlap(SQUARE, 0.2 * SQUARE + 0.4) and overlap(0.2 * SQUARE + 0.4, SQUARE)
    assert within(SQUARE, SQUARE) and within(0.2 * SQUARE, SQUARE) and not within(SQUARE + 0.01, SQUARE)


def test_object_fits_into_the_corner_of_another() -> None:
    corner = np.array([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)], dtype=float)
    assert not overlap(corner, 0.9 * SQUARE + 1.05)
    assert overlap(corner, SQUARE + 0.95)


def test_two_outlines_with_many_corners_cost_as_many_looks_as_there_are_corners(monkeypatch) -> None:
    angles = np.linspace(0.0, 2 * math.pi, 60, endpoint=False)
    star = np.column_stack([np.cos(angles), np.sin(angles)]) * np.where(np.arange(60) % 2, 1.0, 0.5)[:, None]
    calls = Counter()
    for name in ("triangulate", "_meet"):
        was = getattr(footprints, name)
        monkeypatch.setattr(footprints, name, lambda *a, was=was, name=name: (calls.update([name]), was(*a))[1])
    assert overlap(star, star + 0.3)
    assert not overlap(star, star + np.array([1.9, 0.5])), "one reaches between the teeth of the other"
    assert calls["triangulate"] == 4 and calls["_meet"] < 60
