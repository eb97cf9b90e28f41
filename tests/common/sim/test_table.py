"""Free positions on the table, and overlap of outlines seen from above."""

import math
from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.config import Fixture, World
from common.sim import footprints
from common.sim.footprints import overlap, within
from common.sim.table import Slots, Table

PILLAR = Fixture(id="pillar", shape="cylinder", dimensions=[0.05, 0.2], position=(0.3, 0.3, 0.1))
BEAM = Fixture(id="beam", dimensions=[0.4, 0.02, 0.1], position=(0.3, -0.3, 0.05), rpy=(0.0, 0.0, math.pi / 4))
SHELF = Fixture(id="shelf", dimensions=[0.4, 0.4, 0.02], position=(0.8, 0.0, 0.5))
SMALL = Fixture(id="table", dimensions=[0.05, 0.05, 0.05], position=(0.0, 0.0, -0.025))


def table_of(world: World, *fixtures: Fixture) -> Table:
    return Table(world.model_copy(update={"fixtures": list(fixtures)}), 0.03)


@pytest.fixture(scope="module")
def table(world_config: World) -> Table:
    return table_of(world_config, *world_config.fixtures, PILLAR, BEAM, SHELF)


@pytest.mark.parametrize(("place", "blocker"), [
    ((0.3, 0.3), "pillar"), ((0.379, 0.3), "pillar"), ((0.381, 0.3), ""), ((0.4, -0.2), "beam"), ((0.4, -0.4), ""),
    ((0.8, 0.0), ""), ((0.55, 0.25), "box"), ((0.55, 0.141), "box"), ((0.55, 0.139), ""),
])
def test_fixtures_and_containers_on_the_table_block_spheres(table: Table, place: tuple, blocker: str) -> None:
    assert table.blocked(*place) == blocker
    assert table.free(np.array([place]), np.empty((0, 2)))[0] == (not blocker)


@given(x=st.floats(0.0, 1.0), y=st.floats(-0.5, 0.5), seed=st.integers(0, 99))
def test_nearest_free_position_is_free_and_near(table: Table, x: float, y: float, seed: int) -> None:
    others = np.random.default_rng(seed).uniform([0.0, -0.5], [1.0, 0.5], (8, 2))
    found = table.nearest_free(x, y, others)
    assert found is not None and table.free(np.array([found]), others)[0]
    if table.free(np.array([[x, y]]), others)[0]:
        assert found == (x, y)
    assert math.dist(found, (x, y)) < 0.3


def test_full_table_has_no_free_position_and_a_world_without_a_table_is_unbounded(world_config: World) -> None:
    assert table_of(world_config, SMALL).nearest_free(0.0, 0.0, np.array([[0.0, 0.0]])) is None
    assert table_of(world_config).carries(9.0, 9.0)


def test_slots_are_filled_layer_by_layer_until_the_container_is_full(world_config: World) -> None:
    slots = Slots(world_config.container, world_config.ball_radius, 0.0)
    taken: list[tuple[int, int]] = []
    while (slot := slots.choose(0.6, 0.3, taken)) is not None:
        taken.append(slot)
    assert [layer for layer, _ in taken] == [0] * 4 + [1] * 4 and len(set(taken)) == slots.count == 8


SQUARE = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])


@given(st.floats(-2, 2), st.floats(-2, 2), st.floats(0, math.pi), st.floats(0.1, 1.5))
def test_squares_overlap_iff_they_share_a_point(x: float, y: float, yaw: float, s: float) -> None:
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


def test_touching_is_no_overlap_but_containment_is() -> None:
    assert not overlap(SQUARE, SQUARE + np.array([1.0, 0.0])) and overlap(SQUARE, SQUARE)
    assert overlap(SQUARE, 0.2 * SQUARE + 0.4) and overlap(0.2 * SQUARE + 0.4, SQUARE)
    assert within(SQUARE, SQUARE) and within(0.2 * SQUARE, SQUARE) and not within(SQUARE + 0.01, SQUARE)


def test_square_fits_into_a_concave_corner() -> None:
    corner = np.array([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)], dtype=float)
    assert not overlap(corner, 0.9 * SQUARE + 1.05) and overlap(corner, SQUARE + 0.95)


def test_overlap_of_large_outlines_takes_bounded_work(monkeypatch) -> None:
    angles = np.linspace(0.0, 2 * math.pi, 60, endpoint=False)
    star = np.column_stack([np.cos(angles), np.sin(angles)]) * np.where(np.arange(60) % 2, 1.0, 0.5)[:, None]
    calls = Counter()
    for name in ("triangulate", "convex_overlap"):
        was = getattr(footprints, name)
        monkeypatch.setattr(footprints, name, lambda *a, was=was, name=name: (calls.update([name]), was(*a))[1])
    assert overlap(star, star + 0.3)
    assert not overlap(star, star + np.array([1.9, 0.5])), "one reaches between the teeth of the other"
    assert calls["triangulate"] == 4 and calls["convex_overlap"] < 60
