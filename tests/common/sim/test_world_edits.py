"""Operator edits of the kinematic world: valid ones take effect exactly, all others are refused without effect."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from common.config import ObjectConfig, World, check, config_root, read_yaml
from common.errors import ConfigError, Refused
from common.messages import Color, Header, Vector3, WorldObject
from common.robot.transforms import matrix_to_rpy, tool_down
from common.sim import edits
from common.sim.interface import ObjectSnapshot
from common.sim.objects import centre_of
from tests.common.sim.rig import BOX, CUBE, R, Rig

WORLDS = ("w1", "w2", "w3", "w4", "w5", "w6")
SMALL = Vector3(x=0.05, y=0.05, z=0.02)


def rig_of(name: str, **update: Any) -> Rig:
    config: World = check(World, read_yaml(config_root() / "worlds" / f"{name}.yaml"))
    return Rig(config=config.model_copy(update=update))


def objects(rig: Rig) -> dict[str, WorldObject]:
    return {obj.id: obj for obj in rig.world.objects(Header()).objects}


def centers(rig: Rig) -> dict[str, tuple[float, ...]]:
    return {name: centre_of(obj) for name, obj in objects(rig).items()}


# --- valid edits ---


def test_added_ball_gets_the_next_free_id() -> None:
    rig = Rig.with_balls((0.5, 0.0), (0.6, 0.0))
    rig.edit("remove", "ball_1")
    assert rig.edit("add", at=(0.4, 0.2)) == "ball_1"
    assert rig.edit("add", at=(0.4, -0.2)) == "ball_3"
    assert np.allclose(rig.ball(3)[1], [0.4, -0.2, R])
    assert rig.events() == ["remove:ball_1", "add:ball_1", "add:ball_3"]


def test_moved_ball_is_published_as_removed_and_added() -> None:
    rig = Rig.with_balls()
    assert rig.edit("move", "ball_1", (0.4, 0.2)) == "ball_1"
    assert rig.events() == ["remove:ball_1", "add:ball_1"]
    assert rig.edit("move", "ball_1", (0.401, 0.2)) == "ball_1", "overlapping its own position"


def test_balls_added_above_the_container_fill_its_slots() -> None:
    rig = Rig.with_balls()
    for _ in range(8):
        rig.edit("add", at=BOX)
    assert sum(label == "box" for label, _ in rig.balls().values()) == 8
    with pytest.raises(Refused, match="box is full") as refusal:
        rig.edit("add", at=BOX)
    assert refusal.value.code == "container_full"


def test_objects_of_any_shape_are_added_with_size_and_color() -> None:
    rig = Rig(CUBE)
    size, blue = Vector3(x=0.05, y=0.03, z=0.02), Color(r=0, g=0, b=1)
    assert rig.edit("add", at=(0.3, 0.2), shape="box", size=size, color=blue, yaw=0.5) == "box_1"
    box = rig.object("box_1")
    assert (box.size, box.color, box.state) == (size, blue, "table")
    assert matrix_to_rpy(rig.pose("box_1")[:3, :3])[2] == pytest.approx(0.5)
    assert rig.edit("add", at=(0.6, 0.3), shape="cylinder", size=Vector3(x=0.04, z=0.05)) == "cylinder_1"
    assert rig.object("cylinder_1").container == "left"
    assert rig.edit("add", at=(0.3, -0.2)) == "object_2", "like the first object of the world"
    assert rig.edit("remove", "object_1") == "object_1" and "object_1" not in rig.world.ids
    rig.edit("reset")
    assert rig.world.ids == ["object_1"]


def test_inner_radius_is_ignored_except_for_rings() -> None:
    rig = Rig.with_balls()
    name = rig.edit("add", at=(0.3, 0.0), shape="cylinder", size=SMALL, inner_radius=1e9)
    assert objects(rig)[name].inner_radius == 0.0


def test_reset_restores_the_initial_layout() -> None:
    rig = Rig.with_balls((0.5, 0.0), (0.6, 0.0))
    first = {name: tuple(position) for name, (_, position) in rig.balls().items()}
    rig.grasp(0.5, 0.0)
    rig.edit("remove", "ball_2")
    rig.edit("add", at=(0.6, 0.0))
    assert rig.edit("reset") == ""
    assert {name: tuple(position) for name, (_, position) in rig.balls().items()} == first


@pytest.mark.parametrize("op", ["move", "remove", "reset"])
def test_edit_takes_a_held_ball_out_of_the_fingers(op: str) -> None:
    rig = Rig.with_balls()
    rig.grasp(0.5, 0.0)
    rig.edit(op, "ball_1", (0.3, 0.0) if op == "move" else None)
    assert rig.world.held == ""
    rig.tick(tool_down(0.5, 0.3, 0.3), 0.0)
    assert rig.width == 0.0, "the fingers close completely"


@pytest.mark.parametrize("name", WORLDS)
def test_every_object_can_be_moved_and_keeps_its_shape(name: str) -> None:
    rig = rig_of(name)
    for obj, before in objects(rig).items():
        x, y, z = centre_of(before)
        assert rig.edit("move", obj, (x + 0.002, y - 0.003)) == obj
        after = objects(rig)[obj]
        assert centre_of(after) == pytest.approx((x + 0.002, y - 0.003, z))
        np.testing.assert_allclose(np.array(after.outline) - (0.002, -0.003), before.outline, atol=1e-12)
        if before.hole:
            np.testing.assert_allclose(np.array(after.hole) - (0.002, -0.003), before.hole, atol=1e-12)
        pose = {"outline": before.outline, "hole": before.hole, "pose": before.pose}
        assert after.model_copy(update=pose) == before


def test_only_successful_moves_are_published() -> None:
    rig = rig_of("w5")
    version = rig.world.version
    rig.edit("move", "red_cylinder", (0.5, 0.05))
    assert rig.world.version > version and rig.events() == ["remove:red_cylinder", "add:red_cylinder"]
    version = rig.world.version
    with pytest.raises(Refused):
        rig.edit("move", "red_cylinder", (5.0, 0.0))
    assert rig.world.version == version


def test_object_on_the_ground_may_be_anywhere_outside_fixtures() -> None:
    post = ObjectConfig(id="post", shape="cylinder", x=1.5, y=1.5, radius=0.05, height=0.3)
    rig = rig_of("w2", objects=[post])
    rig.edit("move", "post", (-3.0, 2.0))
    with pytest.raises(Refused, match="would overlap target_base"):
        rig.edit("move", "post", (0.5, 0.0))
    assert centers(rig)["post"][:2] == pytest.approx((-3.0, 2.0))


def test_reset_and_restore_recover_positions() -> None:
    rig, again = rig_of("w5"), rig_of("w5")
    first = centers(rig)
    rig.edit("move", "red_cylinder", (0.5, 0.05))
    stranger = ObjectSnapshot(pose=(0, 0, 0, 0, 0, 0, 1))
    again.world.restore(rig.world.snapshot() | {"stranger": stranger})
    assert centers(again) == centers(rig) and centers(again)["red_cylinder"][:2] == pytest.approx((0.5, 0.05))
    assert rig.world.layout == rig_of("w5").world.layout
    assert rig.edit("reset") == ""
    assert centers(rig) == first


# --- dropping what is held ---


def test_dropped_ball_slips_out_of_closed_fingers() -> None:
    rig = Rig.with_balls()
    rig.grasp(0.5, 0.0)
    rig.tick(tool_down(0.4, -0.1, 0.2))
    assert rig.edit("drop") == "ball_1"
    assert rig.world.held == "" and rig.world.obstruction(rig.tool, rig.width) == 0.0
    rig.settle()
    label, position = rig.ball()
    assert label == "table" and np.allclose(position, [0.4, -0.1, R], atol=0.011)
    assert rig.world.held == ""


def test_ball_dropped_above_the_container_lies_in_it() -> None:
    rig = Rig.with_balls()
    rig.grasp(0.5, 0.0)
    rig.tick(tool_down(*BOX, 0.2))
    rig.edit("drop", "ball_1")
    rig.settle()
    assert rig.ball()[0] == "box"


def test_dropped_cube_slips_out_of_the_fingers() -> None:
    rig = Rig(CUBE)
    rig.grasp(0.4, 0.0, 0.02)
    rig.tick(tool_down(0.4, -0.2, 0.2))
    assert rig.edit("drop") == "object_1"
    rig.settle()
    assert rig.object().state == "table" and rig.pose()[1, 3] == pytest.approx(-0.2, abs=0.01)


# --- refusals ---

BALLS = lambda: Rig.with_balls((0.5, 0.0), (0.3, 0.3))  # noqa: E731
CUBES = lambda: Rig(CUBE)  # noqa: E731
OBJECTS = lambda: rig_of("w5")  # noqa: E731
PRISM = {"shape": "prism", "size": Vector3(x=0.04, y=0.04, z=0.02)}


@pytest.mark.parametrize(("make", "op", "name", "at", "fields", "code", "text"), [
    (BALLS, "add", "", (0.55, 0.01), {}, "occupied", "overlaps ball_1"),
    (BALLS, "add", "", (0.55, 0.25 - 0.1), {}, "occupied", "box"),
    (BALLS, "add", "", (0.55, 0.25 - 0.075), {}, "occupied", "box"),
    (BALLS, "add", "", (1.2, 0.0), {}, "off_table", "x 0 to 1"),
    (BALLS, "add", "", None, {}, "no_position", "position"),
    (BALLS, "add", "ball_1", (0.3, 0.0), {}, "id_exists", "ball_1"),
    (BALLS, "add", "no/slash", (0.3, 0.0), {}, "bad_id", "no/slash"),
    (BALLS, "move", "ball_1", (0.3, -0.9), {}, "off_table", "y -0.5 to 0.5"),
    (BALLS, "move", "ball_1", None, {}, "no_position", "position"),
    (BALLS, "move", "ball_9", (0.3, 0.0), {}, "unknown_id", "choices: ball_1, ball_2"),
    (BALLS, "remove", "bal_1", None, {}, "unknown_id", "did you mean 'ball_1'"),
    (BALLS, "remove", "", None, {}, "unknown_id", "choices"),
    (BALLS, "drop", "", None, {}, "not_held", "between the fingers"),
    (BALLS, "drop", "ball_1", None, {}, "not_held", "between the fingers"),
    (CUBES, "add", "", (0.3, 0.2), {"shape": "box"}, "no_size", "a box needs one"),
    (CUBES, "add", "", (0.3, 0.2), {"shape": "ring", "size": SMALL}, "no_size", "inner_radius"),
    (CUBES, "add", "", (0.3, 0.2), {"shape": "prism", "size": SMALL}, "no_size", "at least 3 corners"),
    (CUBES, "add", "", (0.3, 0.2), {"like": "object_7"}, "unknown_id", "choices: object_1"),
    (CUBES, "add", "object_1", (0.3, 0.2), {}, "id_exists", "object_1"),
    (CUBES, "add", "", (0.3, 0.0), {**PRISM, "polygon": [(0.1, 0.1)] * 3}, "no_size", "polygon"),
    (CUBES, "add", "", (0.3, 0.0), {**PRISM, "polygon": [(0.0, 0.0), (0.1, 0.0), (0.2, 0.0)]}, "no_size", "polygon"),
    (CUBES, "add", "", (0.3, 0.0), {**PRISM, "polygon": [(-1e7, 0.0), (1e7, 0.0), (0.0, 1e7)]}, "no_size", "1000 m"),
    (CUBES, "add", "", (0.3, 0.0), {"shape": "box", "size": Vector3(x=0.04, y=0.04, z=1e7)}, "no_size", "1000 m"),
    (CUBES, "add", "", (0.3, 0.0), {"shape": "sphere", "size": Vector3(x=1e7)}, "no_size", "1000 m"),
    (CUBES, "add", "", (1e7, -1e7), {"shape": "box", "size": SMALL}, "too_far", "1000 m"),
    (OBJECTS, "move", "green_bx", (0.5, 0.0), {}, "unknown_id", "did you mean 'green_box'"),
    (OBJECTS, "move", "ball_1", (0.5, 0.0), {}, "unknown_id", "choices: blue_prism, green_box, red_cylinder"),
    (OBJECTS, "move", "green_box", (0.9, 0.0), {}, "off_table", "target_base is x 0.375 to 0.625, y -0.375 to 0.375"),
    (OBJECTS, "move", "green_box", (0.4, -0.12), {}, "off_table", "for green_box, which takes 0.06 x 0.09 m"),
    (OBJECTS, "move", "green_box", (0.52, -0.01), {}, "occupied", "would overlap red_cylinder"),
    (OBJECTS, "move", "green_box", None, {}, "no_position", "position"),
    (OBJECTS, "remove", "green_bx", None, {}, "unknown_id", "did you mean 'green_box'"),
    (OBJECTS, "add", "", (0.52, 0.02), {}, "occupied", "would overlap red_cylinder"),
    (OBJECTS, "add", "green_box", (0.5, 0.3), {}, "id_exists", "green_box"),
])
def test_invalid_edit_is_refused_in_one_line_without_effect(
    make: Any, op: str, name: str, at: Any, fields: dict[str, Any], code: str, text: str
) -> None:
    rig = make()
    before, version = objects(rig), rig.world.version
    with pytest.raises(Refused) as refusal:
        rig.edit(op, name, at, **fields)
    assert refusal.value.code == code and text in str(refusal.value) and "\n" not in str(refusal.value)
    assert objects(rig) == before and rig.world.version == version and rig.events() == []


def test_rest_position_of_a_falling_ball_is_occupied() -> None:
    rig = Rig.with_balls((0.5, 0.0), (0.3, 0.0))
    rig.grasp(0.5, 0.0)
    rig.release(0.4, 0.2)
    with pytest.raises(Refused, match="overlaps ball_1"):
        rig.edit("move", "ball_2", (0.41, 0.2))


@pytest.mark.parametrize("position", [(0.55, 0.17), (1.1, 0.0)])
def test_impossible_position_is_a_configuration_error(position: tuple[float, float]) -> None:
    with pytest.raises(ConfigError, match=r"world\.objects"):
        Rig.with_balls((0.5, 0.0), position)


def test_number_of_objects_and_corners_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    assert edits.MAX_OBJECTS <= 1000, "the limit of messages"
    monkeypatch.setattr(edits, "MAX_OBJECTS", 3)
    rig = Rig.with_balls()
    small = {"shape": "sphere", "size": Vector3(x=0.01)}
    for i in range(2):
        rig.edit("add", at=(0.3 + 0.1 * i, 0.0), **small)
    with pytest.raises(Refused, match="at most 3"):
        rig.edit("add", at=(0.7, 0.0), **small)
    rig.edit("remove", "sphere_1")
    rig.edit("add", at=(0.7, 0.0), **small)
    monkeypatch.setattr(edits, "MAX_OBJECTS", 100)
    monkeypatch.setattr(edits, "MAX_CORNERS", 500)
    cylinder = {"shape": "cylinder", "size": Vector3(x=0.01, y=0.01, z=0.01)}
    rig.edit("add", at=(0.3, 0.2), **cylinder)
    with pytest.raises(Refused, match="at most 500"):
        rig.edit("add", at=(0.4, 0.2), **cylinder)


def test_large_concave_cross_section_is_refused() -> None:
    rig = Rig.with_balls()
    angles = np.linspace(0.0, 2 * math.pi, 1000, endpoint=False)
    around = np.column_stack([np.cos(angles), np.sin(angles)])
    star = around * np.where(np.arange(1000) % 2, 0.02, 0.01)[:, None]
    with pytest.raises(Refused, match="polygon: has 1000 corners"):
        rig.edit("add", at=(0.3, 0.0), **PRISM, polygon=star.tolist())
    rig.edit("add", at=(0.3, 0.0), **PRISM, polygon=(0.02 * around).tolist())
