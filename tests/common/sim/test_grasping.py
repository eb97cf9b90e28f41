"""Grasping in the kinematic world: what the fingers hold, how wide it is, and how it moves with the gripper."""

import math
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from common.config import load_cell
from common.errors import ConfigError, UnknownName
from common.messages import Header, Vector3
from common.robot.transforms import invert, tool_down
from common.sim.interface import load_world
from common.sim.kinematic import KinematicWorld
from tests.common.sim.rig import CUBE, GRIP, SHAPES, R, Rig

BOX_4_CM = {"shape": "box", "size": [0.04, 0.04], "height": 0.04}


@given(
    yaw=st.floats(-math.pi, math.pi), across=st.floats(-0.0099, 0.0099), sideways=st.floats(-0.0119, 0.0119),
    above=st.floats(-0.0099, 0.0099),
)
def test_ball_between_the_fingers_is_grasped_and_centered(yaw, across, sideways, above) -> None:
    rig = Rig.with_balls()
    tool = tool_down(0.5, 0.0, R + above, yaw)
    x, y, z = tool[:3, 3] + tool[:3, :3] @ [across, sideways, 0.0]
    assert rig.grasp(x, y, z, yaw) == "ball_1" and rig.width == GRIP
    offset = rig.tool[:3, :3].T @ (rig.ball()[1] - rig.tool[:3, 3])
    assert offset[1] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(("thing", "y", "width"), [
    (SHAPES["sphere"], 0.0, 0.04), (SHAPES["box"], 0.0, 0.05), (SHAPES["cylinder"], 0.0, 0.05),
    (SHAPES["prism"], 0.0, 0.05), (SHAPES["ring"], 0.0, 0.06),
    ({"shape": "ring", "radius": 0.1, "inner_radius": 0.085, "height": 0.03}, 0.0925, 0.015),  # by its wall
])
def test_fingers_close_to_the_width_of_the_object(thing, y: float, width: float) -> None:
    rig = Rig(thing)
    assert rig.grasp(0.4, y, 0.02) == "object_1" and rig.width == pytest.approx(width, abs=1e-3)
    assert rig.object().state == "held"


@given(yaw=st.floats(-math.pi, math.pi))
def test_width_of_a_rotated_box_is_its_extent_between_the_pads(yaw: float) -> None:
    rig = Rig(SHAPES["box"])
    assert rig.grasp(0.4, 0.0, 0.02, yaw) == "object_1"
    # The pads are 20 mm wide: the part between them is no wider than the outline.
    c, s = abs(math.cos(yaw)), abs(math.sin(yaw))
    across = min(0.03 / max(s, 1e-9), 0.05 / max(c, 1e-9))
    assert across - 1e-6 <= rig.width <= 0.03 * s + 0.05 * c + 1e-6


@pytest.mark.parametrize(("thing", "off"), [
    *(({"shape": "sphere", "radius": R}, off) for off in (
        (0.011, 0, 0), (0, 0.013, 0), (0, 0, 0.011), (0, 0.05, 0), (0.2, 0, 0))),
    *((BOX_4_CM, off) for off in ((0.021, 0, -0.01), (0, 0.024, -0.01), (0, 0, 0.011))),
    ({**BOX_4_CM, "size": [0.1, 0.1]}, (0, 0, -0.01)),  # wider than the opening
])
def test_fingers_next_to_an_object_or_too_narrow_close_on_nothing(thing, off) -> None:
    rig = Rig(thing)
    assert rig.grasp(0.4 + off[0], off[1], R + off[2]) == ""
    assert rig.width == 0.0 and rig.object().state == "table" and rig.events() == []


def test_closed_fingers_grasp_nothing_and_open_ones_only_one_ball() -> None:
    rig = Rig.with_balls((0.5, 0.0), (0.56, 0.0))
    rig.tick(width=0.03)
    rig.tick(tool_down(0.5, 0.0, R))
    rig.tick(width=0.0)
    assert rig.world.held == "" and rig.width == 0.0
    assert rig.grasp(0.5, 0.0) == "ball_1"
    assert [label for label, _ in rig.balls().values()] == ["held", "table"]


def test_held_object_moves_rigidly_with_the_gripper() -> None:
    rig = Rig({**CUBE, "yaw": 0.3})
    rig.grasp(0.403, 0.0, 0.025, 0.3)
    T_tcp_cube = invert(rig.tool) @ rig.pose()
    assert T_tcp_cube[1, 3] == pytest.approx(0.0, abs=1e-6), "the fingers center it"
    turned = tool_down(0.3, 0.2, 0.4, 1.1)
    rig.tick(turned)
    np.testing.assert_allclose(rig.pose(), turned @ T_tcp_cube, atol=1e-9)


def test_grasp_and_rest_are_published_as_remove_and_add() -> None:
    rig = Rig.holding_ball()
    assert rig.events() == ["remove:ball_1"]
    rig.release(0.3, 0.0)
    assert rig.events() == []
    rig.settle()
    (update,) = rig.world.take_events()
    assert update.data == "add:ball_1" and update.pose is not None
    assert update.pose.position.x == pytest.approx(0.3)


def test_release_needs_an_opening_beyond_the_tolerance() -> None:
    rig = Rig.holding_ball()
    rig.tick(width=GRIP + 0.001)
    assert rig.world.held == "ball_1"
    rig.tick(width=GRIP + 0.003)
    assert rig.world.held == ""


# --- meshes ---


@pytest.fixture
def wedge(tmp_path: Path) -> Path:
    """A world file whose object is a mesh in millimeters, in a file relative to it."""
    corners = [(-20, -20, -15), (20, -20, -15), (20, 20, -15), (-20, 20, -15), (-20, 0, 15), (20, 0, 15)]
    faces = [(0, 2, 1), (0, 3, 2), (0, 1, 5), (0, 5, 4), (1, 2, 5), (2, 3, 4), (2, 4, 5), (3, 0, 4)]
    trimesh.Trimesh(corners, faces, process=False).export(str(tmp_path / "wedge.stl"))
    world = tmp_path / "world.yaml"
    world.write_text(
        "fixtures:\n  - {id: table, dimensions: [1.0, 1.0, 0.05], position: [0.5, 0.0, -0.025]}\n"
        "containers: {tray: {x: 0.6, y: 0.3}}\n"
        "objects:\n  - {id: wedge, shape: mesh, mesh: wedge.stl, scale: 0.001, x: 0.4, y: 0.0}\n", encoding="utf-8")
    return world


def test_mesh_from_a_file_is_grasped_placed_and_restored(wedge: Path) -> None:
    rig = Rig(config=load_cell("panda", world=str(wedge)).world)
    assert rig.object("wedge").size == Vector3(x=0.04, y=0.04, z=0.03)
    assert rig.grasp(0.4, 0.0, 0.005) == "wedge"
    assert rig.width == pytest.approx(0.04, abs=1e-6), "between pads of 20 mm it is widest at their lower edge"
    rig.put_down(0.6, 0.3)
    obj = rig.object("wedge")
    assert (obj.state, obj.container) == ("contained", "tray") and len(obj.triangles) == 8
    rig.edit("add", at=(0.3, 0.2), like="wedge")
    again = KinematicWorld(rig.config)
    again.restore(rig.world.snapshot())
    assert again.objects(Header()) == rig.world.objects(Header()) and again.ids == ["wedge", "wedge_1"]


@pytest.mark.parametrize(("content", "problem"), [
    (b"", "that cannot be read"),
    (bytes(80) + b"\1\0\0\0" + bytes(50), "its corners lie on a line"),  # one triangle without extent
])
def test_unusable_mesh_file_is_named(content: bytes, problem: str, wedge: Path) -> None:
    (wedge.parent / "wedge.stl").write_bytes(content)
    with pytest.raises(ConfigError, match=rf"world\.objects\.wedge\.mesh: .*wedge\.stl' is a mesh .*{problem}"):
        KinematicWorld(load_cell("panda", world=str(wedge)).world)


def test_unknown_simulator_lists_the_choices() -> None:
    world = Rig(CUBE).config
    assert isinstance(load_world(world, world.objects), KinematicWorld)
    with pytest.raises(UnknownName, match="unknown simulator 'physics'; choices: kinematic"):
        load_world(world.model_copy(update={"simulator": "physics"}), world.objects)
    with pytest.raises(ConfigError, match=r"world\.simulator: 'common\.sim\.table' is no simulator"):
        load_world(world.model_copy(update={"simulator": "common.sim.table"}), world.objects)
