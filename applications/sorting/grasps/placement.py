"""How deep the open gripper can go over an object, straight down or tilted, before it meets anything."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from applications.sorting.grasps.contacts import Contacts, Strips
from applications.sorting.grasps.gripper_shape import GripperShape
from applications.sorting.grasps.height_map import HeightMap

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

WIDER = 1  # cells: between the sample points of a finger
SLACKS = (2, 3, 4)  # cells by which everything is wider, to measure the slack
_WANTED_SPARE = 0.017  # [m] opening beyond the width, if there is space
_RISE_FOR_SPARE = 0.1  # [m] of depth that a metre of deviation from it is worth
_CORRECTIONS = 2  # of a tilted gripper
_TOLERANCE = 0.0005  # [m] of penetration into the slack after the last correction


@dataclass(frozen=True, eq=False)
class Placed:
    """Grippers over seeds.

    Attributes:
        seed: (n,) index of the seed; label: (n,) of its object; contacts: of the seed.
        T_world_closing: (n, 4, 4) pose of the closing frame.
        middle: (n, 2) between the contacts, world [m]; yaw: (n,) of the closing axis seen from above [rad].
        opening: (n,) [m]; tip: (n,) z of the lowest point of the tips [m].
        engagement: (n,) of the tips below the lower edge [m].
        rise: (n,) by which the gripper is higher than wanted, so that it is free [m].
        tilt: (n,) [rad]; free: (n,) nothing is where the gripper is.
        reach: (n,) of the tips beyond the TCP [m].
    """

    seed: Indices
    label: Indices
    contacts: Contacts
    T_world_closing: Array
    middle: Array
    yaw: Array
    opening: Array
    tip: Array
    engagement: Array
    rise: Array
    tilt: Array
    free: NDArray[np.bool_]
    reach: Array

    def select(self, chosen: Indices) -> Placed:
        """Return some of them."""
        values: dict[str, Any] = {name: each[chosen] for name, each in vars(self).items() if name != "contacts"}
        return Placed(contacts=self.contacts.select(chosen), **values)

    @classmethod
    def joined(cls, several: Sequence[Placed]) -> Placed:
        """Return all of several."""
        contacts = Contacts.joined([each.contacts for each in several])
        values: dict[str, Any] = {
            name: np.concatenate([getattr(each, name) for each in several])
            for name in vars(several[0]) if name != "contacts"}
        return cls(contacts=contacts, **values)

    def slack(self, heights: HeightMap, gripper: GripperShape) -> Array:
        """Return (n,) by how much everything could be wider and the open fingers would still be free [m]."""
        points = gripper.finger_surfaces.placed(self.T_world_closing, self.opening)
        slack, free = np.zeros(len(self.seed)), np.ones(len(self.seed), bool)
        for cells, deep in zip(SLACKS, heights.penetration(points, *SLACKS), strict=True):
            free &= deep <= _TOLERANCE
            slack[free] = heights.step * (cells - WIDER)
        return slack


def lowered(
    heights: HeightMap, strips: Strips, tip: Array, contacts: Contacts, gripper: GripperShape,
    spares: Sequence[float], slack: Array,
) -> Placed:
    """Return upright grippers as deep as wanted, or as deep as they can be.

    Args:
        heights: of the surroundings.
        strips, contacts: of the seeds; tip: (n,) wanted z of the tips [m].
        gripper: its shape.
        spares: opening beyond the width [m], to choose from by free space.
        slack: (n,) required distance from everything below [m].
    """
    axis = np.stack([np.cos(strips.yaw), np.sin(strips.yaw)], axis=1)
    middle = strips.middle + axis * contacts.shift[:, None]
    opening = np.minimum(contacts.width[:, None] + np.array(spares), gripper.max_width)  # (n, s)
    reach = np.maximum(gripper.tip(contacts.width)[:, None], gripper.tip(opening))
    T = np.repeat(upright_frames(strips.yaw)[:, None], len(spares), axis=1)
    T[..., :2, 3], T[..., 2, 3] = middle[:, None], tip[:, None] + reach
    points = gripper.finger_undersides.placed(T.reshape(-1, 4, 4), opening.ravel())
    deep = heights.penetration(points, WIDER)[0].reshape(opening.shape)
    rise = np.maximum(deep + slack[:, None], 0.0)
    spare = opening - contacts.width[:, None]
    best = np.argmin(rise + _RISE_FOR_SPARE * np.abs(spare - _WANTED_SPARE), axis=1)
    at = np.arange(len(best))
    opening, reach, T, rise = opening[at, best], reach[at, best], T[at, best], rise[at, best]
    palm = gripper.palm_undersides.placed(T, opening)
    rise = np.maximum(rise, heights.penetration(palm, WIDER)[0] + slack)
    T[:, 2, 3] += rise
    return Placed(
        seed=at, label=strips.label, contacts=contacts, T_world_closing=T, middle=middle, yaw=strips.yaw,
        opening=opening, tip=tip + rise, engagement=contacts.height.min(axis=1) - tip - rise, rise=rise,
        tilt=np.zeros(len(at)), free=np.ones(len(at), bool), reach=reach)


def tilted(
    heights: HeightMap, upright: Placed, chosen: Indices, angle: float, axis: int, gripper: GripperShape, slack: Array,
    least: Array,
) -> Placed:
    """Return some grippers tilted about a point between their tips, as deep as they can be, if that is deep enough.

    Args:
        heights: of the surroundings.
        upright: grippers that were raised because something obstructs it; chosen: indices of those to tilt.
        angle: [rad]; axis: of the closing frame, 0: across, one finger becomes the lower one; 1: the closing axis.
        gripper: its shape.
        slack: (n,) required distance of each upright one from everything below [m].
        least: (n,) engagement of each upright one that is enough [m].
    """
    base = upright.select(chosen)
    T = base.T_world_closing.copy()
    R = T[:, :3, :3] @ _turn(axis, angle)
    pivot = np.column_stack([base.middle, base.tip - base.rise])
    T[:, :3, :3], T[:, :3, 3] = R, pivot - R[:, :, 2] * base.reach[:, None]
    rise, needed = np.zeros(len(chosen)), slack[chosen]
    for _ in range(_CORRECTIONS):  # along the tool, which moves it sideways, too
        deep = heights.penetration(gripper.surfaces.placed(T, base.opening), WIDER)[0]
        more = np.maximum(deep + needed, 0.0) / math.cos(angle)
        T[:, :3, 3] -= R[:, :, 2] * more[:, None]
        rise += more
        enough = np.flatnonzero(_engagement(T, base) >= least[base.seed])
        base, T, R, rise, needed = base.select(enough), T[enough], R[enough], rise[enough], needed[enough]
    left = heights.penetration(gripper.surfaces.placed(T, base.opening), WIDER)[0] + needed
    raised = rise * math.cos(angle)
    return replace(
        base, T_world_closing=T, tip=base.tip - base.rise + raised, engagement=_engagement(T, base), rise=rise,
        tilt=np.full(len(rise), abs(angle)), free=left <= _TOLERANCE)


def _engagement(T: Array, base: Placed) -> Array:
    """Return (n,) how deep the tips are below the edges, of two fingers the one that is less deep [m]."""
    aside = T[:, 2, 1] * base.contacts.width / 2
    tips = (T[:, 2, 3] + T[:, 2, 2] * base.reach)[:, None] + aside[:, None] * [-1, 1]
    return np.asarray((base.contacts.height - tips).min(axis=1))


def upright_frames(yaw: Array) -> Array:
    """Return (n, 4, 4) closing frames at the origin with z down and y along a yaw (n,) [rad] of world."""
    T = np.zeros((len(yaw), 4, 4))
    cosine, sine = np.cos(yaw), np.sin(yaw)
    T[:, 0, 0], T[:, 1, 0] = -sine, cosine
    T[:, 0, 1], T[:, 1, 1] = cosine, sine
    T[:, 2, 2], T[:, 3, 3] = -1.0, 1.0
    return T


def _turn(axis: int, angle: float) -> Array:
    """Return the (3, 3) rotation about axis 0 or 1."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]] if axis == 0 else [[c, 0, s], [0, 1, 0], [-s, 0, c]])

