"""The outline of an object's top face, told from its side walls by depth.

A camera above sees the walls that face its axis: the contour in the picture is then that of top and walls together.
Depth tells the height of the top face, which is the plateau of greatest height within the contour, and that of what the
object stands on. Where an edge faces away from the axis, the contour is the edge of the top. Where it faces the axis
and the wall is upright, the contour is the foot of that wall, which has the x and y of the edge above it. Between the
two the contour runs along upright edges, which are points of the outline: those parts are left out.

An outline found so must go along the edge of the plateau. If it does not (walls that slope or hang over, one object
upon another), the edge of the plateau itself is taken, to the pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import Field

from applications.outlining.contours_refinement import normals
from applications.outlining.outline_joining import joined
from common.config import Parameters, Tunable
from common.perception.depth import Depth, DepthError, Rays, is_valid
from common.perception.pinhole import Pinhole

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]
Mask = npt.NDArray[np.uint8]

MARGIN = 12  # of the cut about a contour [px]
AROUND = 4  # the object about a hole is looked at so far from its edge [px]
INWARDS = 0.75  # from a point of a sub-pixel contour to the pixel of the object beside it [px]
OUTSIDE = 3.0  # the height beside an object is looked at so far from its contour [px]
FRAYED = 2  # cameras that measure depth by a pattern lose it so far from an edge [px]: what is beside it stands for it
HIGHEST = 98  # percentile of the heights in a contour that lies on the top face
SHORT = 0.3  # upright edges that are seen shorter than this are not looked for [px]
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
    """The outline (n, 3) [m] in world, heights [m] of the top and of what lies around it, and how it was found.

    `base` is None when nothing lower around the object is within the camera's range. `filled` counts pixels of the
    contour without depth; `upright` is whether the walls are.
    """

    outline: Array
    top: float
    base: float | None
    filled: int
    upright: bool


@dataclass(frozen=True, eq=False)
class _Cut:
    """What lies about a contour: heights [m] in world, NaN where unknown, the object and the hole in it."""

    low: npt.NDArray[np.int_]
    heights: Array
    inside: Mask
    hole: Mask


def top_face(
    pixels: npt.ArrayLike, depth: Depth, camera: Pinhole, options: TopFaceOptions, *, hole: bool = False
) -> TopFace:
    """The outline of the top face of the object with this contour.

    Args:
        pixels: closed contour (n, 2) [px], to the pixel or finer.
        depth: image (height, width) [m] along the optical axis, NaN where there is none.
        camera: that took both.
        options: tolerances.
        hole: the contour is the edge of a hole; the object lies outside of it.

    Raises:
        DepthError: too much of the contour has no depth, or nothing of it.
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
    beside = _heights_beside(contour, out, depth, camera)
    lower = beside[beside < top - tolerance]
    base = float(np.median(lower)) if len(lower) else None
    level = np.abs(cut.heights - top) <= tolerance
    edge = _edge_of_hole(cut, level) if hole else _edge_of_plateau(cut, level)
    points = _edges(contour, camera, top, base, edge, hole=hole)
    upright = _goes_along(points, edge, cut, camera)
    if not upright:
        points = Rays.through(camera, edge).at_height(np.full(len(edge), top))
    return TopFace(rounded(points, options.rounding), top, base, filled, upright)


def rounded(points: Array, step: float) -> Array:
    """Points (n, 3) at multiples of a step [m]; as they are when it is 0."""
    return np.round(np.rint(points / step) * step, 9) if step else points


# --- heights ----------------------------------------------------------------------------------------------------


def _cut(cells: npt.NDArray[np.int_], depth: Depth, camera: Pinhole, *, hole: bool) -> _Cut:
    """What lies about a contour. A pixel without depth has none here either: its neighbours stand for it."""
    height, width = depth.shape
    margin = MARGIN + (int(np.ptp(cells, axis=0).max()) // 2 if hole else 0)  # the top may be seen far from a hole
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
    """Pixels whose rays certainly meet the object: not those at its edge, unless it is too thin."""
    core = cv2.erode(inside, SQUARE, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    return np.asarray((core if np.count_nonzero(core) >= 9 else inside) > 0)


def _noise(heights: Array, usable: Bools) -> float:
    """Standard deviation [m] of the noise of heights, from the differences of neighbours."""
    pairs = usable[:, 1:] & usable[:, :-1]
    steps = np.abs(heights[:, 1:] - heights[:, :-1])[pairs]
    return float(np.median(steps) / 0.6745 / np.sqrt(2)) if len(steps) else 0.0


def _plateau(heights: Array, tolerance: float) -> float:
    """Height [m] of the highest face."""
    top = float(np.percentile(heights, HIGHEST, method="lower"))  # that was measured: between two there may be none
    for _ in range(4):
        top = float(np.median(heights[np.abs(heights - top) <= tolerance]))
    return top


def _heights_beside(contour: Array, out: Array, depth: Depth, camera: Pinhole) -> Array:
    """Height [m] of what is seen a little outside of each point of the contour (n,); NaN where that is unknown."""
    cells = np.rint(contour + OUTSIDE * out).astype(int)
    height, width = depth.shape
    inside = (cells >= 0).all(axis=1) & (cells < (width, height)).all(axis=1)
    cells = np.clip(cells, 0, (width - 1, height - 1))
    seen = depth[cells[:, 1], cells[:, 0]]
    found = Rays.through(camera, cells).at_depth(seen)[:, 2]
    return np.where(inside & is_valid(seen), found, np.nan)


# --- edges ------------------------------------------------------------------------------------------------------


def _edges(contour: Array, camera: Pinhole, top: float, base: float | None, edge: Array, *, hole: bool) -> Array:
    """The outline (n, 3) [m] at the height `top` of an upright object with this contour that stands at `base`."""
    rays = Rays.through(camera, contour)
    at_top = rays.at_height(np.full(len(contour), top))
    if base is None:
        return at_top
    at_foot = rays.at_height(np.full(len(contour), base))
    at_foot[:, 2] = top
    lifted = camera.project(at_foot)  # where the contour would be seen if it were all foot
    fine = not _to_the_pixel(contour)
    near_radial, slack = (0.06, 0.25) if fine else (0.1, 1.0)
    away = contour - lifted  # towards the camera's axis, as long as an upright edge is seen
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
    """How far inside of a polygon (m, 2) points (n, 2) are [px], negative outside."""
    corners = polygon.astype(np.float32)[:, None, :]
    return np.array([cv2.pointPolygonTest(corners, (float(x), float(y)), True) for x, y in points])


def _to_the_pixel(contour: Array) -> bool:
    return bool(np.array_equal(contour, np.rint(contour)))


def _smoothed(contour: Array) -> Array:
    """A closed contour whose steps from pixel to pixel are evened out."""
    return np.asarray(sum(np.roll(contour, k, axis=0) for k in range(-2, 3)) / 5)


# --- plateau ----------------------------------------------------------------------------------------------------


def _edge_of_plateau(cut: _Cut, level: Bools) -> Array:
    """The outer edge of the plateau as points (n, 2) [px], half a pixel outside of its last pixels."""
    return _outline(((cut.inside > 0) & level).astype(np.uint8)) + cut.low


def _edge_of_hole(cut: _Cut, level: Bools) -> Array:
    """The edge of the plateau around a hole, as `_edge_of_plateau`."""
    below = ((cut.inside == 0) | ~level).astype(np.uint8)
    count, parts = cv2.connectedComponents(below, connectivity=4)
    seen = parts[cut.hole > 0]
    return _outline((parts == np.bincount(seen[seen > 0], minlength=count).argmax()).astype(np.uint8)) + cut.low


def _outline(mask: Mask) -> Array:
    """The outer edge (n, 2) of the largest part of a mask, half a pixel outside of the centres of its pixels."""
    chains, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    chain = max(chains, key=cv2.contourArea).reshape(-1, 2).astype(float)
    return np.asarray(chain + 0.5 * normals(chain, hole=False))


def _goes_along(points: Array, edge: Array, cut: _Cut, camera: Pinhole) -> bool:
    """Whether an outline goes along the edge of the plateau: they differ by no more than two lines of pixels."""
    first, second = (
        cv2.fillPoly(np.zeros_like(cut.inside), [np.rint((line - cut.low) * 16).astype(np.int32)], 1, cv2.LINE_8, 4)
        for line in (camera.project(points), edge)
    )
    differs = (first != second) & np.isfinite(cut.heights)
    return not cv2.erode(differs.astype(np.uint8), SQUARE).any()
