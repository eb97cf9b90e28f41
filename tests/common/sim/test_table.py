import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.config import Fixture, World
from common.sim.table import Slots, Table

PILLAR = Fixture(id="pillar", shape="cylinder", dimensions=[0.05, 0.2], position=(0.3, 0.3, 0.1))
BEAM = Fixture(id="beam", dimensions=[0.4, 0.02, 0.1], position=(0.3, -0.3, 0.05), rpy=(0.0, 0.0, math.pi / 4))
SHELF = Fixture(id="shelf", dimensions=[0.4, 0.4, 0.02], position=(0.8, 0.0, 0.5))
NO_SPHERES = np.empty((0, 2))


@pytest.fixture(scope="module")
def furnished(world_config: World) -> World:
    return world_config.model_copy(update={"fixtures": [*world_config.fixtures, PILLAR, BEAM, SHELF]})


@pytest.mark.parametrize(
    ("place", "blocker"),
    [((0.3, 0.3), "pillar"), ((0.379, 0.3), "pillar"), ((0.381, 0.3), ""), ((0.4, -0.2), "beam"), ((0.4, -0.4), ""),
     ((0.8, 0.0), ""), ((0.55, 0.25), "box"), ((0.55, 0.141), "box"), ((0.55, 0.139), "")],
)
def test_fixtures_and_containers_on_the_table_block_spheres(
    furnished: World, place: tuple[float, float], blocker: str
) -> None:
    assert Table(furnished, 0.03).blocked(*place) == blocker
    assert Table(furnished, 0.03).free(np.array([place]), NO_SPHERES)[0] == (not blocker)


@given(x=st.floats(0.0, 1.0), y=st.floats(-0.5, 0.5), seed=st.integers(0, 99))
def test_nearest_free_position_is_free_and_near(furnished: World, x: float, y: float, seed: int) -> None:
    table = Table(furnished, 0.03)
    others = np.random.default_rng(seed).uniform([0.0, -0.5], [1.0, 0.5], (8, 2))
    found = table.nearest_free(x, y, others)
    assert found is not None and table.free(np.array([found]), others)[0]
    if table.free(np.array([[x, y]]), others)[0]:
        assert found == (x, y)
    assert math.dist(found, (x, y)) < 0.3


def test_full_table_has_no_free_position(world_config: World) -> None:
    small = Fixture(id="table", dimensions=[0.05, 0.05, 0.05], position=(0.0, 0.0, -0.025))
    table = Table(world_config.model_copy(update={"fixtures": [small]}), 0.03)
    assert table.nearest_free(0.0, 0.0, np.array([[0.0, 0.0]])) is None


def test_world_without_a_table_is_unbounded(world_config: World) -> None:
    assert Table(world_config.model_copy(update={"fixtures": []}), 0.03).carries(9.0, 9.0)


def test_slots_are_inside_the_walls_and_separated(world_config: World) -> None:
    slots = Slots(world_config.container, world_config.ball_radius, 0.0)
    centres = np.array([slots.position((layer, i)) for layer in range(slots.layers) for i in range(4)])
    c, r = world_config.container, world_config.ball_radius
    assert len(centres) == slots.count == 8
    assert np.all(np.abs(centres[:, :2] - (c.x, c.y)) + r <= c.half_side - c.wall_thickness + 1e-9)
    gaps = np.linalg.norm(centres[:, None] - centres[None], axis=-1) + np.eye(8)
    assert gaps.min() >= 2 * r - 1e-9 and centres[:, 2].min() == pytest.approx(c.floor_thickness + r)


def test_slots_fill_layer_by_layer_until_the_container_is_full(world_config: World) -> None:
    slots = Slots(world_config.container, world_config.ball_radius, 0.0)
    taken: list[tuple[int, int]] = []
    while (slot := slots.choose(0.6, 0.3, taken)) is not None:
        taken.append(slot)
    assert [layer for layer, _ in taken] == [0] * 4 + [1] * 4 and len(set(taken)) == 8
