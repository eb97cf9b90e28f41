"""Objects of every shape are gripped as wide as they are, carried as they lie in the hand, and rest where they fell."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from common.config import Container, Fixture, World, load_cell
from common.errors import ConfigError, Refused, UnknownName
from common.messages import Color, Header, Vector3, WorldEdit, WorldObject
from common.robot.transforms import invert, matrix_to_rpy, pose_to_matrix, tool_down
from common.sim.interface import load_world
from common.sim.kinematic import KinematicWorld

OPEN = 0.08
TABLE = Fixture(id="table", dimensions=[1.0, 1.0, 0.05], position=(0.5, 0.0, -0.025))
L_SHAPE = [(-0.02, -0.02), (0.03, -0.02), (0.03, 0.0), (0.0, 0.0), (0.0, 0.03), (-0.02, 0.03)]
CUBE = {"shape": "box", "size": [0.04, 0.04, 0.04]}
SHAPES: dict[str, tuple[dict[str, Any], float]] = {  # and how wide each is along the fingers
    "sphere": ({"shape": "sphere", "radius": 0.02}, 0.04),
    "box": ({"shape": "box", "size": [0.03, 0.05], "height": 0.04}, 0.05),
    "cylinder": ({"shape": "cylinder", "radius": 0.025, "height": 0.06}, 0.05),
    "prism": ({"shape": "prism", "polygon": L_SHAPE, "height": 0.04}, 0.05),
    "ring": ({"shape": "ring", "radius": 0.03, "inner_radius": 0.02, "height": 0.03}, 0.06),
}


class Rig:
    """A world with a table and two containers, and a hand in it, with a clock that is moved by hand."""

    def __init__(self, *things: dict[str, Any], **more: Any) -> None:
        objects = [{"id": f"thing_{i + 1}", "x": 0.4, "y": 0.0, **thing} for i, thing in enumerate(things)]
        containers = {"left": Container(x=0.6, y=0.3), "right": Container(x=0.6, y=-0.3)}
        self.config = World.model_validate({"fixtures": [TABLE], "containers": containers, "objects": objects, **more})
        self.world = KinematicWorld(self.config)
        self.now, self.hand, self.width = 100.0, tool_down(0.5, 0.0, 0.3), OPEN

    def tick(self, hand: Any = None, width: float | None = None) -> None:
        """What the control cycle does with simulated fingers."""
        self.now += 0.01
        self.hand = self.hand if hand is None else hand
        obstruction = self.world.obstruction(self.hand, self.width)
        target = self.width if width is None else width
        self.width = max(target, obstruction)
        self.world.tick(self.now, self.hand, self.width, obstruction > target)

    def grasp(self, x: float, y: float, z: float, yaw: float = 0.0) -> str:
        self.tick(tool_down(x, y, z, yaw), OPEN)
        for width in np.linspace(OPEN, 0.0, 9):
            self.tick(width=float(width))
        return self.world.held

    def put_down(self, x: float, y: float, z: float = 0.2, yaw: float = 0.0) -> None:
        self.tick(tool_down(x, y, z, yaw), 0.0)
        self.tick(width=OPEN)
        for _ in range(100):
            self.tick()

    def edit(self, op: str, at: tuple[float, float] | None = None, **fields: Any) -> str:
        position = Vector3(x=at[0], y=at[1]) if at else None
        return self.world.edit(WorldEdit.model_validate({"op": op, "position": position, **fields}), self.now)

    def thing(self, name: str = "thing_1") -> WorldObject:
        return next(thing for thing in self.world.objects(Header()).objects if thing.id == name)

    def pose(self, name: str = "thing_1") -> Any:
        return pose_to_matrix(self.thing(name).pose)


# --- in the hand ---


@pytest.mark.parametrize("shape", SHAPES)
def test_fingers_close_until_they_touch_the_object(shape: str) -> None:
    thing, wide = SHAPES[shape]
    rig = Rig(thing)
    assert rig.grasp(0.4, 0.0, 0.02) == "thing_1"
    assert rig.width == pytest.approx(wide, abs=1e-4)
    assert rig.thing().state == "held"


@given(yaw=st.floats(-math.pi, math.pi))
def test_a_box_between_the_fingers_is_as_wide_as_it_is_along_them(yaw: float) -> None:
    rig = Rig({"shape": "box", "size": [0.03, 0.05], "height": 0.04})
    assert rig.grasp(0.4, 0.0, 0.02, yaw) == "thing_1"
    # The pads are 20 mm wide: what of the box lies between them is no wider than its outline there.
    c, s = abs(math.cos(yaw)), abs(math.sin(yaw))
    across = min(0.03 / max(s, 1e-9), 0.05 / max(c, 1e-9))
    assert across - 1e-6 <= rig.width <= 0.03 * s + 0.05 * c + 1e-6


def test_a_thing_that_is_wider_than_the_fingers_open_is_not_taken() -> None:
    rig = Rig({"shape": "box", "size": [0.1, 0.1], "height": 0.04})
    assert rig.grasp(0.4, 0.0, 0.02) == "" and rig.width == 0.0 and rig.thing().state == "table"


@pytest.mark.parametrize("off", [(0.021, 0, 0), (0, 0.024, 0), (0, 0, 0.021)])
def test_fingers_beside_a_cube_close_on_air(off: tuple[float, float, float]) -> None:
    rig = Rig(CUBE)
    assert rig.grasp(0.4 + off[0], off[1], 0.02 + off[2]) == "" and rig.width == 0.0


def test_the_wall_of_a_large_ring_is_taken_with_one_finger_within_it() -> None:
    rig = Rig({"shape": "ring", "radius": 0.1, "inner_radius": 0.085, "height": 0.03})
    assert rig.grasp(0.4, 0.0925, 0.02) == "thing_1"
    assert rig.width == pytest.approx(0.015, abs=1e-3)


def test_a_held_object_keeps_its_place_and_turn_in_the_hand() -> None:
    rig = Rig({**CUBE, "yaw": 0.3})
    rig.grasp(0.403, 0.0, 0.025, 0.3)
    T_tcp_cube = invert(rig.hand) @ rig.pose()
    assert T_tcp_cube[1, 3] == pytest.approx(0.0, abs=1e-6), "the fingers centre it"
    turned = tool_down(0.3, 0.2, 0.4, 1.1)
    rig.tick(turned)
    np.testing.assert_allclose(rig.pose(), turned @ T_tcp_cube, atol=1e-9)


# --- coming to rest ---


@pytest.mark.parametrize("shape", SHAPES)
def test_an_object_that_is_let_go_lies_below_the_hand_on_the_table(shape: str) -> None:
    rig = Rig(SHAPES[shape][0])
    rig.grasp(0.4, 0.0, 0.02)
    rig.world.take_events()
    rig.put_down(0.3, -0.2, yaw=0.5)
    thing = rig.thing()
    assert thing.state == "table" and [u.data for u in rig.world.take_events()] == ["add:thing_1"]
    assert math.hypot(thing.pose.position.x - 0.3, thing.pose.position.y + 0.2) < 0.03
    assert thing.pose.position.z == pytest.approx(thing.size.z / 2)


@pytest.mark.parametrize("shape", SHAPES)
def test_an_object_that_is_dropped_into_a_container_lies_in_it_and_is_counted_there(shape: str) -> None:
    rig = Rig(SHAPES[shape][0])
    rig.grasp(0.4, 0.0, 0.02)
    rig.put_down(0.6, -0.3)
    thing = rig.thing()
    assert (thing.state, thing.container) == ("contained", "right")
    assert max(abs(thing.pose.position.x - 0.6), abs(thing.pose.position.y + 0.3)) < 0.08 - 0.008
    assert thing.pose.position.z == pytest.approx(0.005 + thing.size.z / 2)


def test_a_cube_that_falls_on_a_cube_lies_on_it_and_falls_when_that_is_taken_away() -> None:
    rig = Rig(CUBE, {**CUBE, "x": 0.3})
    rig.grasp(0.4, 0.0, 0.02)
    rig.put_down(0.303, 0.0)
    assert rig.thing().pose.position.z == pytest.approx(0.06) and rig.thing().state == "table"
    rig.edit("remove", id="thing_2")
    for _ in range(50):
        rig.tick()
    assert rig.thing().pose.position.z == pytest.approx(0.02) and rig.thing().state == "table"


def test_a_cube_whose_middle_is_not_carried_lies_beside_what_it_fell_on() -> None:
    rig = Rig(CUBE, {**CUBE, "x": 0.3})
    rig.grasp(0.4, 0.0, 0.02)
    rig.put_down(0.325, 0.0)
    x, y, z = rig.pose()[:3, 3]
    assert z == pytest.approx(0.02) and math.hypot(x - 0.3, y) >= 0.04 - 1e-6


def test_a_cube_that_is_let_go_tilted_lies_flat_on_its_nearest_side() -> None:
    rig = Rig(CUBE)
    rig.grasp(0.4, 0.0, 0.02)
    tilted = tool_down(0.3, 0.1, 0.3)
    tilted[:3, :3] = tilted[:3, :3] @ np.array([[1, 0, 0], [0, math.cos(0.2), -math.sin(0.2)],
                                               [0, math.sin(0.2), math.cos(0.2)]])
    rig.tick(tilted, 0.0)
    assert abs(matrix_to_rpy(rig.pose()[:3, :3])[0]) == pytest.approx(0.2, abs=1e-6)
    rig.tick(width=OPEN)
    for _ in range(100):
        rig.tick()
    roll, pitch, _ = matrix_to_rpy(rig.pose()[:3, :3])
    assert (roll, pitch) == pytest.approx((0.0, 0.0), abs=1e-9) and rig.pose()[2, 3] == pytest.approx(0.02)


def test_a_cube_beyond_the_table_is_out_of_sight() -> None:
    rig = Rig(CUBE)
    rig.grasp(0.4, 0.0, 0.02)
    rig.put_down(1.1, 0.0)
    assert rig.thing().state == "elsewhere" and rig.pose()[2, 3] < -0.5


def test_what_finds_no_room_beside_what_is_in_a_container_lies_on_it() -> None:
    large = {"shape": "box", "size": [0.12, 0.06], "height": 0.05}
    rig = Rig({**large, "x": 0.6, "y": 0.3}, {**large, "x": 0.3})
    rig.edit("move", (0.6, 0.3), id="thing_1")
    rig.grasp(0.3, 0.0, 0.02)
    rig.put_down(0.6, 0.3, z=0.3)
    lying = [rig.thing(name) for name in ("thing_1", "thing_2")]
    assert [thing.container for thing in lying] == ["left", "left"]
    assert sorted(round(thing.pose.position.z, 3) for thing in lying) == [0.03, 0.08]


def test_spheres_and_a_cube_in_one_container_do_not_reach_into_each_other() -> None:
    rig = Rig({"shape": "sphere", "radius": 0.03}, {**CUBE, "x": 0.6, "y": 0.3})
    assert rig.thing("thing_2").container == "left"
    rig.grasp(0.4, 0.0, 0.03)
    rig.put_down(0.61, 0.31)
    ball, cube = rig.pose("thing_1")[:3, 3], rig.pose("thing_2")[:3, 3]
    assert rig.thing().container == "left"
    on_it = ball[2] >= cube[2] + 0.02 + 0.03 - 1e-6
    off = np.maximum(np.abs(ball[:2] - cube[:2]) - 0.02, 0.0)
    assert on_it or float(np.hypot(*off)) >= 0.03 - 1e-6


# --- meshes ---


@pytest.fixture
def wedge(tmp_path: Path) -> Path:
    """A cell file with a world beside it whose object is a mesh in millimetres."""
    corners = [(-20, -20, -15), (20, -20, -15), (20, 20, -15), (-20, 20, -15), (-20, 0, 15), (20, 0, 15)]
    faces = [(0, 2, 1), (0, 3, 2), (0, 1, 5), (0, 5, 4), (1, 2, 5), (2, 3, 4), (2, 4, 5), (3, 0, 4)]
    trimesh.Trimesh(corners, faces, process=False).export(str(tmp_path / "wedge.stl"))
    world = tmp_path / "world.yaml"
    world.write_text(
        "fixtures:\n  - {id: table, dimensions: [1.0, 1.0, 0.05], position: [0.5, 0.0, -0.025]}\n"
        "containers: {tray: {x: 0.6, y: 0.3}}\n"
        "objects:\n  - {id: wedge, shape: mesh, mesh: wedge.stl, scale: 0.001, x: 0.4, y: 0.0}\n", encoding="utf-8")
    return world


def test_a_mesh_beside_the_file_of_the_world_is_gripped_carried_dropped_and_counted(wedge: Path) -> None:
    config = load_cell("panda", world=str(wedge)).world
    rig = Rig()
    rig.world = KinematicWorld(config)
    assert rig.thing("wedge").size == Vector3(x=0.04, y=0.04, z=0.03)
    assert rig.grasp(0.4, 0.0, 0.005) == "wedge"
    assert rig.width == pytest.approx(0.04, abs=1e-6), "between pads of 20 mm it is widest at their lower edge"
    rig.put_down(0.6, 0.3)
    thing = rig.thing("wedge")
    assert (thing.state, thing.container) == ("contained", "tray") and len(thing.triangles) == 8


def test_a_mesh_that_is_not_there_is_named(wedge: Path) -> None:
    (wedge.parent / "wedge.stl").unlink()
    with pytest.raises(ConfigError, match=r"world\.objects\.wedge\.mesh: .*wedge\.stl' is a mesh that cannot be read"):
        KinematicWorld(load_cell("panda", world=str(wedge)).world)


def test_a_mesh_that_was_added_is_found_after_a_restart(wedge: Path) -> None:
    config = load_cell("panda", world=str(wedge)).world
    world = KinematicWorld(config)
    world.edit(WorldEdit(op="add", like="wedge", position=Vector3(x=0.3, y=0.2)), 0.0)
    again = KinematicWorld(config)
    again.restore(world.standing())
    assert again.objects(Header()) == world.objects(Header()) and again.ids == ["wedge", "wedge_1"]


# --- edits ---


def test_an_object_of_any_shape_is_added_with_size_and_colour() -> None:
    rig = Rig(CUBE)
    size, blue = Vector3(x=0.05, y=0.03, z=0.02), Color(r=0, g=0, b=1)
    assert rig.edit("add", (0.3, 0.2), shape="box", size=size, color=blue, yaw=0.5) == "box_1"
    box = rig.thing("box_1")
    assert (box.size, box.color, box.state) == (size, blue, "table")
    assert matrix_to_rpy(rig.pose("box_1")[:3, :3])[2] == pytest.approx(0.5)
    assert rig.edit("add", (0.6, 0.3), shape="cylinder", size=Vector3(x=0.04, z=0.05)) == "cylinder_1"
    assert rig.thing("cylinder_1").container == "left"
    assert rig.edit("add", (0.3, -0.2)) == "thing_2", "like the first object of the world"
    assert rig.edit("remove", id="thing_1") == "thing_1" and "thing_1" not in rig.world.ids
    rig.edit("reset")
    assert rig.world.ids == ["thing_1"]


@pytest.mark.parametrize(("fields", "code", "text"), [
    ({"shape": "box"}, "no_size", "a box needs one"),
    ({"shape": "ring", "size": Vector3(x=0.05, y=0.05, z=0.02)}, "no_size", "inner_radius"),
    ({"shape": "prism", "size": Vector3(x=0.05, y=0.05, z=0.02)}, "no_size", "at least 3 corners"),
    ({"like": "thing_7"}, "unknown_id", "choices: thing_1"),
    ({"id": "thing_1"}, "id_exists", "thing_1"),
])
def test_what_cannot_be_added_is_refused_and_changes_nothing(fields: dict[str, Any], code: str, text: str) -> None:
    rig = Rig(CUBE)
    with pytest.raises(Refused) as refusal:
        rig.edit("add", (0.3, 0.2), **fields)
    assert refusal.value.code == code and text in str(refusal.value) and rig.world.ids == ["thing_1"]


def test_a_held_cube_slips_out_of_the_fingers() -> None:
    rig = Rig(CUBE)
    rig.grasp(0.4, 0.0, 0.02)
    rig.tick(tool_down(0.4, -0.2, 0.2))
    assert rig.edit("drop") == "thing_1"
    for _ in range(60):
        rig.tick()
    assert rig.thing().state == "table" and rig.pose()[1, 3] == pytest.approx(-0.2, abs=0.01)


def test_what_was_added_and_what_falls_is_found_after_a_restart() -> None:
    rig = Rig(CUBE)
    rig.edit("add", (0.3, 0.2), shape="cylinder", size=Vector3(x=0.04, z=0.05))
    rig.grasp(0.4, 0.0, 0.02)
    rig.tick(tool_down(0.6, 0.3, 0.3, 0.4), 0.0)
    rig.tick(width=OPEN)
    rig.tick()
    again = KinematicWorld(rig.config)
    again.restore(rig.world.standing())
    for _ in range(60):
        rig.now += 0.01
        for world in (rig.world, again):
            world.tick(rig.now, rig.hand, OPEN, False)
        for one, other in zip(again.objects(Header()).objects, rig.world.objects(Header()).objects, strict=True):
            assert (one.id, one.state, one.size) == (other.id, other.state, other.size)
            np.testing.assert_allclose(pose_to_matrix(one.pose), pose_to_matrix(other.pose), atol=1e-9)
    assert rig.thing().container == "left"


# --- simulators by name ---


def test_the_simulator_is_found_by_name_and_a_wrong_name_lists_the_choices() -> None:
    world = Rig(CUBE).config
    assert isinstance(load_world(world, world.objects), KinematicWorld)
    with pytest.raises(UnknownName, match="unknown simulator 'physics'; choices: kinematic"):
        load_world(world.model_copy(update={"simulator": "physics"}), world.objects)
    with pytest.raises(ConfigError, match=r"world\.simulator: 'common\.sim\.table' is no simulator"):
        load_world(world.model_copy(update={"simulator": "common.sim.table"}), world.objects)
