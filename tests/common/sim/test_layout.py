"""Initial positions of the objects of a world."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.config import World
from common.errors import ConfigError
from common.messages import Header
from common.robot.transforms import rpy_to_matrix
from common.sim.kinematic import KinematicWorld
from common.sim.layout import layout, sphere_in_image
from tests.common.sim.rig import SHAPES, TABLE


def anywhere(x: float, y: float, z: float) -> bool:
    return True


def within_reach(x: float, y: float, z: float) -> bool:
    return 0.28 <= math.hypot(x, y) <= 0.78


def changed(world: World, **values: object) -> World:
    return World.model_validate(world.model_dump(exclude={"objects"}) | values)


def places_of(world: World, seed: int = 1, accepts: object = anywhere) -> list[tuple[float | None, float | None]]:
    return [(thing.x, thing.y) for thing in layout(world, seed, accepts)]  # type: ignore[arg-type]


def test_layout_uses_explicit_balls_or_the_first_spots_or_none(world_config: World) -> None:
    assert places_of(changed(world_config, count=3)) == world_config.spots[:3]
    assert places_of(changed(world_config, balls=[(0.3, 0.0)], layout="random")) == [(0.3, 0.0)]
    for how in ("fixed", "random"):
        empty = changed(world_config, count=0, spots=[], layout=how)
        assert layout(empty, 1, anywhere) == [] and KinematicWorld(empty).ids == []


@given(seed=st.integers(0, 2**31 - 1), count=st.integers(1, 8))
def test_random_layout_is_separated_visible_reachable_and_clear_of_the_container(
    world_config: World, seed: int, count: int
) -> None:
    config = changed(world_config, layout="random", count=count)
    objects = layout(config, seed, within_reach)
    assert len(objects) == count and layout(config, seed, within_reach) == objects
    places = [(thing.x, thing.y) for thing in objects if thing.x is not None and thing.y is not None]
    for i, (x, y) in enumerate(places):
        assert within_reach(x, y, 0.03) and all(math.dist((x, y), other) >= 0.07 for other in places[:i])
        off_box = math.hypot(max(abs(x - 0.55) - 0.08, 0.0), max(abs(y - 0.25) - 0.08, 0.0))
        assert off_box >= 0.04 + 0.03 - 1e-9
    assert len(KinematicWorld(config, objects).ids) == count


def test_objects_without_a_position_are_placed_by_the_seed() -> None:
    described = [{"id": f"{shape}_{i}", **SHAPES[shape]} for shape in SHAPES for i in range(2)]
    config = World.model_validate({"fixtures": [TABLE], "containers": {"tray": {}}, "objects": described})
    found = layout(config, 3, within_reach)
    assert found == layout(config, 3, within_reach) != layout(config, 4, within_reach)
    assert [one.id for one in found] == [one["id"] for one in described]
    for one in KinematicWorld(config, found).objects(Header()).objects:
        assert one.state == "table" and math.hypot(one.pose.position.x, one.pose.position.y) < 0.83


@given(x=st.floats(0.0, 0.8), y=st.floats(-0.5, 0.5))
def test_sphere_in_image_means_its_complete_surface_is_visible(world_config: World, x: float, y: float) -> None:
    camera, radius = world_config.camera, 0.03
    turn = np.linspace(0, 2 * math.pi, 40)
    tilt = np.linspace(0, math.pi, 20)[:, None]
    surface = np.stack([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt) + 0 * turn])
    points = radius * surface.reshape(3, -1) + np.array([[x], [y], [radius]])
    seen = rpy_to_matrix(*camera.rpy).T @ (points - np.array(camera.position)[:, None])
    u, v = camera.fx * seen[0] / seen[2] + camera.cx, camera.fy * seen[1] / seen[2] + camera.cy
    inside = min(u.min(), v.min()) >= 7 and u.max() <= 639 - 7 and v.max() <= 479 - 7
    outside = min(u.min(), v.min()) < 5 or u.max() > 639 - 5 or v.max() > 479 - 5
    assert not (inside or outside) or sphere_in_image(camera, (x, y), radius, radius) == inside


def test_impossible_random_layout_is_a_configuration_error(world_config: World) -> None:
    config = changed(world_config, layout="random")
    with pytest.raises(ConfigError, match=r"world\.objects: 7 objects fit no random layout"):
        layout(config, 1, lambda x, y, z: math.dist((x, y), (0.4, -0.2)) < 0.05)


def test_random_layout_needs_a_camera_that_looks_down(world_config: World) -> None:
    camera = world_config.camera.model_copy(update={"rpy": (0.0, 0.0, 0.0)})
    config = changed(world_config, layout="random", camera=camera, cameras={"camera": camera})
    with pytest.raises(ConfigError, match=r"world\.camera\.rpy"):
        layout(config, 1, anywhere)
