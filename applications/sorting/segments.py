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

Bools = npt.NDArray[np.bool_]
Values = npt.NDArray[np.float32]
Labels = npt.NDArray[np.int32]

STEP = 0.008  # [m] difference of height within 3 x 3 cells that separates surfaces
GROOVE = 0.004  # [m] a cell this far below the mean of those on both sides is in a groove
GROOVE_REACH = 4  # [cells] to those
SAME_COLOR = 0.35  # distance of colors below which surfaces are probably of one object
STEP_OF_ONE = 0.016  # [m] step within an object of one color
GROOVE_OF_ONE = 0.8  # fraction of its border that is a groove between two objects of one color
CORE = 12  # [cells] smallest core of a segment
SMALLEST = 15  # [cells] smaller segments join a neighbor, or are noise
MAJORITY = 4.5 / 9  # of a cell and its neighbors must be cells of objects
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


def segments(mask: Bools, top: Values, colors: Colors) -> Segments:
    """Divide a mask (rows, columns) by heights (rows, columns) [m] and colors (rows, columns, 3) of `features`."""
    height = np.where(np.isfinite(top), top, np.float32(-1.0)).astype(np.float32)
    mask = _without_specks(mask)
    edges = _color_edges(colors)
    groove = _grooves(height, mask)
    cut = (_steps(height) > STEP) | edges | groove
    count, labels = cv2.connectedComponents((mask & ~cut).astype(np.uint8), connectivity=4)
    cores = _large_enough(np.asarray(labels, np.int32), count, CORE)
    grown = _grown(cores, mask, height, colors)
    return _joined(_with_leftovers(grown, mask), height, colors, groove)


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
    return np.asarray(np.sqrt((change**2).sum(axis=-1)) > 1)


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


def mean_by_label(labels: Labels, values: Values | Colors, count: int) -> npt.NDArray[np.float64]:
    """Mean (count + 1, ...) of the values of each label; that of unused labels is 0."""
    flat = labels.ravel()
    sizes = np.maximum(np.bincount(flat, minlength=count + 1), 1)
    if values.ndim == labels.ndim:
        return np.asarray(np.bincount(flat, values.ravel(), count + 1) / sizes)
    parts = [np.bincount(flat, values[..., k].ravel(), count + 1) / sizes for k in range(values.shape[-1])]
    return np.stack(parts, axis=-1)


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


@dataclass(eq=False)
class _Border:
    """The common border of two segments: its length [cells], median step [m] and fraction in grooves."""

    length: int
    step: float
    groove: float


def _borders(labels: Labels, height: Values, groove: Bools) -> dict[tuple[int, int], _Border]:
    """Return the borders of all pairs of segments; steps are measured between cells two apart from the border."""
    pairs, steps, grooves = [], [], []
    for axis in (0, 1):
        a, b = (labels[:-1], labels[1:]) if axis == 0 else (labels[:, :-1], labels[:, 1:])
        rows, columns = np.nonzero((a != b) & (a > 0) & (b > 0))
        if not len(rows):
            continue
        first, second = a[rows, columns], b[rows, columns]
        down, right = (1, 0) if axis == 0 else (0, 1)
        limit = np.array(labels.shape) - 1
        before = np.clip(rows - down, 0, limit[0]), np.clip(columns - right, 0, limit[1])
        after = np.clip(rows + 2 * down, 0, limit[0]), np.clip(columns + 2 * right, 0, limit[1])
        pairs.append(np.sort(np.column_stack([first, second]), axis=1))
        low = np.where(labels[before] == first, height[before], height[rows, columns])
        high = np.where(labels[after] == second, height[after], height[rows + down, columns + right])
        steps.append(np.abs(high - low))
        grooves.append(groove[rows, columns] | groove[rows + down, columns + right])
    if not pairs:
        return {}
    found, owner = np.unique(np.concatenate(pairs), axis=0, return_inverse=True)
    owner, step, in_groove = owner.ravel(), np.concatenate(steps), np.concatenate(grooves)
    return {
        (int(pair[0]), int(pair[1])): _Border(
            int((owner == k).sum()), float(np.median(step[owner == k])), float(in_groove[owner == k].mean()))
        for k, pair in enumerate(found)}


def _joined(labels: Labels, height: Values, colors: Colors, groove: Bools) -> Segments:
    """Join segments between which nothing separates objects, the most similar first."""
    patched: set[int] = set()
    while True:
        count = int(labels.max())
        if count == 0:
            return Segments(labels, 0, frozenset())
        sizes = np.bincount(labels.ravel(), minlength=count + 1)
        means = mean_by_label(labels, colors, count)
        perimeters = _perimeters(labels, count)
        best: tuple[float, int, int, bool] | None = None
        for (a, b), border in _borders(labels, height, groove).items():
            small, large = (a, b) if sizes[a] <= sizes[b] else (b, a)
            color = float(np.linalg.norm(means[a] - means[b]))
            alike = color < SAME_COLOR
            apart = border.step > (STEP_OF_ONE if alike else STEP) or (
                border.groove > (GROOVE_OF_ONE if alike else 0.5) and border.length > 4)
            enclosed = border.length >= ENCLOSED * perimeters[small] and sizes[small] <= PATCH * sizes[large]
            tiny = sizes[small] < SMALLEST
            if not (tiny and border.step <= 2 * STEP) and (apart or (color > 1 and not enclosed)):
                continue
            order = color + border.step / STEP
            if best is None or order < best[0]:
                best = order, small, large, color > 1 and not tiny
        if best is None:
            break
        _, small, large, other_color = best
        labels[labels == small] = large
        if other_color or small in patched:
            patched.add(large)
    return _numbered(labels, patched)


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
    sizes = np.bincount(labels.ravel())
    keep = np.flatnonzero(sizes >= SMALLEST)
    keep = keep[keep > 0]
    numbers = np.zeros(len(sizes), np.int32)
    numbers[keep] = np.arange(1, len(keep) + 1)
    renamed = frozenset(int(numbers[each]) for each in patched if numbers[each])
    return Segments(np.asarray(numbers[labels], np.int32), len(keep), renamed)
