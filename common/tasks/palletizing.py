"""Patterns of items on a pallet: columns, rows and layers, interleaved or not, in the order in which they are placed.

The frame of a pallet is at the center of its top, z up. Columns follow each other along its x axis, rows along y.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from common.config.basics import Coordinate, Length, Number, Parameters, Point
from common.messages import Pose
from common.robot.transforms import matrix_to_pose, rpy_to_matrix, transform

Array = npt.NDArray[np.float64]
Place = tuple[float, float, float]  # x, y, z in world [m]
Count = Annotated[int, Field(ge=1, le=100)]

MAX_SLOTS = 10_000
EPSILON = 1e-6  # [m] rounding of sizes that fit exactly
MARGIN = 0.1  # share of an item's side beyond its center at which it must be supported in all four quadrants
_AXES = "xy"


class Pattern(Parameters, frozen=True):
    """Equal items on a pallet. An item is `item` long (x), wide (y) and high [m]; sizes are before it is turned."""

    item: tuple[Length, Length, Length] = Field(description="length, width and height of an item [m]")
    columns: Count = Field(description="items along x")
    rows: Count = Field(1, description="items along y")
    layers: Count = 1
    gap: tuple[Annotated[float, Field(ge=0, le=10)], Annotated[float, Field(ge=0, le=10)]] = Field(
        (0.0, 0.0), description="between items, along their length and their width [m]")
    pitch: tuple[Length, Length] | None = Field(None, description="between their centers [m], instead of gap")
    stacking: Literal["column", "brick"] = Field(
        "column", description="brick: each second layer is turned by 90 degrees")
    turned: tuple[Count, Count] | None = Field(
        None, description="items along their length and width in turned layers; default: columns, rows")
    sheet: float = Field(0.0, ge=0, le=0.1, description="thickness of the sheet between layers [m]; 0: none")
    pallet: tuple[Length, Length] | None = Field(None, description="size of the pallet [m]; the pattern must fit on it")
    position: Point = Field((0.0, 0.0, 0.0), description="center of the pallet's top in world [m]")
    yaw: Number = Field(0.0, description="of the pallet in world [rad]")
    robot: tuple[Coordinate, Coordinate] = Field(
        (0.0, 0.0), description="base of the robot in world [m]: the farthest item of a layer is placed first")

    @model_validator(mode="after")
    def _check(self) -> Pattern:
        if self.pitch is not None and "gap" in self.model_fields_set:
            raise ValueError("pitch and gap exclude each other: leave one of them out")
        if self.turned is not None and self.stacking != "brick":
            raise ValueError("turned is for stacking: brick")
        if (number := len(_layer(self, 0)) * self.layers) > MAX_SLOTS:
            raise ValueError(f"{number} items are more than {MAX_SLOTS}")
        for axis in (0, 1):
            if self.pitch is not None and self.pitch[axis] < self.item[axis] - EPSILON:
                raise ValueError(f"pitch is {self.pitch[axis]:g} m, less than the {self.item[axis]:g} m of an item's "
                                 f"{('length', 'width')[axis]}: items would overlap")
        for layer in range(min(self.layers, 2)):
            self._require_fit(layer)
        if self.stacking == "brick":
            for layer in range(1, min(self.layers, 3)):  # the others repeat these
                self._require_support(layer)
        return self

    @property
    def distance(self) -> tuple[float, float]:
        """Distance of the centers of neighbors along length and width of the items [m]."""
        return self.pitch or (self.item[0] + self.gap[0], self.item[1] + self.gap[1])

    def is_turned(self, layer: int) -> bool:
        """Return whether the items of a layer are turned by 90 degrees."""
        return self.stacking == "brick" and layer % 2 == 1

    def size(self, layer: int) -> tuple[float, float]:
        """Return the size of an item of a layer along x and y of the pallet [m]."""
        length, width, _ = self.item
        return (width, length) if self.is_turned(layer) else (length, width)

    def _require_fit(self, layer: int) -> None:
        if self.pallet is None:
            return
        size, centers = self.size(layer), np.array([at for _, _, at in _layer(self, layer)])
        for axis, room in enumerate(self.pallet):
            if (needed := float(np.ptp(centers[:, axis])) + size[axis]) > room + EPSILON:
                number = len({round(float(at), 6) for at in centers[:, axis]})
                turned = "turned " if self.is_turned(layer) else ""
                raise ValueError(f"{number} {turned}items along {_AXES[axis]} need {needed:.4g} m, and the pallet has "
                                 f"{room:g} m: does not fit")

    def _require_support(self, layer: int) -> None:
        above, below = (np.array([at for _, _, at in _layer(self, each)]) for each in (layer, layer - 1))
        half, carrying = np.array(self.size(layer)) / 2, np.array(self.size(layer - 1)) / 2
        for at in above:
            for sign in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
                near, far = at + np.multiply(sign, half * MARGIN), at + np.multiply(sign, half)
                low, high = np.minimum(near, far), np.maximum(near, far)
                overlap = np.minimum(high, below + carrying) - np.maximum(low, below - carrying)
                if not (overlap > EPSILON).all(axis=1).any():
                    raise ValueError(f"an item at ({at[0]:.3f}, {at[1]:.3f}) m of layer {layer + 1} would tip: layer "
                                     f"{layer} does not carry all its sides; choose other counts or gaps")


@dataclass(frozen=True)
class Slot:
    """The place of one item: `pose` of its center in world; layers, rows and columns count from 0."""

    index: int  # in the order of placing
    layer: int
    row: int
    column: int
    pose: Pose
    turned: bool = False
    needs_sheet: bool = False  # a sheet comes onto the layer below before this item


def slots(pattern: Pattern) -> list[Slot]:
    """Return all slots in the order of placing: layer after layer, in each the items farthest from the robot first."""
    height, found = pattern.item[2], list[Slot]()
    T_world_pallet = transform(rpy_to_matrix(0.0, 0.0, pattern.yaw), pattern.position)
    away = np.array(pattern.position[:2]) - pattern.robot
    reach = float(np.linalg.norm(away))
    away = away / reach if reach > EPSILON else T_world_pallet[:2, 0]
    for layer in range(pattern.layers):
        turned = pattern.is_turned(layer)
        z = height / 2 + layer * (height + pattern.sheet)
        rotation = rpy_to_matrix(0.0, 0.0, math.pi / 2 if turned else 0.0)
        poses = [(column, row, T_world_pallet @ transform(rotation, (x, y, z)))
                 for column, row, (x, y) in _layer(pattern, layer)]
        poses.sort(key=lambda one: _order(one[2], away))
        for number, (column, row, T) in enumerate(poses):
            sheet = pattern.sheet > 0 and layer > 0 and number == 0
            found.append(Slot(len(found), layer, row, column, matrix_to_pose(T), turned, sheet))
    return found


def slot_at(pattern: Pattern, place: Place, among: Sequence[Slot] | None = None) -> Slot | None:
    """Return the slot that an item with its center at a place [m] in world is in; None: in no slot."""
    near, high = min(pattern.item[:2]) / 2, pattern.item[2] / 2
    return next((slot for slot in (slots(pattern) if among is None else among)
                 if math.dist(_xy(slot), place[:2]) < near and abs(slot.pose.position.z - place[2]) < high), None)


def filled(pattern: Pattern, places: Iterable[Place]) -> set[int]:
    """Return the indices of filled slots, given the centers [m] of all items that a camera sees.

    An item hides those below it: every slot that carries a filled one is filled, too.
    """
    every = slots(pattern)
    found = {slot.index for place in places if (slot := slot_at(pattern, place, every)) is not None}
    T_pallet_world = rpy_to_matrix(0.0, 0.0, -pattern.yaw)[:2, :2]
    for upper in reversed(every):
        if upper.index not in found:
            continue
        for lower in every:
            if lower.layer == upper.layer - 1:
                apart = np.abs(T_pallet_world @ np.subtract(_xy(upper), _xy(lower)))
                room = (np.array(pattern.size(upper.layer)) + pattern.size(lower.layer)) / 2
                if (apart < room - EPSILON).all():
                    found.add(lower.index)
    return found


def free_slots(pattern: Pattern, places: Iterable[Place]) -> list[Slot]:
    """Return the slots to fill next, in order, given the centers [m] of all items that a camera sees."""
    taken = filled(pattern, places)
    return [slot for slot in slots(pattern) if slot.index not in taken]


def _layer(pattern: Pattern, layer: int) -> list[tuple[int, int, tuple[float, float]]]:
    """Column, row and center (x, y) [m] in the frame of the pallet of all items of a layer."""
    turned = pattern.is_turned(layer)
    columns, rows = pattern.turned or (pattern.columns, pattern.rows) if turned else (pattern.columns, pattern.rows)
    dx, dy = pattern.distance
    found = []
    for column in range(columns):
        for row in range(rows):
            along, across = (column - (columns - 1) / 2) * dx, (row - (rows - 1) / 2) * dy
            found.append((column, row, (-across, along) if turned else (along, across)))
    return found


def _order(T_world_item: Array, away: Array) -> tuple[float, float]:
    x, y = T_world_item[:2, 3]
    return -round(float(x * away[0] + y * away[1]), 6), round(float(x * away[1] - y * away[0]), 6)


def _xy(slot: Slot) -> tuple[float, float]:
    return slot.pose.position.x, slot.pose.position.y
