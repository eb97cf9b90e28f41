"""Where fingers that close along a line meet an object: heights in a strip as wide as the finger tips."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from applications.sorting.grasps.edges import Outlines, Seeds
from applications.sorting.grasps.height_map import HeightMap, Labels

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

LINES = np.array([-0.8, -0.4, 0.0, 0.4, 0.8])  # of the strip, in half widths of a finger tip
ABOVE_TIPS = 0.003  # [m] what is lower cannot be between the fingers; a third of their depth for flat objects
OPEN = 0.4  # least fraction of the lines on which a side must be an edge: else something else touches it
BLUR = 1.5  # cells next to a contact that may still show the object
_RIM = 3  # cells inside an edge in which the height of the contact is measured


@dataclass(frozen=True, eq=False)
class Strips:
    """Heights and labels about seeds (n), on lines (5) across the finger tips, at positions (m) along the closing axis.

    Attributes:
        along: (m,) from the middle of the seed [m].
        height: (n, 5, m) [m]; own: whether the cell belongs to the seed's object, near the seed; other: to another one.
        cells: (n, 5, m) flat indices on the map.
        yaw, middle, label: of the seeds; floor: z of the floor [m].
    """

    along: Array
    height: NDArray[np.float32]
    own: Mask
    other: Mask
    cells: NDArray[np.int64]
    yaw: Array
    middle: Array
    label: NDArray[np.int64]
    floor: float

    @classmethod
    def of(cls, heights: HeightMap, seeds: Seeds, half_width: float, widest: float, beyond: float) -> Strips:
        """Sample the map about seeds.

        Args:
            heights: the map; seeds: lines along which fingers close.
            half_width: of a finger tip [m].
            widest: most distance of contacts [m].
            beyond: the seed's edges the object's own edges are looked for [m]: no finger fits into less.
        """
        reach = widest / 2 + beyond
        along = np.arange(-reach, reach + 1e-9, heights.step)
        axis = np.stack([np.cos(seeds.yaw), np.sin(seeds.yaw)], axis=1)
        across = np.stack([-axis[:, 1], axis[:, 0]], axis=1)
        offset = half_width * LINES[:, None]
        x, y = (
            (seeds.middle[:, k, None, None] + axis[:, k, None, None] * along + across[:, k, None, None] * offset)
            for k in range(2))
        cells = heights.index(x.astype(np.float32), y.astype(np.float32))
        labels: Labels = heights.labels.ravel()[cells]
        near = np.abs(along) <= seeds.width[:, None, None] / 2 + beyond
        own = (labels == seeds.label[:, None, None]) & near
        other = (labels > 0) & (labels != seeds.label[:, None, None])
        height = np.asarray(heights.height.ravel()[cells], np.float32)
        return cls(along, height, own, other, cells, seeds.yaw, seeds.middle, seeds.label,
                   heights.floor)

    def select(self, chosen: NDArray[np.int64] | Mask) -> Strips:
        """Return the strips of some seeds."""
        return Strips(self.along, self.height[chosen], self.own[chosen], self.other[chosen], self.cells[chosen],
                      self.yaw[chosen], self.middle[chosen], self.label[chosen], self.floor)

    @property
    def top(self) -> Array:
        """(n,) z of the highest point of the object in the strip [m]; -inf without any."""
        return np.asarray(np.where(self.own, self.height, -np.inf).max(axis=(1, 2)), float)

    def contacts(self, tip: Array, outlines: Outlines) -> Contacts:
        """Return where fingers with tips at z (n,) [m] meet the object."""
        least = (tip + np.clip((self.top - tip) / 3, 0.0, ABOVE_TIPS))[:, None, None]
        between: Mask = self.own & (self.height > least)
        used: Mask = np.asarray(between.any(axis=2))  # (n, 5)
        first = np.where(used, between.argmax(axis=2), 0)
        last = np.where(used, len(self.along) - 1 - between[:, :, ::-1].argmax(axis=2), 0)
        low = np.where(used, self.along[first], np.inf)
        high = np.where(used, self.along[last], -np.inf)
        low_end, high_end = low.min(axis=1), high.max(axis=1)
        found = np.isfinite(low_end) & (high_end > low_end)
        low_end, high_end = np.where(found, low_end, 0.0), np.where(found, high_end, 0.0)
        step = self.along[1] - self.along[0]
        axis = np.stack([np.cos(self.yaw), np.sin(self.yaw)], axis=1)
        sides = [self._side(index, used, axis * sign, outlines) for index, sign in ((first, -1), (last, 1))]
        inside = (self.along >= low_end[:, None] - step / 2) & (self.along <= high_end[:, None] + step / 2)
        strange = self.other & (self.height > least) & inside[:, None]
        own, others = between.sum(axis=(1, 2)), strange.sum(axis=(1, 2))
        return Contacts(
            found=found,
            shift=(low_end + high_end) / 2,
            width=high_end - low_end + step,
            height=np.stack([self._rim(first, used, 1), self._rim(last, used, -1)], axis=1),
            alignment=np.stack(sides, axis=1),
            extent=used.mean(axis=1),
            roughness=np.maximum(_spread(low, used), _spread(high, used)),
            purity=own / np.maximum(own + others, 1),
        )

    def obstructed(self, contacts: Contacts, opening: Array, tip: Array) -> Mask:
        """Return (n,) whether anything is between open fingers with tips at z (n,) [m] and their contacts."""
        step = self.along[1] - self.along[0]
        away = np.abs(self.along - contacts.shift[:, None])
        closing = (away > contacts.width[:, None] / 2 + BLUR * step) & (away < opening[:, None] / 2)
        return np.asarray((closing[:, None] & (self.height > tip[:, None, None] + ABOVE_TIPS)).any(axis=(1, 2)))

    def _rim(self, index: NDArray[np.int64], used: Mask, inwards: int) -> Array:
        """Return (n,) the height of the object just inside its edge [m], the median of the lines that meet it."""
        highest = np.full(index.shape, -np.inf)
        for deeper in range(_RIM):
            at = np.clip(index + inwards * deeper, 0, len(self.along) - 1)[:, :, None]
            height = np.where(np.take_along_axis(self.own, at, 2), np.take_along_axis(self.height, at, 2), -np.inf)
            highest = np.maximum(highest, height[:, :, 0])
        count = np.maximum(used.sum(axis=1), 1)
        ranked = np.sort(np.where(used, highest, np.inf), axis=1)
        return np.asarray(np.take_along_axis(ranked, ((count - 1) // 2)[:, None], 1)[:, 0])

    def _side(
        self, index: NDArray[np.int64], used: Mask, outwards: Array, outlines: Outlines
    ) -> Array:
        """Return (n,) the mean cosine between closing axis and edge direction on the lines; 0 without an edge."""
        cells = np.take_along_axis(self.cells, index[:, :, None], 2)[:, :, 0]
        count = np.maximum(used.sum(axis=1), 1)
        is_open = (outlines.edge.ravel()[cells] & used).sum(axis=1) >= OPEN * count
        cosine = (outlines.normal.reshape(-1, 2)[cells] * outwards[:, None]).sum(axis=2)
        mean = np.where(used, np.clip(cosine, 0.0, 1.0), 0.0).sum(axis=1) / count
        return np.asarray(np.where(is_open, mean, 0.0))


@dataclass(frozen=True, eq=False)
class Contacts:
    """Contacts of fingers with an object.

    Attributes:
        found: (n,) whether there are any.
        shift: (n,) of their middle from the seed's, along the closing axis; width: (n,) between them [m].
        height: (n, 2) z of the object just inside each edge [m].
        alignment: (n, 2) mean cosine between closing axis and direction of each edge.
        extent: (n,) fraction of the finger tips' width that meets the object.
        roughness: (n,) how unevenly the edges meet the finger tips [m].
        purity: (n,) fraction of what is between the fingers that is the object.
    """

    found: Mask
    shift: Array
    width: Array
    height: Array
    alignment: Array
    extent: Array
    roughness: Array
    purity: Array

    def select(self, chosen: NDArray[np.int64]) -> Contacts:
        """Return some of them."""
        return Contacts(**{name: values[chosen] for name, values in vars(self).items()})

    @classmethod
    def joined(cls, several: Sequence[Contacts]) -> Contacts:
        """Return all of several."""
        return cls(**{name: np.concatenate([getattr(each, name) for each in several]) for name in vars(several[0])})


def _spread(ends: Array, used: Mask) -> Array:
    """Return (n,) the standard deviation of ends (n, 5) [m] on the lines that meet the object."""
    count = np.maximum(used.sum(axis=1), 1)
    values = np.where(used, ends, 0.0)
    mean = values.sum(axis=1) / count
    return np.asarray(np.sqrt((np.where(used, values - mean[:, None], 0.0) ** 2).sum(axis=1) / count))
