"""Operator edits of the kinematic world: valid ones take effect exactly, all others are refused without effect."""

import math
from typing import Any

import numpy as np
import pytest

from common.config import ObjectConfig, World, check, config_root, read_yaml
from common.errors import ConfigError, Refused
from common.messages import Color, Vector3
from common.robot.transforms import matrix_to_rpy, tool_down
from common.sim import layout
from common.sim.interface import ObjectSnapshot
from common.sim.objects import centre_of
from tests.common.sim.rig import BOX, CUBE, R, Rig

SMALL = Vector3(x=0.05, y=0.05, z=0.02)


def rig_of(name: str, **update: Any) -> Rig:
    config: World = check(World, read_yaml(config_root() / "worlds" / f"{name}.yaml"))
    return Rig(config=config.model_copy(update=update))


def centers(rig: Rig) -> dict[str, tuple[float, ...]]:
    return {name: centre_of(obj) for name, obj in rig.objects().items()}


# --- valid edits ---


def test_added_ball_gets_the_next_free_id() -> None:
    rig = Rig.with_balls((0.5, 0.0), (0.6, 0.0))
    rig.edit("remove", "ball_1")
    assert rig.edit("add", at=(0.4, 0.2)) == "ball_1" and rig.edit("add", at=(0.4, -0.2)) == "ball_3"
    assert np.allclose(rig.ball(3)[1], [0.4, -0.2, R])
    assert rig.events() == ["remove:ball_1", "add:ball_1", "add:ball_3"]
    version = rig.world.version
    assert rig.edit("move", "ball_1", (0.401, 0.2)) == "ball_1", "overlapping its own position"
    assert rig.world.version > version and rig.events() == ["remove:ball_1", "add:ball_1"]


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
    cylinder = {"shape": "cylinder", "size": Vector3(x=0.04, z=0.05), "inner_radius": 1e9}
    assert rig.edit("add", at=(0.6, 0.3), **cylinder) == "cylinder_1"
    assert rig.object("cylinder_1").container == "left"
    assert rig.object("cylinder_1").inner_radius == 0.0, "only a ring has one"
    assert rig.edit("add", at=(0.3, -0.2)) == "object_2", "like the first object of the world"
    assert rig.edit("remove", "object_1") == "object_1" and "object_1" not in rig.world.ids
    rig.edit("reset")
    assert rig.world.ids == ["object_1"]


@pytest.mark.parametrize("op", ["move", "remove", "reset"])
def test_edit_takes_a_held_ball_out_of_the_fingers(op: str) -> None:
    rig = Rig.holding_ball()
    rig.edit(op, "ball_1", (0.3, 0.0) if op == "move" else None)
    assert rig.world.held == ""
    rig.tick(tool_down(0.5, 0.3, 0.3), 0.0)
    assert rig.width == 0.0, "the fingers close completely"


@pytest.mark.parametrize("name", ["w1", "w2", "w3", "w4", "w5", "w6"])
def test_every_object_can_be_moved_and_keeps_its_shape(name: str) -> None:
    rig = rig_of(name)
    for obj, before in rig.objects().items():
        x, y, z = centre_of(before)
        assert rig.edit("move", obj, (x + 0.002, y - 0.003)) == obj
        after = rig.object(obj)
        assert centre_of(after) == pytest.approx((x + 0.002, y - 0.003, z))
        for new, old in ((after.outline, before.outline), (after.hole, before.hole)):
            np.testing.assert_allclose(np.reshape(new, (-1, 2)) - (0.002, -0.003), np.reshape(old, (-1, 2)), atol=1e-12)
        pose = {"outline": before.outline, "hole": before.hole, "pose": before.pose}
        assert after.model_copy(update=pose) == before


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
    assert rig.world.layout == rig_of("w5").world.layout and rig.edit("reset") == ""
    assert centers(rig) == first
    balls = Rig.holding_ball((0.5, 0.0), (0.6, 0.0))
    balls.edit("remove", "ball_2")
    balls.edit("add", at=(0.6, 0.0))
    balls.edit("reset")
    assert centers(balls) == centers(Rig.with_balls((0.5, 0.0), (0.6, 0.0)))


@pytest.mark.parametrize(("spot", "label"), [((0.4, -0.1), "table"), (BOX, "box")])
def test_dropped_ball_slips_out_of_closed_fingers(spot: tuple[float, float], label: str) -> None:
    rig = Rig.holding_ball()
    rig.tick(tool_down(*spot, 0.2))
    assert rig.edit("drop") == "ball_1"
    assert rig.world.held == "" and rig.world.obstruction(rig.tool, rig.width) == 0.0
    rig.settle()
    assert rig.ball()[0] == label and rig.world.held == ""
    assert label == "box" or np.allclose(rig.ball()[1], [*spot, R], atol=0.011)


# --- refusals ---


BALLS = lambda: Rig.with_balls((0.5, 0.0), (0.3, 0.3))  # noqa: E731
CUBES = lambda: Rig(CUBE)  # noqa: E731
OBJECTS = lambda: rig_of("w5")  # noqa: E731
PRISM = {"shape": "prism", "size": Vector3(x=0.04, y=0.04, z=0.02)}
AROUND = np.stack([(math.cos(a), math.sin(a)) for a in np.linspace(0.0, 2 * math.pi, 1000, endpoint=False)])
STAR = (AROUND * np.where(np.arange(1000) % 2, 0.02, 0.01)[:, None]).tolist()


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
    (CUBES, "add", "", (0.3, 0.0), {**PRISM, "polygon": [(0.1, 0.1)] * 3}, "no_size", "polygon"),
    (CUBES, "add", "", (0.3, 0.0), {**PRISM, "polygon": [(0.0, 0.0), (0.1, 0.0), (0.2, 0.0)]}, "no_size", "polygon"),
    (CUBES, "add", "", (0.3, 0.0), {**PRISM, "polygon": [(-1e7, 0.0), (1e7, 0.0), (0.0, 1e7)]}, "no_size", "1000 m"),
    (CUBES, "add", "", (0.3, 0.0), {**PRISM, "polygon": STAR}, "too_many_corners", "polygon: has 1000 corners"),
    (CUBES, "add", "", (0.3, 0.0), {"shape": "box", "size": Vector3(x=0.04, y=0.04, z=1e7)}, "no_size", "1000 m"),
    (CUBES, "add", "", (0.3, 0.0), {"shape": "sphere", "size": Vector3(x=1e7)}, "no_size", "1000 m"),
    (CUBES, "add", "", (1e7, -1e7), {"shape": "box", "size": SMALL}, "too_far", "1000 m"),
    (OBJECTS, "move", "green_bx", (0.5, 0.0), {}, "unknown_id", "did you mean 'green_box'"),
    (OBJECTS, "move", "green_box", (0.9, 0.0), {}, "off_table", "target_base is x 0.375 to 0.625, y -0.375 to 0.375"),
    (OBJECTS, "move", "green_box", (0.4, -0.12), {}, "off_table", "for green_box, which takes 0.06 x 0.09 m"),
    (OBJECTS, "move", "green_box", (0.52, -0.01), {}, "occupied", "would overlap red_cylinder"),
    (OBJECTS, "add", "", (0.52, 0.02), {}, "occupied", "would overlap red_cylinder"),
])
def test_invalid_edit_is_refused_in_one_line_without_effect(make, op, name, at, fields, code, text) -> None:
    rig = make()
    before, version = rig.objects(), rig.world.version
    with pytest.raises(Refused) as refusal:
        rig.edit(op, name, at, **fields)
    assert refusal.value.code == code and text in str(refusal.value) and "\n" not in str(refusal.value)
    assert rig.objects() == before and rig.world.version == version and rig.events() == []


def test_rest_position_of_a_falling_ball_is_occupied() -> None:
    rig = Rig.holding_ball((0.5, 0.0), (0.3, 0.0))
    rig.release(0.4, 0.2)
    with pytest.raises(Refused, match="overlaps ball_1"):
        rig.edit("move", "ball_2", (0.41, 0.2))


@pytest.mark.parametrize("position", [(0.55, 0.17), (1.1, 0.0)])
def test_impossible_position_is_a_configuration_error(position: tuple[float, float]) -> None:
    with pytest.raises(ConfigError, match=r"world\.objects"):
        Rig.with_balls((0.5, 0.0), position)


def test_number_of_objects_and_corners_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    assert layout.MAX_OBJECTS <= 1000, "the limit of messages"
    monkeypatch.setattr(layout, "MAX_OBJECTS", 3)
    rig = Rig.with_balls()
    small = {"shape": "sphere", "size": Vector3(x=0.01)}
    for i in range(2):
        rig.edit("add", at=(0.3 + 0.1 * i, 0.0), **small)
    with pytest.raises(Refused, match="at most 3"):
        rig.edit("add", at=(0.7, 0.0), **small)
    rig.edit("remove", "sphere_1")
    rig.edit("add", at=(0.7, 0.0), **small)
    monkeypatch.setattr(layout, "MAX_OBJECTS", 100)
    monkeypatch.setattr(layout, "MAX_CORNERS", 500)
    cylinder = {"shape": "cylinder", "size": Vector3(x=0.01, y=0.01, z=0.01)}
    rig.edit("add", at=(0.3, 0.2), **cylinder)
    with pytest.raises(Refused, match="at most 500"):
        rig.edit("add", at=(0.4, 0.2), **cylinder)


def test_large_convex_cross_section_is_accepted() -> None:
    assert Rig.with_balls().edit("add", at=(0.3, 0.0), **PRISM, polygon=(0.02 * AROUND).tolist()) == "prism_1"
