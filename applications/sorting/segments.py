"""Divide cells of objects into segments of one object each: at steps of height, edges of color and grooves.

Cells at a step, an edge or a groove are cut out; what remains connected is the core of a segment. The cut cells then
join the core that resembles them, and cores between which there is neither a step, nor an edge, nor a groove, are
joined: a pattern on an object does not divide it if its patches are small and enclosed.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from applications.sorting.places import Colors, color_distance

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]
Values = npt.NDArray[np.float32]
Labels = npt.NDArray[np.int32]

STEP = 0.008  # [m] difference of height within 3 x 3 cells that separates surfaces
GROOVE = 0.004  # [m] a cell this far below the mean of those on both sides is in a groove
GROOVE_REACH = 4  # [cells] to those
SAME_COLOR = 0.35  # distance of colors below which surfaces are probably of one object
STEP_OF_ONE = 0.016  # [m] step within an object of one color
GROOVE_OF_TWO = 0.5  # fraction of their border that is a groove between objects
GROOVE_OF_ONE = 0.8  # fraction of its border that is a groove between two objects of one color
CORE = 12  # [cells] smallest core of a segment
SMALLEST = 15  # [cells] smaller segments join a neighbor, or are noise
MAJORITY = 4.5 / 9  # of a cell and its neighbors must be cells of objects
HYSTERESIS = 1.8  # by which limits favor the segments of the image before
SLIVER = 45  # [cells] smaller segments next to one of their color are its steep side
ALONG = 0.15  # fraction of their border there
ROUNDS = 8  # in which cut cells join the cores
ENCLOSED = 0.6  # fraction of the border of a patch that touches the segment it belongs to
PATCH = 0.35  # largest area of a patch, as a fraction of that of its segment
_AROUND = [(i, k) for i in (-1, 0, 1) for k in (-1, 0, 1) if i or k]


@dataclass(frozen=True, eq=False)
class Segments:
    """Segments of a mask.

    Attributes:
        labels: (rows, columns) 1 to `count`; 0 for none.
        count: number of segments.
        patched: labels of segments with patches of other colors.
    """

    labels: Labels
    count: int
    patched: frozenset[int]


def segments(mask: Bools, top: Values, colors: Colors, before: Labels | None = None) -> Segments:
    """Divide a mask (rows, columns) by heights (rows, columns) [m] and colors (rows, columns, 3) of `features`.

    Cells that were one segment `before` (rows, columns), in the image before, are divided only by clearer steps, edges
    and grooves, and others are joined only across smaller ones: noise does not change what is seen of a still heap.
    """
    height = np.where(np.isfinite(top), top, np.float32(-1.0)).astype(np.float32)
    mask = _without_specks(mask)
    edges = _color_edges(colors)
    groove = _grooves(height, mask)
    cut = (_steps(height) > STEP) | edges | groove
    count, labels = cv2.connectedComponents((mask & ~cut).astype(np.uint8), connectivity=4)
    cores = _large_enough(np.asarray(labels, np.int32), count, CORE)
    grown = _grown(cores, mask, height, colors)
    return _joined(_with_leftovers(grown, mask), height, colors, groove, before)


def _without_specks(mask: Bools) -> Bools:
    """Drop cells that stick out of an edge, and connected parts of fewer than `SMALLEST` cells."""
    mask = mask & (cv2.blur(mask.astype(np.float32), (3, 3), borderType=cv2.BORDER_CONSTANT) > MAJORITY)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    large = stats[:, cv2.CC_STAT_AREA] >= SMALLEST
    large[0] = False
    return np.asarray(large[labels] if count > 1 else mask & False)


def _steps(height: Values) -> Values:
    """Difference of heights within the neighbors of each cell [m]."""
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    return np.asarray(cv2.morphologyEx(height, cv2.MORPH_GRADIENT, cross), np.float32)


def _color_edges(colors: Colors) -> Bools:
    """Cells at which the color changes."""
    smooth = cv2.medianBlur(colors, 3)
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    change = cv2.morphologyEx(smooth, cv2.MORPH_GRADIENT, cross)
    return np.asarray(np.einsum("...k,...k->...", change, change) > 1)


def _grooves(height: Values, mask: Bools) -> Bools:
    """Cells of the mask that lie below those on both sides, in one of four directions."""
    h = np.where(mask, height, np.float32(-1.0))
    smooth = cv2.blur(np.where(mask, height, 0), (3, 3)) / np.maximum(cv2.blur(mask.astype(np.float32), (3, 3)), 1e-6)
    smooth = np.where(mask, smooth, h).astype(np.float32)
    found = np.zeros(mask.shape, bool)
    n = GROOVE_REACH
    padded = np.pad(smooth, n, constant_values=-1.0)
    rows, columns = mask.shape
    for i, k in ((0, 1), (1, 0), (1, 1), (1, -1)):
        a = padded[n + i * n : n + i * n + rows, n + k * n : n + k * n + columns]
        b = padded[n - i * n : n - i * n + rows, n - k * n : n - k * n + columns]
        found |= np.minimum(a, b) - smooth > GROOVE
    return found & mask


def _large_enough(labels: Labels, count: int, least: int) -> Labels:
    """Renumber components, without those of fewer than `least` cells."""
    sizes = np.bincount(labels.ravel(), minlength=count)
    keep = sizes >= least
    keep[0] = False
    numbers = np.zeros(count, np.int32)
    numbers[keep] = np.arange(1, int(keep.sum()) + 1)
    return np.asarray(numbers[labels], np.int32)


def mean_by_label(labels: Labels, values: Colors, count: int) -> Array:
    """Mean (count + 1, k) of the values (rows, columns, k) of each label; that of unused labels is 0."""
    used = labels > 0
    flat, chosen = labels[used], values[used]
    sizes = np.maximum(np.bincount(flat, minlength=count + 1), 1)
    return np.stack([np.bincount(flat, chosen[:, k], count + 1) / sizes for k in range(values.shape[-1])], axis=-1)


def _grown(labels: Labels, mask: Bools, height: Values, colors: Colors) -> Labels:
    """Let cells without a label join the neighboring segment whose height and color are the most similar."""
    count = int(labels.max())
    if count == 0:
        return labels
    means = mean_by_label(labels, colors, count).astype(np.float32)
    grown, level = np.pad(labels, 1), np.pad(height, 1)
    inner = grown[1:-1, 1:-1]
    for _ in range(ROUNDS):
        rows, columns = np.nonzero(mask & (inner == 0))
        if not len(rows):
            break
        best, chosen = np.full(len(rows), np.inf, np.float32), np.zeros(len(rows), np.int32)
        for i, k in _AROUND:
            other = grown[rows + 1 + i, columns + 1 + k]
            step = np.abs(level[rows + 1 + i, columns + 1 + k] - height[rows, columns])
            cost = step / STEP + color_distance(means[other], colors[rows, columns])
            better = (other > 0) & (cost < best)
            best, chosen = np.where(better, cost, best), np.where(better, other, chosen)
        inner[rows, columns] = chosen
        if not chosen.any():
            break
    return np.ascontiguousarray(inner)


def _with_leftovers(labels: Labels, mask: Bools) -> Labels:
    """Give connected cells that joined no segment a label of their own."""
    count, parts, stats, _ = cv2.connectedComponentsWithStats((mask & (labels == 0)).astype(np.uint8), connectivity=8)
    result, following = labels.copy(), int(labels.max()) + 1
    for part in range(1, count):
        if stats[part, cv2.CC_STAT_AREA] >= SMALLEST:
            result[parts == part] = following
            following += 1
    return result


@dataclass(frozen=True, eq=False)
class _Sides:
    """Sides of cells between two segments: their labels (n, 2), the smaller first, and step [m] and groove (n,)."""

    labels: npt.NDArray[np.int64]
    step: Values
    groove: Bools


def _sides(labels: Labels, height: Values, groove: Bools) -> _Sides:
    """Return all sides between segments; steps are measured between cells two apart from the border."""
    pairs, steps, grooves = [np.empty((0, 2), np.int64)], [np.empty(0, np.float32)], [np.empty(0, bool)]
    limit = np.array(labels.shape) - 1
    for down, right in ((1, 0), (0, 1)):
        a, b = labels[: limit[0] + 1 - down, : limit[1] + 1 - right], labels[down:, right:]
        rows, columns = np.nonzero((a != b) & (a > 0) & (b > 0))
        first, second = a[rows, columns], b[rows, columns]
        before = np.maximum(rows - down, 0), np.maximum(columns - right, 0)
        after = np.minimum(rows + 2 * down, limit[0]), np.minimum(columns + 2 * right, limit[1])
        low = np.where(labels[before] == first, height[before], height[rows, columns])
        high = np.where(labels[after] == second, height[after], height[rows + down, columns + right])
        pairs.append(np.sort(np.column_stack([first, second]), axis=1).astype(np.int64))
        steps.append(np.abs(high - low))
        grooves.append(groove[rows, columns] | groove[rows + down, columns + right])
    return _Sides(np.concatenate(pairs), np.concatenate(steps), np.concatenate(grooves))


def _joined(labels: Labels, height: Values, colors: Colors, groove: Bools, before: Labels | None) -> Segments:
    """Join segments between which nothing separates objects, the most similar first."""
    count = int(labels.max())
    if count == 0:
        return Segments(labels, 0, frozenset())
    sizes = np.bincount(labels.ravel(), minlength=count + 1).astype(float)
    means = mean_by_label(labels, colors, count)
    perimeters = _perimeters(labels, count).astype(float)
    sides = _sides(labels, height, groove)
    earlier = _majority(labels, before, count)
    now = np.arange(count + 1)  # label that each one has become
    patched: set[int] = set()
    while len(sides.labels):
        best = _most_similar(sides, sizes, means, perimeters, earlier)
        if best is None:
            break
        small, large, length, other_color = best
        now[now == small] = large
        total = sizes[small] + sizes[large]
        means[large] = (sizes[small] * means[small] + sizes[large] * means[large]) / total
        sizes[large], sizes[small] = total, 0
        perimeters[large] += perimeters[small] - 2 * length
        if other_color or small in patched:
            patched.add(large)
        renamed = np.sort(now[sides.labels], axis=1)
        left = renamed[:, 0] != renamed[:, 1]
        sides = _Sides(renamed[left], sides.step[left], sides.groove[left])
    return _numbered(np.asarray(now[labels], np.int32), patched)


def _most_similar(
    sides: _Sides, sizes: Array, means: Array, perimeters: Array, earlier: npt.NDArray[np.int64]
) -> tuple[int, int, int, bool] | None:
    """Return the two segments to join next, the smaller first, their common sides, and whether colors differ."""
    keys = sides.labels[:, 0] * len(sizes) + sides.labels[:, 1]
    order = np.argsort(keys, kind="stable")
    starts = np.flatnonzero(np.diff(keys[order], prepend=-1))
    best: tuple[float, tuple[int, int, int, bool]] | None = None
    for own in np.split(order, starts[1:]):
        a, b = (int(each) for each in sides.labels[own[0]])
        small, large = (a, b) if sizes[a] <= sizes[b] else (b, a)
        step, grooved, length = float(np.median(sides.step[own])), float(sides.groove[own].mean()), len(own)
        color = float(np.linalg.norm(means[a] - means[b]))
        factor = 1.0 if not earlier[a] or not earlier[b] else HYSTERESIS if earlier[a] == earlier[b] else 1 / HYSTERESIS
        alike, tiny = color < SAME_COLOR * factor, sizes[small] < SMALLEST
        apart = step > (STEP_OF_ONE if alike else STEP) * factor or (
            grooved > (GROOVE_OF_ONE if alike else GROOVE_OF_TWO) * factor and length > 4)
        enclosed = length >= ENCLOSED * perimeters[small] and sizes[small] <= PATCH * sizes[large]
        sliver = alike and sizes[small] < SLIVER and length >= ALONG * perimeters[small]
        if (tiny and step <= 2 * STEP) or sliver or (not apart and (color <= factor or enclosed)):
            order_of = color + step / STEP
            if best is None or order_of < best[0]:
                best = order_of, (small, large, length, color > 1 and not tiny)
    return None if best is None else best[1]


def _majority(labels: Labels, before: Labels | None, count: int) -> npt.NDArray[np.int64]:
    """Return (count + 1,) the segment of the image before that covers most of each label; 0 for none."""
    if before is None:
        return np.zeros(count + 1, np.int64)
    both = (labels > 0) & (before > 0)
    width = int(before.max(initial=0)) + 1
    votes = np.bincount(labels[both].astype(np.int64) * width + before[both], minlength=(count + 1) * width)
    table = votes.reshape(count + 1, width)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    return np.asarray(np.where(table.max(axis=1) > 0.5 * sizes, table.argmax(axis=1), 0))


def _perimeters(labels: Labels, count: int) -> npt.NDArray[np.int64]:
    """Number of cell sides on the border of each label."""
    padded = np.pad(labels, 1)
    total = np.zeros(count + 1, np.int64)
    for a, b in ((padded[:-1], padded[1:]), (padded[:, :-1], padded[:, 1:])):
        differ = a != b
        total += np.bincount(a[differ], minlength=count + 1) + np.bincount(b[differ], minlength=count + 1)
    return total


def _numbered(labels: Labels, patched: set[int]) -> Segments:
    """Drop segments of fewer than `SMALLEST` cells and number the others from 1."""
    sizes = np.bincount(labels.ravel(), minlength=max(patched, default=0) + 1)  # patched ones may have been joined
    keep = np.flatnonzero(sizes >= SMALLEST)
    keep = keep[keep > 0]
    numbers = np.zeros(len(sizes), np.int32)
    numbers[keep] = np.arange(1, len(keep) + 1)
    renamed = frozenset(int(numbers[each]) for each in patched if numbers[each])
    return Segments(np.asarray(numbers[labels], np.int32), len(keep), renamed)
