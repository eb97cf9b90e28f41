"""Find the outline of an object's top face from its contour and the depth image.

A camera above sees the walls that face its axis, so the contour is that of top and walls together. Depth gives the
height of the top face (the highest plateau within the contour) and of the support. Where an edge faces away from the
axis, the contour is the edge of the top. Where it faces the axis and the wall is upright, the contour is the foot of
that wall, which has the x and y of the edge above it. In between, the contour follows upright edges, which are single
points of the outline: those parts are left out.

The result must follow the edge of the plateau. If it does not (sloping or overhanging walls, stacked objects), the edge
of the plateau itself is used, to the pixel.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import Field

from applications.outlining.contours import normals
from common.config import Parameters, Tunable
from common.perception.depth import Depth, DepthError, Rays, is_valid
from common.perception.pinhole import Pinhole

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

CORNER = 3.0  # narrower gaps are closed by a straight line [px]
UNSURE = 2  # unused points at each end of a gap, where the contour is rounded
RUN = 12  # points for the direction of an end
BOW = 0.6  # ends that turn by less than this [rad] are joined by a curve
ASTRAY = 1.5  # largest distance of a bridge from the edge of the plateau [px]
LONGEST = 1.5  # ends are extended by at most this many widths of the gap


def joined(points: Array, contour: Array, is_foot: Bools, pixel: float, edge: Array) -> Array:
    """Close the gaps of an outline between parts seen as foot and parts seen as top.

    A straight line closes the gap of a left-out upright edge. In a notch, however, the top on one side can occlude the
    foot of the other, so that both ends stop before they meet: the contour is much shorter there than the gap. Then
    both are extended, to a corner if they meet at an angle, else along a curve. A bridge that does not follow the edge
    of the plateau is replaced by that part of the edge.

    Args:
        points: outline (n, 3) [m].
        contour: pixel of each point (n, 2) [px].
        is_foot: whether it was seen as foot (n,).
        pixel: size of a pixel at the top [m].
        edge: of the plateau (m, 3) [m].
    """
    count = len(points)
    after = np.roll(np.arange(count), -1)
    gap = np.linalg.norm(points[after] - points, axis=1) / pixel
    seen = np.linalg.norm(contour[after] - contour, axis=1)
    unsure = np.zeros(count, bool)
    bridges: dict[int, Array] = {}
    for end in np.flatnonzero((is_foot != is_foot[after]) & (gap > CORNER)):
        start = int(after[end])
        bridge: Array | None = np.empty((0, 3))
        if seen[end] < gap[end] / 2 and count > 4 * RUN:
            bridge = _bridge(points[(end - UNSURE - np.arange(RUN)) % count],
                             points[(start + UNSURE + np.arange(RUN)) % count])
            unsure[[*((end - np.arange(UNSURE)) % count), *((start + np.arange(UNSURE)) % count)]] = True
        first, last = points[end], points[start]
        if bridge is None or _farthest(np.vstack([first, bridge, last]), edge, pixel) > ASTRAY:
            bridge = _along(edge, first, last)
        bridges[int(end)] = bridge
    pieces = [part for i in range(count) for part in (points[i : i + 1][~unsure[i : i + 1]], bridges.get(i)) if
              part is not None]
    return np.concatenate(pieces)


def _farthest(line: Array, edge: Array, pixel: float) -> float:
    """Return the largest distance of a line (n, 3) [m] from an edge (m, 3) [m] [px]; infinite if far longer."""
    if np.linalg.norm(np.diff(line, axis=0), axis=1).sum() > 2 * (len(edge) + RUN) * pixel:
        return math.inf
    parts = [a + (b - a) * np.linspace(0, 1, 2 + int(np.linalg.norm(b - a) / pixel))[:, None]
             for a, b in itertools.pairwise(line)]
    distances = np.linalg.norm(np.concatenate(parts)[:, None] - edge, axis=2).min(axis=1)
    return float(distances.max()) / pixel


def _along(edge: Array, first: Array, last: Array) -> Array:
    """Return the shorter part of a closed edge (m, 3) between two points near it."""
    i, j = (int(np.argmin(np.linalg.norm(edge - point, axis=1))) for point in (first, last))
    forth = (i + np.arange((j - i) % len(edge) + 1)) % len(edge)
    back = (i - np.arange((i - j) % len(edge) + 1)) % len(edge)
    return np.asarray(edge[forth if len(forth) <= len(back) else back])


def _bridge(before: Array, behind: Array) -> Array | None:
    """Return points (k, 3) that join two runs (n, 3), each starting at the gap; None if they do not meet."""
    (a, u), (b, v) = _end(before), _end(behind)
    cross = float(u[0] * v[1] - u[1] * v[0])
    if abs(cross) < 0.05:
        return None
    s, t = float((b - a)[0] * v[1] - (b - a)[1] * v[0]) / cross, float((b - a)[0] * u[1] - (b - a)[1] * u[0]) / cross
    if not (0 < s < LONGEST * np.linalg.norm(b - a) and 0 < t < LONGEST * np.linalg.norm(b - a)):
        return None
    corner = a + s * u
    if u @ v > -math.cos(BOW):
        flat = corner[None, :]
    else:  # a parabola tangent to both (Bezier curve of degree 2)
        steps = np.linspace(0, 1, 12)[1:-1, None]
        flat = (1 - steps) ** 2 * a + 2 * steps * (1 - steps) * corner + steps**2 * b
    return np.column_stack([flat, np.full(len(flat), before[0, 2])])


def _end(run: Array) -> tuple[Array, Array]:
    """Return the first point (2,) of a run (n, 3) and the unit direction (2,) that extends it."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(run[:, :2], axis=0), axis=1))])
    fit = np.polynomial.polynomial.polyfit(along, run[:, :2], 2)
    return fit[0], -fit[1] / max(float(np.linalg.norm(fit[1])), 1e-12)


Mask = npt.NDArray[np.uint8]

MARGIN = 12  # around a contour [px]
AROUND = 4  # width of the ring around a hole that is evaluated [px]
INWARDS = 0.75  # from a point of a sub-pixel contour to the next pixel of the object [px]
OUTSIDE = 3.0  # distance from the contour at which the height around an object is measured [px]
FRAYED = 2  # pattern-based depth cameras lose this much at an edge [px]; neighboring pixels replace it
HIGHEST = 98  # percentile of the heights within a contour that lies on the top face
SHORT = 0.3  # shorter visible upright edges are ignored [px]
SQUARE = np.ones((3, 3), np.uint8)


class TopFaceOptions(Parameters):
    """How the top face is found."""

    top_tolerance: Tunable[float] = Field(
        0.002, gt=0, le=0.1, description="heights that differ by less are one face [m]; grows with the depth's noise"
    )
    max_invalid: Tunable[float] = Field(0.05, ge=0, le=1, description="part of a contour that may lack depth nearby")
    rounding: Tunable[float] = Field(
        0.0, ge=0, le=0.1, description="points are rounded to multiples of this [m]; 0: not at all"
    )


@dataclass(frozen=True, eq=False)
class TopFace:
    """The outline (n, 3) [m] in world, heights [m] of top and surroundings, and how it was found.

    `base` is None when nothing lower around the object is within the camera's range. `filled` counts contour pixels
    without depth; `upright`: whether the walls are.
    """

    outline: Array
    top: float
    base: float | None
    filled: int
    upright: bool


@dataclass(frozen=True, eq=False)
class _Cut:
    """Cut around a contour: heights [m] in world, NaN where unknown, masks of the object and of its hole."""

    low: npt.NDArray[np.int_]
    heights: Array
    inside: Mask
    hole: Mask


def top_face(
    pixels: npt.ArrayLike, depth: Depth, camera: Pinhole, options: TopFaceOptions, *, hole: bool = False
) -> TopFace:
    """Return the outline of the top face of the object with this contour.

    Args:
        pixels: closed contour (n, 2) [px], to the pixel or finer.
        depth: image (height, width) [m] along the optical axis, NaN where unknown.
        camera: that took both.
        options: tolerances.
        hole: the contour is the edge of a hole; the object lies outside of it.

    Raises:
        DepthError: too many contour pixels have no depth, or no pixel inside has.
    """
    contour = np.asarray(pixels, dtype=float)
    height, width = depth.shape
    out = normals(contour, hole=hole)
    inwards = 0.0 if _to_the_pixel(contour) else INWARDS
    cells = np.clip(np.rint(contour - inwards * out).astype(int), 0, (width - 1, height - 1))
    bare = ~is_valid(depth[cells[:, 1], cells[:, 0]])
    filled = int(np.count_nonzero(bare))
    cut = _cut(cells, depth, camera, hole=hole)
    core = _core(cut.inside) & np.isfinite(cut.heights)
    known = cv2.dilate(core.astype(np.uint8), np.ones((2 * FRAYED + 1,) * 2, np.uint8)) > 0
    lost = int(np.count_nonzero(bare & ~known[tuple((cells - cut.low).T[::-1])]))
    if lost > options.max_invalid * len(cells):
        raise DepthError("invalid", f"{lost} of the {len(cells)} pixels of the contour have no valid depth, more "
                                    f"than {options.max_invalid:.0%}: is the object within the camera's range?")
    if not core.any():
        raise DepthError("nothing", "no pixel within the contour has a valid depth")
    tolerance = max(options.top_tolerance, 4 * _noise(cut.heights, core))
    about = core if not hole else core & (cv2.dilate(cut.hole, np.ones((2 * AROUND + 1,) * 2, np.uint8)) > 0)
    top = _plateau(cut.heights[about if about.any() else core], tolerance)
    around = _heights_around(contour, out, depth, camera)
    lower = around[around < top - tolerance]
    base = float(np.median(lower)) if len(lower) else None
    level = np.abs(cut.heights - top) <= tolerance
    edge = _edge_of_hole(cut, level) if hole else _edge_of_plateau(cut, level)
    points = _edges(contour, camera, top, base, edge, hole=hole)
    upright = _goes_along(points, edge, cut, camera)
    if not upright:
        points = Rays.through(camera, edge).at_height(np.full(len(edge), top))
    return TopFace(rounded(points, options.rounding), top, base, filled, upright)


def rounded(points: Array, step: float) -> Array:
    """Round points (n, 3) to multiples of a step [m]; 0: unchanged."""
    return np.round(np.rint(points / step) * step, 9) if step else points


# --- heights ----------------------------------------------------------------------------------------------------


def _cut(cells: npt.NDArray[np.int_], depth: Depth, camera: Pinhole, *, hole: bool) -> _Cut:
    """Cut around a contour; pixels without depth stay NaN, and their neighbors represent them."""
    height, width = depth.shape
    margin = MARGIN + (int(np.ptp(cells, axis=0).max()) // 2 if hole else 0)  # the top may be visible far from a hole
    low = np.maximum(cells.min(axis=0) - margin, 0)
    high = np.minimum(cells.max(axis=0) + margin + 1, (width, height))
    part = depth[low[1] : high[1], low[0] : high[0]]
    columns, rows = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
    heights = Rays.through(camera, np.stack([columns, rows], axis=-1)).at_depth(part)[..., 2]
    heights[~is_valid(part)] = np.nan
    polygon = [(cells - low).astype(np.int32)]
    filled = np.asarray(cv2.fillPoly(np.zeros(part.shape, np.uint8), polygon, 1), np.uint8)
    if not hole:
        return _Cut(low, heights, filled, np.zeros_like(filled))
    edge = cv2.polylines(np.zeros(part.shape, np.uint8), polygon, True, 1) > 0
    within = ((filled > 0) & ~edge).astype(np.uint8)
    return _Cut(low, heights, 1 - within, within)


def _core(inside: Mask) -> Bools:
    """Return the pixels whose rays certainly meet the object: without its edge, unless it is too thin."""
    core = cv2.erode(inside, SQUARE, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    return np.asarray((core if np.count_nonzero(core) >= 9 else inside) > 0)


def _noise(heights: Array, usable: Bools) -> float:
    """Standard deviation [m] of the noise of heights, from differences of neighbors."""
    pairs = usable[:, 1:] & usable[:, :-1]
    steps = np.abs(heights[:, 1:] - heights[:, :-1])[pairs]
    return float(np.median(steps) / 0.6745 / np.sqrt(2)) if len(steps) else 0.0


def _plateau(heights: Array, tolerance: float) -> float:
    """Height [m] of the highest plateau."""
    top = float(np.percentile(heights, HIGHEST, method="lower"))  # a measured height, not one interpolated between two
    for _ in range(4):
        top = float(np.median(heights[np.abs(heights - top) <= tolerance]))
    return top


def _heights_around(contour: Array, out: Array, depth: Depth, camera: Pinhole) -> Array:
    """Height [m] a little outside of each contour point (n,); NaN where unknown."""
    cells = np.rint(contour + OUTSIDE * out).astype(int)
    height, width = depth.shape
    inside = (cells >= 0).all(axis=1) & (cells < (width, height)).all(axis=1)
    cells = np.clip(cells, 0, (width - 1, height - 1))
    seen = depth[cells[:, 1], cells[:, 0]]
    found = Rays.through(camera, cells).at_depth(seen)[:, 2]
    return np.where(inside & is_valid(seen), found, np.nan)


# --- edges ------------------------------------------------------------------------------------------------------


def _edges(contour: Array, camera: Pinhole, top: float, base: float | None, edge: Array, *, hole: bool) -> Array:
    """Return the outline (n, 3) [m] at the height `top` of an upright object on a support at `base`."""
    rays = Rays.through(camera, contour)
    at_top = rays.at_height(np.full(len(contour), top))
    if base is None:
        return at_top
    at_foot = rays.at_height(np.full(len(contour), base))
    at_foot[:, 2] = top
    lifted = camera.project(at_foot)  # pixels of the contour if all of it were foot
    fine = not _to_the_pixel(contour)
    near_radial, slack = (0.06, 0.25) if fine else (0.1, 1.0)
    away = contour - lifted  # towards the camera axis, with the visible length of an upright edge
    length = np.linalg.norm(away, axis=1)
    out = normals(contour if fine else _smoothed(contour), hole=hole)
    facing = (out * away).sum(axis=1) / np.maximum(length, 1e-9)
    is_foot = (facing > 0) & (length > SHORT)
    sign = -1.0 if hole else 1.0
    within_feet, within = _depth_within(contour, lifted) * sign, _depth_within(lifted, contour) * sign
    keep = (np.where(is_foot, within, within_feet) >= -slack) & (np.abs(facing) >= near_radial) | (length <= SHORT)
    if np.count_nonzero(keep) < 3:
        return at_top
    points = np.where(is_foot[:, None], at_foot, at_top)[keep]
    pixel = float(np.linalg.norm(at_top - rays.origin, axis=1).min()) / camera.fx  # [m]
    plateau = Rays.through(camera, edge).at_height(np.full(len(edge), top))
    return joined(points, contour[keep], is_foot[keep], pixel, plateau)


def _depth_within(points: Array, polygon: Array) -> Array:
    """Return how far points (n, 2) are inside of a polygon (m, 2) [px]; negative outside."""
    corners = polygon.astype(np.float32)[:, None, :]
    return np.array([cv2.pointPolygonTest(corners, (float(x), float(y)), True) for x, y in points])


def _to_the_pixel(contour: Array) -> bool:
    return bool(np.array_equal(contour, np.rint(contour)))


def _smoothed(contour: Array) -> Array:
    """Return a closed contour with smoothed pixel steps."""
    return np.asarray(sum(np.roll(contour, k, axis=0) for k in range(-2, 3)) / 5)


# --- plateau ----------------------------------------------------------------------------------------------------


def _edge_of_plateau(cut: _Cut, level: Bools) -> Array:
    """Return the outer edge of the plateau as points (n, 2) [px], half a pixel outside of its last pixels."""
    return _outline(((cut.inside > 0) & level).astype(np.uint8)) + cut.low


def _edge_of_hole(cut: _Cut, level: Bools) -> Array:
    """Return the edge of the plateau around a hole, as `_edge_of_plateau`."""
    below = ((cut.inside == 0) | ~level).astype(np.uint8)
    count, parts = cv2.connectedComponents(below, connectivity=4)
    seen = parts[cut.hole > 0]
    return _outline((parts == np.bincount(seen[seen > 0], minlength=count).argmax()).astype(np.uint8)) + cut.low


def _outline(mask: Mask) -> Array:
    """Return the outer edge (n, 2) of a mask's largest part, half a pixel outside of its pixel centers."""
    chains, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    chain = max(chains, key=cv2.contourArea).reshape(-1, 2).astype(float)
    return np.asarray(chain + 0.5 * normals(chain, hole=False))


def _goes_along(points: Array, edge: Array, cut: _Cut, camera: Pinhole) -> bool:
    """Return whether an outline follows the edge of the plateau within two rows of pixels."""
    first, second = (
        cv2.fillPoly(np.zeros_like(cut.inside), [np.rint((line - cut.low) * 16).astype(np.int32)], 1, cv2.LINE_8, 4)
        for line in (camera.project(points), edge)
    )
    differs = (first != second) & np.isfinite(cut.heights)
    return not cv2.erode(differs.astype(np.uint8), SQUARE).any()
