import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.config import World
from common.errors import ConfigError
from common.robot.transforms import rpy_to_matrix
from common.sim.layout import layout, wholly_in_picture
from common.sim.world import SimulatedWorld


def anywhere(x: float, y: float) -> bool:
    return True


def test_fixed_layout_is_the_first_spots(world_config: World) -> None:
    assert layout(world_config.model_copy(update={"count": 3}), 1, anywhere) == world_config.spots[:3]


def test_given_balls_replace_layout_and_count(world_config: World) -> None:
    given_balls = world_config.model_copy(update={"balls": [(0.3, 0.0)], "layout": "random"})
    assert layout(given_balls, 1, anywhere) == [(0.3, 0.0)]


@pytest.mark.parametrize("how", ["fixed", "random"])
def test_world_without_balls_has_an_empty_layout(world_config: World, how: str) -> None:
    empty = World.model_validate(world_config.model_dump() | {"count": 0, "spots": [], "layout": how})
    assert layout(empty, 1, anywhere) == []
    assert SimulatedWorld(empty, []).ids == []


def within_reach(x: float, y: float) -> bool:
    return 0.28 <= math.hypot(x, y) <= 0.78


@given(seed=st.integers(0, 2**31 - 1), count=st.integers(1, 8))
def test_random_layout_is_apart_seen_reachable_and_clear_of_the_box(
    world_config: World, seed: int, count: int
) -> None:
    config = world_config.model_copy(update={"layout": "random", "count": count})
    places = layout(config, seed, within_reach)
    assert len(places) == count and layout(config, seed, within_reach) == places
    for i, (x, y) in enumerate(places):
        assert within_reach(x, y) and all(math.dist((x, y), other) >= 0.07 for other in places[:i])
        off_box = math.hypot(max(abs(x - 0.55) - 0.08, 0.0), max(abs(y - 0.25) - 0.08, 0.0))
        assert off_box >= 0.04 + 0.03 - 1e-9
    assert len(SimulatedWorld(config, places).ids) == count


def test_other_seed_gives_another_layout(world_config: World) -> None:
    config = world_config.model_copy(update={"layout": "random"})
    assert layout(config, 1, anywhere) != layout(config, 2, anywhere)


@given(x=st.floats(0.0, 0.8), y=st.floats(-0.5, 0.5))
def test_ball_in_the_picture_is_seen_with_every_point_of_its_surface(world_config: World, x: float, y: float) -> None:
    camera, radius = world_config.camera, 0.03
    turn = np.linspace(0, 2 * math.pi, 40)
    tilt = np.linspace(0, math.pi, 20)[:, None]
    surface = np.stack([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt) + 0 * turn])
    points = radius * surface.reshape(3, -1) + np.array([[x], [y], [radius]])
    seen = rpy_to_matrix(*camera.rpy).T @ (points - np.array(camera.position)[:, None])
    u, v = camera.fx * seen[0] / seen[2] + camera.cx, camera.fy * seen[1] / seen[2] + camera.cy
    inside = min(u.min(), v.min()) >= 7 and u.max() <= 639 - 7 and v.max() <= 479 - 7
    outside = min(u.min(), v.min()) < 5 or u.max() > 639 - 5 or v.max() > 479 - 5
    assert not (inside or outside) or wholly_in_picture(camera, (x, y), radius, radius) == inside


@pytest.mark.parametrize("accepts", [lambda x, y: False, lambda x, y: math.dist((x, y), (0.4, -0.2)) < 0.05])
def test_layout_that_is_not_found_is_a_configuration_error(world_config: World, accepts: object) -> None:
    config = world_config.model_copy(update={"layout": "random"})
    with pytest.raises(ConfigError, match=r"world\.count: 7 balls find no random layout"):
        layout(config, 1, accepts)  # type: ignore[arg-type]


def test_camera_that_looks_up_has_no_random_layout(world_config: World) -> None:
    camera = world_config.camera.model_copy(update={"rpy": (0.0, 0.0, 0.0)})
    config = world_config.model_copy(update={"layout": "random", "camera": camera})
    with pytest.raises(ConfigError, match=r"world\.camera\.rpy"):
        layout(config, 1, anywhere)
