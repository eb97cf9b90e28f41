"""Patterns of items on a pallet: poses, order, and what does not fit."""

from __future__ import annotations

import math
from itertools import combinations, pairwise

import numpy as np
import pytest

from common.config.basics import check
from common.errors import ConfigError
from common.robot.transforms import matrix_to_rpy, pose_to_matrix
from common.tasks.palletizing import Pattern, Slot, filled, free_slots, slot_at, slots
from common.tasks.stages import place_of

BRICKS = {"item": [0.06, 0.04, 0.03], "columns": 2, "rows": 3, "layers": 3, "stacking": "brick"}  # a layer is square


def pattern(**values: object) -> Pattern:
    return check(Pattern, {"item": [0.06, 0.04, 0.03], "columns": 2, "rows": 3} | values, "pattern")


def corners(slot: Slot, item: tuple[float, float, float]) -> np.ndarray:
    """All eight corners of an item in its slot (8, 3) [m]."""
    half = np.array(item) / 2
    signs = np.array([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)])
    return (pose_to_matrix(slot.pose) @ np.column_stack([signs * half, np.ones(8)]).T)[:3].T


PATTERNS = [
    {}, {"layers": 2}, {"gap": [0.01, 0.02], "layers": 2}, {"pitch": [0.07, 0.05]}, {**BRICKS, "gap": [0.0, 0.0]},
    {**BRICKS, "sheet": 0.002}, {"columns": 1, "rows": 1, "layers": 5}, {**BRICKS, "turned": [2, 3]},
]


@pytest.mark.parametrize("values", PATTERNS)
def test_items_never_overlap_and_every_layer_lies_on_the_one_below(values: dict[str, object]) -> None:
    found = pattern(**values)
    every = slots(found)
    low = [corners(slot, found.item).min(axis=0) for slot in every]
    high = [corners(slot, found.item).max(axis=0) for slot in every]
    for a, b in combinations(range(len(every)), 2):
        assert (np.minimum(high[a], high[b]) - np.maximum(low[a], low[b])).min() < 1e-9, (every[a], every[b])
    for slot, bottom in zip(every, low, strict=True):
        assert bottom[2] == pytest.approx(slot.layer * (found.item[2] + found.sheet))
    assert [slot.index for slot in every] == list(range(len(every)))


def test_pose_of_an_item_follows_position_and_yaw_of_the_pallet() -> None:
    yaw = 0.7
    placed = slots(pattern(position=[0.5, 0.2, 0.1], yaw=yaw, layers=2, stacking="brick"))
    plain = {(s.layer, s.row, s.column): s for s in slots(pattern(layers=2, stacking="brick"))}
    for slot in placed:
        x, y, z = place_of(plain[slot.layer, slot.row, slot.column].pose)
        c, s = math.cos(yaw), math.sin(yaw)
        assert place_of(slot.pose) == pytest.approx((0.5 + c * x - s * y, 0.2 + s * x + c * y, 0.1 + z))
        turn = yaw + (math.pi / 2 if slot.turned else 0.0)
        assert matrix_to_rpy(pose_to_matrix(slot.pose)[:3, :3]) == pytest.approx((0.0, 0.0, turn))


def test_each_second_layer_of_bricks_is_turned_within_the_same_outline() -> None:
    every = slots(pattern(**BRICKS))
    assert [any(s.turned for s in every if s.layer == layer) for layer in range(3)] == [False, True, False]
    for layer in range(3):
        points = np.vstack([corners(slot, (0.06, 0.04, 0.03)) for slot in every if slot.layer == layer])
        assert np.ptp(points[:, :2], axis=0) == pytest.approx((0.12, 0.12))


@pytest.mark.parametrize(("position", "yaw", "robot"), [
    ((0.5, 0.0, 0.0), 0.0, (0.0, 0.0)), ((0.3, 0.4, 0.0), 0.5, (0.0, 0.0)), ((0.5, 0.0, 0.0), 0.0, (1.2, 0.1)),
    ((0.0, 0.0, 0.0), 0.3, (0.0, 0.0)),
])
def test_layers_are_complete_before_the_next_and_the_farthest_item_of_a_layer_comes_first(
    position: tuple[float, ...], yaw: float, robot: tuple[float, ...]
) -> None:
    every = slots(pattern(**BRICKS, position=position, yaw=yaw, robot=robot))
    assert [slot.layer for slot in every] == sorted(slot.layer for slot in every)
    away = np.subtract(position[:2], robot)
    for before, after in pairwise(every):
        if before.layer == after.layer:
            assert np.subtract(place_of(before.pose)[:2], place_of(after.pose)[:2]) @ away >= -1e-6


def test_sheet_comes_onto_each_complete_layer_but_the_last() -> None:
    every = slots(pattern(**BRICKS, sheet=0.002))
    assert [slot.index for slot in every if slot.needs_sheet] == [6, 12]
    assert not any(slot.needs_sheet for slot in slots(pattern(**BRICKS)))


@pytest.mark.parametrize(("values", "line"), [
    ({"pallet": [0.11, 0.2]}, "pattern: 2 items along x need 0.12 m, and the pallet has 0.11 m: does not fit"),
    ({"pallet": [0.2, 0.13], "gap": [0, 0.01]}, "pattern: 3 items along y need 0.14 m, and the pallet has 0.13 m: "
                                                "does not fit"),
    ({**BRICKS, "columns": 3, "pallet": [0.2, 0.12]}, "pattern: 3 turned items along y need 0.18 m, and the pallet has "
                                                      "0.12 m: does not fit"),
    ({"pitch": [0.07, 0.03]}, "pattern: pitch is 0.03 m, less than the 0.04 m of an item's width: items would overlap"),
    ({"pitch": [0.07, 0.05], "gap": [0, 0.01]}, "pattern: pitch and gap exclude each other: leave one of them out"),
    ({"turned": [1, 1]}, "pattern: turned is for stacking: brick"),
    ({**BRICKS, "columns": 4}, "pattern: an item at (0.040, -0.090) m of layer 2 would tip: layer 1 does not carry all "
                               "its sides; choose other counts or gaps"),
    ({**BRICKS, "turned": [1, 1]}, "pattern: an item at (-0.030, -0.040) m of layer 3 would tip: layer 2 does not "
                                   "carry all its sides; choose other counts or gaps"),
    ({"columns": 100, "rows": 100, "layers": 2}, "pattern: 20000 items are more than 10000"),
    ({"rows": 0}, "pattern.rows: 0 must be greater than or equal to 1"),
    ({"shape": "grid"}, "pattern.shape: 'grid' is not a parameter; choices: columns, gap, item, layers, pallet, pitch, "
                        "position, robot, rows, sheet, stacking, turned, yaw"),
])
def test_pattern_that_cannot_be_placed_is_one_line(values: dict[str, object], line: str) -> None:
    with pytest.raises(ConfigError) as raised:
        pattern(**values)
    assert str(raised.value) == line


@pytest.mark.parametrize("values", PATTERNS)
def test_what_a_camera_sees_from_above_names_the_next_slot(values: dict[str, object]) -> None:
    found = pattern(position=[0.5, 0.2, 0.0], yaw=0.4, **values)
    every = slots(found)
    for number, slot in enumerate(every):
        seen = [place_of(s.pose) for s in every[:number] if s.layer >= slot.layer - 1]  # lower ones may be hidden
        assert filled(found, seen) == set(range(number))
        assert [s.index for s in free_slots(found, seen)] == list(range(number, len(every)))


@pytest.mark.parametrize(("offset", "is_in"), [
    ((0.0, 0.0, 0.0), True), ((0.015, 0.01, 0.01), True), ((0.03, 0.0, 0.0), False), ((0.0, 0.0, 0.02), False),
])
def test_item_is_in_a_slot_within_half_its_size(offset: tuple[float, ...], is_in: bool) -> None:
    found = pattern(gap=[0.05, 0.05])
    slot = slots(found)[2]
    place = tuple(float(v) for v in np.add(place_of(slot.pose), offset))
    assert (slot_at(found, place) == slot) is is_in  # type: ignore[arg-type]
