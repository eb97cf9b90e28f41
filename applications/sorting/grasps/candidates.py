"""Grasp candidates on a surface: two fingers on opposite edges of one object, with free space for fingers and palm."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from applications.sorting.grasps.contacts import Contacts, Strips
from applications.sorting.grasps.edges import Outlines, seeds
from applications.sorting.grasps.gripper_shape import GripperShape
from applications.sorting.grasps.height_map import HeightMap, Labels, Walls
from applications.sorting.grasps.placement import Placed, lowered, tilted
from applications.sorting.grasps.scoring import FEATURES, GeometricScorer, Scorer
from applications.sorting.surface import Surface
from common.config.basics import Section
from common.robot.transforms import invert

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_BELOW_EDGE = 0.012  # [m] that tips reach below the visible edge of an object, if they can,
_ROUND_SHARE = 0.5  # and more by this share of the height from edge to top: a ball is widest below the edge
_PALM_GAP = 0.003  # [m] between the palm and the top of the object
_BLOCKED, _DEEP = 0.003, 0.015  # [m] too high and less deep: a tilted gripper may reach deeper
_ENOUGH = 4  # upright grasps of an object that are so deep: no tilted ones are looked for
_FLAT = 0.012  # [m] height of an object that needs the tips nearer to the floor


class Options(Section):
    """What a candidate must fulfil, and how many there are."""

    depth: float = Field(0.028, gt=0, le=0.1, description="of the finger tips below the top of the object [m]")
    slack: float = Field(0.003, ge=0, le=0.02, description="of fingers and palm from everything below them [m]")
    flat_slack: float = Field(0.002, ge=0, le=0.02, description="the same for objects lower than 12 mm [m]")
    spares: tuple[float, ...] = Field((0.008, 0.014, 0.020, 0.026), min_length=1,
                                      description="opening beyond the width of the object [m]")
    tilts: tuple[float, ...] = Field((0.26, 0.52), description="of the tool, both ways about both axes [rad]")
    alignment: float = Field(0.75, ge=0, le=1, description="least cosine between closing axis and an edge's direction")
    purity: float = Field(0.9, ge=0, le=1, description="least fraction of one object in what is between the fingers")
    engagement: float = Field(0.008, gt=0, le=0.05, description="least of the tips below an edge [m]; less if flat")
    for_each: int = Field(40, ge=1, le=300, description="pairs of edges of each object that are examined")
    tilted_for_each: int = Field(8, ge=0, le=300, description="of these, how many are tilted if they are obstructed")
    limit: int = Field(300, ge=1, le=3000, description="most candidates")
    apart: float = Field(0.010, ge=0, le=0.1, description="candidates of an object are this far apart [m], or")
    turned: float = Field(0.26, ge=0, le=1.6, description="turned by this [rad]")


@dataclass(frozen=True, eq=False)
class Candidates:
    """Grasps as a struct of arrays, the best first.

    Attributes:
        T: (n, 4, 4) T_world_tcp while gripping.
        width: (n,) between the contacts; opening: of the fingers on the way [m].
        object: (n,) index of the object: its label less 1.
        features: (n, k) in the order of `names`.
        score: (n,) 0 to 1, parts: of the score.
        contacts: (n, 2, 3) where the fingers meet the object [m], world.
        heights: the map on which they were found.
        reasons: why an object (index) has no candidates.
        names: of the features.
    """

    T: Array
    width: Array
    opening: Array
    object: Indices
    features: Array
    score: Array
    parts: dict[str, Array]
    contacts: Array
    heights: HeightMap
    reasons: dict[int, str] = field(default_factory=dict)
    names: tuple[str, ...] = FEATURES

    def __len__(self) -> int:
        """Return the number of candidates."""
        return len(self.width)

    def select(self, chosen: Indices) -> Candidates:
        """Return some candidates, in a given order."""
        parts = {name: values[chosen] for name, values in self.parts.items()}
        return Candidates(self.T[chosen], self.width[chosen], self.opening[chosen], self.object[chosen],
                          self.features[chosen], self.score[chosen], parts, self.contacts[chosen], self.heights,
                          self.reasons)

    def ranked(self, score: Array) -> Candidates:
        """Return the candidates with other scores (n,), the best first."""
        return replace(self, score=score).select(np.argsort(-score, kind="stable"))

    def axis(self, gripper: GripperShape) -> Array:
        """Return (n, 3) unit vectors along which the fingers close, world."""
        return np.asarray(self.T[:, :3, :3] @ gripper.T_tcp_closing[:3, 1])


def candidates(
    surface: Surface, labels: Labels, gripper: GripperShape, options: Options, rng: np.random.Generator,
    walls: Sequence[Walls] = (), scorer: Scorer = GeometricScorer(),  # noqa: B008
) -> Candidates:
    """Return grasps for all objects of a surface, the best first, and why an object has none.

    Args:
        surface: heights of the tray seen from above.
        labels: (rows, columns) int32, 0 for none, k for the object with index k - 1.
        gripper: its shape.
        options: limits.
        rng: chooses among many edges.
        walls: of the tray.
        scorer: of features.
    """
    heights = HeightMap(surface, labels, walls)
    outlines = Outlines.of(heights)
    present = np.unique(heights.labels[heights.labels > 0]).astype(np.int64)
    reasons = dict.fromkeys((present - 1).tolist(), "no free edge")
    widest = gripper.max_width - options.spares[0]
    lines = seeds(heights, outlines, widest, rng)
    strips = Strips.of(heights, lines, gripper.pad_half_width, widest, gripper.finger_thickness)
    _explain(reasons, lines.label, f"wider than the {1e3 * widest:.0f} mm between open fingers", present, heights)
    tip, contacts = _depths(strips, outlines, gripper, options)
    usable = contacts.found & (contacts.width <= widest) & (contacts.purity >= options.purity)
    usable &= contacts.alignment.min(axis=1) >= options.alignment
    _mark(reasons, lines.label, "no two opposite edges that fingers could hold")
    _mark(reasons, lines.label[usable], "no free space for the fingers or the palm")
    centers = _centers(heights)
    chosen = _promising(usable, contacts, tip, strips, centers, options)
    placed = _placed(heights, strips.select(chosen), tip[chosen], contacts.select(chosen), gripper, options)
    found = _assembled(heights, placed, centers, gripper, scorer)
    selected = _diverse(found, gripper, options)
    result = found.select(selected)
    for index in np.unique(result.object).tolist():
        reasons.pop(index, None)
    return replace(result, reasons=reasons)


def _mark(reasons: dict[int, str], labels: Indices, reason: str) -> None:
    for label in np.unique(labels).tolist():
        reasons[label - 1] = reason


def _explain(
    reasons: dict[int, str], labels: Indices, reason: str, present: Indices, heights: HeightMap
) -> None:
    """Give a reason to objects without any seed though they are seen from all sides."""
    for label in np.setdiff1d(present, labels).tolist():
        rows, columns = np.nonzero(heights.labels == label)
        if min(np.ptp(rows), np.ptp(columns)) * heights.step > 0:
            reasons[label - 1] = reason


def _depths(
    strips: Strips, outlines: Outlines, gripper: GripperShape, options: Options
) -> tuple[Array, Contacts]:
    """Return (n,) z of the tips [m] where nothing obstructs, and the contacts there."""
    top = np.where(np.isfinite(strips.top), strips.top, strips.floor)
    flat = top - strips.floor < _FLAT
    lowest = strips.floor + np.where(flat, options.flat_slack, options.slack)
    tip = np.maximum(top - options.depth, lowest)
    edge = strips.contacts(tip, outlines).height.min(axis=1)
    edge = np.where(np.isfinite(edge), edge, top)
    wanted = np.minimum(top - options.depth, edge - _BELOW_EDGE - _ROUND_SHARE * (top - edge))
    tip = np.maximum(np.maximum(wanted, top + _PALM_GAP - gripper.finger_length), lowest)
    return tip, strips.contacts(tip, outlines)


def _centers(heights: HeightMap) -> Array:
    """Return (labels + 1, 2) the mean position of each object's cells, world [m]."""
    cells = np.flatnonzero(heights.labels)
    owner = heights.labels.ravel()[cells]
    count = np.maximum(np.bincount(owner), 1)
    columns = heights.labels.shape[1]
    means = [np.bincount(owner, each) / count for each in (cells % columns, cells // columns)]
    return np.asarray(heights.origin + heights.step * (np.stack(means, axis=1) + 0.5))


def _aside(yaw: Array, middle: Array, center: Array) -> Array:
    """Return (n,) distance of a center from the line through a middle [m]."""
    away = center - middle
    return np.abs(away[:, 0] * np.sin(yaw) - away[:, 1] * np.cos(yaw))


def _promising(
    usable: NDArray[np.bool_], contacts: Contacts, tip: Array, strips: Strips, centers: Array, options: Options
) -> Indices:
    """Return the indices of the best usable seeds of each object."""
    engagement = np.clip((contacts.height.min(axis=1) - tip) / 0.025, 0, 1)
    aside = np.clip(_aside(strips.yaw, strips.middle, centers[strips.label]) / 0.03, 0, 1)
    rough = 1.5 * engagement - aside + 4 * contacts.alignment.mean(axis=1) + 0.5 * contacts.extent
    order = np.argsort(-rough, kind="stable")
    order = order[usable[order]]
    return _first(order, strips.label, options.for_each)


def _first(order: Indices, label: Indices, count: int) -> Indices:
    """Return the first few indices of each label (n,)."""
    return np.asarray(order[_rank(label[order]) < count])


def _rank(label: Indices) -> Indices:
    """Return (n,) how many equal labels are before each."""
    rank = np.zeros(len(label), int)
    for each in np.unique(label).tolist():
        own = label == each
        rank[own] = np.arange(int(own.sum()))
    return rank


def _placed(
    heights: HeightMap, strips: Strips, tip: Array, contacts: Contacts, gripper: GripperShape, options: Options
) -> Placed:
    """Return the poses of promising seeds that are free, upright and tilted ones."""
    flat = contacts.height.max(axis=1) - heights.floor < _FLAT
    slack = np.where(flat, options.flat_slack, options.slack)
    upright = lowered(heights, strips, tip, contacts, gripper, options.spares, slack)
    high = contacts.height.min(axis=1) - heights.floor
    least = np.minimum(options.engagement, 0.4 * high)
    blocked = _blocked(upright, least, options)
    tilts = [tilted(heights, upright, blocked, angle, axis, gripper, slack, least)
             for size in options.tilts for angle in (size, -size) for axis in (0, 1)] if len(blocked) else []
    every = Placed.joined([upright, *tilts])
    selected = every.select(np.flatnonzero(every.free & (every.engagement >= least[every.seed])))
    return selected.select(np.flatnonzero(
        ~strips.select(selected.seed).obstructed(selected.contacts, selected.opening, selected.tip)))


def _blocked(upright: Placed, least: Array, options: Options) -> Indices:
    """Return indices of grippers to tilt: of objects with few free upright grasps, those that something holds up."""
    deep = np.bincount(upright.label, upright.engagement >= np.maximum(least, _DEEP))
    held_up = (upright.rise > _BLOCKED) & (upright.engagement < _DEEP) & (deep[upright.label] < _ENOUGH)
    return _first(np.flatnonzero(held_up), upright.label, options.tilted_for_each)


def _assembled(
    heights: HeightMap, placed: Placed, centers: Array, gripper: GripperShape, scorer: Scorer
) -> Candidates:
    """Return placed grasps with features and scores, the best first."""
    contacts, yaw = placed.contacts, placed.yaw
    alignment = np.sort(contacts.alignment, axis=1)
    features = np.column_stack([
        placed.engagement, _aside(yaw, placed.middle, centers[placed.label]), alignment, placed.slack(heights, gripper),
        placed.tilt, placed.opening - contacts.width, contacts.width, placed.tip - heights.floor, contacts.extent,
        contacts.roughness, contacts.purity])
    T = placed.T_world_closing @ invert(gripper.T_tcp_closing)
    axis = placed.T_world_closing[:, :3, 1]
    middle = np.column_stack([placed.middle, (placed.tip + contacts.height.min(axis=1)) / 2])
    sides = middle[:, None] + axis[:, None] * (contacts.width[:, None] / 2 * [-1, 1])[:, :, None]
    score = scorer.score(features)
    found = Candidates(
        T, contacts.width, placed.opening, placed.label - 1, features, score, scorer.parts(features), sides, heights)
    return found.ranked(score)


def _diverse(found: Candidates, gripper: GripperShape, options: Options) -> Indices:
    """Return indices of candidates that differ from better ones of the same object, at most `limit`."""
    position, axis = found.T[:, :3, 3], found.axis(gripper)
    down = found.T[:, :3, 2]
    selected: list[int] = []
    for label in np.unique(found.object).tolist():
        left = np.flatnonzero(found.object == label)
        while len(left):
            best, left = left[0], left[1:]
            selected.append(int(best))
            near = np.linalg.norm(position[left] - position[best], axis=1) < options.apart
            near &= np.abs(axis[left] @ axis[best]) > math.cos(options.turned)
            near &= down[left] @ down[best] > math.cos(options.turned)
            left = left[~near]
    order = np.sort(np.array(selected, int))
    if len(order) <= options.limit:
        return order
    first = np.argsort(_rank(found.object[order]), kind="stable")  # none is left without any
    return np.sort(order[first[:options.limit]])
