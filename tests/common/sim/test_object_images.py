"""Every camera shows objects of every shape, in their colour and where they are."""

from __future__ import annotations

import math
from typing import Any

import msgpack
import numpy as np
import pytest

from common.config import Fixture, Surroundings, World
from common.errors import ConfigError, DecodeError
from common.messages import Color, Header, WorldObject, WorldObjects
from common.perception.pinhole import Pinhole
from common.sim import rendering
from common.sim.kinematic import KinematicWorld
from common.sim.layout import layout
from common.sim.objects import solid_of_message, world_object
from common.sim.rendering import Renderer
from common.transport.codec import decode
from tests.common.sim.spheres import spheres

TABLE = Fixture(id="table", dimensions=[1.0, 1.0, 0.05], position=(0.5, 0.0, -0.025), color=(0.55, 0.35, 0.1))
POST = Fixture(id="post", shape="cylinder", dimensions=[0.03, 0.3], position=(0.6, 0.2, 0.15), color=(1.0, 0.0, 1.0))
AROUND = Surroundings(fixtures=[TABLE, POST])
CAMERA = Pinhole.from_config(AROUND.camera)
BLUE = (0.0, 0.25, 1.0)
L_SHAPE = [(-0.03, -0.03), (0.03, -0.03), (0.03, 0.0), (0.0, 0.0), (0.0, 0.03), (-0.03, 0.03)]
THINGS: dict[str, dict[str, Any]] = {
    "box": {"shape": "box", "size": [0.06, 0.04, 0.03]},
    "cylinder": {"shape": "cylinder", "radius": 0.03, "height": 0.08},
    "prism": {"shape": "prism", "polygon": L_SHAPE, "height": 0.03},
    "ring": {"shape": "ring", "radius": 0.04, "inner_radius": 0.02, "height": 0.02},
}


def thing(**values: Any) -> WorldObject:
    world = World.model_validate({"objects": [{"id": "thing", "x": 0.45, "y": -0.1, "color": BLUE, **values}]})
    return world_object(world.objects[0])


def is_color(picture: Any, rgb: tuple[float, float, float]) -> Any:
    bgr = np.round(255 * np.array(rgb[::-1])).astype(int)
    return (np.abs(picture.astype(int) - bgr) <= 2).all(axis=2)


@pytest.mark.parametrize("plain", [True, False])
@pytest.mark.parametrize("shape", THINGS)
def test_an_object_is_seen_where_its_surface_is(shape: str, plain: bool) -> None:
    seen = thing(**THINGS[shape], yaw=0.4)
    view = Renderer(AROUND, plain=plain).render([seen])
    blue = is_color(view.colour, BLUE)
    corners = solid_of_message(seen).triangles.reshape(-1, 3)
    T = np.eye(4)
    T[:3, :3] = [[math.cos(0.4), -math.sin(0.4), 0], [math.sin(0.4), math.cos(0.4), 0], [0, 0, 1]]
    T[:3, 3] = seen.pose.position.x, seen.pose.position.y, seen.pose.position.z
    pixels = CAMERA.project(corners @ T[:3, :3].T + T[:3, 3])
    v, u = np.nonzero(blue)
    assert (u.min(), v.min()) == pytest.approx(tuple(pixels.min(axis=0)), abs=2)
    assert (u.max(), v.max()) == pytest.approx(tuple(pixels.max(axis=0)), abs=2)
    middle = np.rint(CAMERA.project([0.45, -0.1, 0.0])).astype(int)
    if shape != "prism":  # which has a corner there
        assert blue[middle[1], middle[0]] == (shape != "ring"), "one looks through a ring"


def test_what_is_nearer_hides_what_is_farther_whatever_their_shapes() -> None:
    below, above = thing(shape="box", size=[0.2, 0.2, 0.02]), spheres([(0.45, -0.1, 0.05)]).objects[0]
    u, v = np.rint(CAMERA.project([0.45, -0.1, 0.08])).astype(int)
    renderer = Renderer(AROUND, plain=True)
    red = (1.0, 0.15, 0.1)
    assert is_color(renderer.render([above, below]).colour, red)[v, u]
    lifted = thing(shape="box", size=[0.2, 0.2, 0.02], z=0.2)
    assert is_color(renderer.render([above, lifted]).colour, BLUE)[v, u]
    assert not is_color(renderer.render([above, lifted]).colour, red).any()


def test_fixtures_are_seen_in_their_colour_and_a_plain_table_is_grey() -> None:
    u, v = np.rint(CAMERA.project([0.6, 0.2, 0.3])).astype(int)
    plain, full = (Renderer(AROUND, plain=plain).render([]).colour for plain in (True, False))
    assert is_color(plain, POST.color)[v, u] and is_color(full, POST.color)[v, u]
    assert not is_color(plain, TABLE.color).any() and is_color(full, TABLE.color).any()


def test_what_is_held_is_hidden_in_a_plain_picture_and_shown_in_a_full_one() -> None:
    held = thing(**THINGS["box"]).model_copy(update={"state": "held"})
    assert not is_color(Renderer(AROUND, plain=True).render([held]).colour, BLUE).any()
    assert is_color(Renderer(AROUND).render([held]).colour, BLUE).any()


def test_depth_is_that_of_the_top_of_a_thing() -> None:
    view = Renderer(AROUND).render([thing(**THINGS["cylinder"])])
    u, v = np.rint(CAMERA.project([0.45, -0.1, 0.08])).astype(int)
    assert view.depth[v, u] == pytest.approx(0.8 - 0.08, abs=1e-4)
    assert view.depth[10, 10] == pytest.approx(0.8, abs=1e-4)


def test_colour_and_turn_of_a_thing_are_news_for_a_camera() -> None:
    renderer = Renderer(AROUND, plain=True)
    first = renderer.render([thing(**THINGS["box"])]).colour
    assert (renderer.render([thing(**THINGS["box"], yaw=0.5)]).colour != first).any()
    green = thing(**THINGS["box"]).model_copy(update={"color": Color(r=0, g=1, b=0)})
    assert is_color(renderer.render([green]).colour, (0.0, 1.0, 0.0)).any()
    np.testing.assert_array_equal(renderer.render([thing(**THINGS["box"])]).colour, first)


def test_spheres_that_lie_as_before_are_drawn_as_before_and_not_worked_out_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    worked_out = []

    def seen(*arguments: Any) -> Any:
        worked_out.append(1)
        return seen_sphere(*arguments)

    seen_sphere = rendering._sphere_coverage
    monkeypatch.setattr(rendering, "_sphere_coverage", seen)
    renderer, places = Renderer(AROUND, plain=True), [(0.4, 0.1, 0.03), (0.45, 0.15, 0.03), (0.6, -0.2, 0.03)]
    renderer.render(spheres(places, AROUND).objects)
    for moved in ((0.43, 0.14, 0.03), (0.43, 0.14, 0.05)):
        places[0] = moved
        worked_out.clear()
        picture = renderer.render(spheres(places, AROUND).objects).colour
        assert len(worked_out) == 1
        fresh = Renderer(AROUND, plain=True).render(spheres(places, AROUND).objects)
        np.testing.assert_array_equal(picture, fresh.colour)


# --- messages ---


@pytest.mark.parametrize("shape", ["box", "cylinder", "prism", "ring"])
def test_an_object_of_a_recording_from_before_has_a_pose_and_a_size(shape: str) -> None:
    now = thing(**THINGS[shape], yaw=0.4, z=0.1)
    before = WorldObject.model_validate({
        "id": "thing", "shape": shape, "outline": now.outline, "hole": now.hole, "base": now.base,
        "height": now.height, "color": now.color})
    one, other = (Renderer(AROUND).render([told]).colour for told in (now, before))
    assert (one != other).any(axis=2).mean() < 1e-4, "it is drawn as it would be now"
    assert before.size.z == pytest.approx(now.size.z)


def test_objects_without_a_place_are_laid_out_apart_by_the_seed() -> None:
    things = [{"id": f"{shape}_{i}", **THINGS[shape]} for shape in THINGS for i in range(2)]
    world = World.model_validate({"fixtures": [TABLE], "containers": {"tray": {}}, "objects": things})
    found = layout(world, 3, lambda x, y, z: math.hypot(x, y) < 0.7)
    assert found == layout(world, 3, lambda x, y, z: math.hypot(x, y) < 0.7) != layout(world, 4, lambda x, y, z: True)
    assert [one.id for one in found] == [one["id"] for one in things]
    truth = KinematicWorld(world, found)
    for one in truth.objects(Header()).objects:
        assert one.state == "table" and math.hypot(one.pose.position.x, one.pose.position.y) < 0.75
    with pytest.raises(ConfigError, match=r"world\.objects: 8 objects fit no random layout"):
        layout(world, 3, lambda x, y, z: False)


@pytest.mark.parametrize("wrong", [
    {"shape": "mesh"}, {"shape": "mesh", "vertices": [(0.0, 0.0, 0.0)] * 3},
    {"shape": "mesh", "vertices": [(0.0, 0.0, 0.0)] * 3, "triangles": [(0, 1, 3)]},
    {"shape": "mesh", "vertices": [(0.0, 0.0, 0.0)] * 3, "triangles": [(0, 1, -1)]},
    {"shape": "prism"}, {"shape": "prism", "polygon": [(0.0, 0.0), (1.0, 0.0)]},
])
def test_object_that_has_no_shape_is_no_message(wrong):
    with pytest.raises(DecodeError, match=r"WorldObjects\.objects\.0"):
        decode(WorldObjects, msgpack.packb({"objects": [{"id": "a", **wrong}]}))


def test_shapes_that_are_not_seen_any_more_are_not_kept() -> None:
    renderer = Renderer(AROUND)
    for k in range(20):
        renderer.render([thing(shape="box", size=[0.05, 0.05, 0.02 + 0.001 * k])])
    assert len(renderer._meshes) == 1
