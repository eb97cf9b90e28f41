"""The outline of an object's top face, told from its side walls by depth.

A camera above sees the walls that face its axis: the contour in the picture is then that of top and walls together. The
top face is the plateau of greatest height within the contour. A point of the contour beside the plateau lies on its
edge. A point beside a wall lies below an edge: an upright wall has the same x and y from top to bottom, so the point
where the ray meets the wall is lifted to the height of the top. Should the edge found so not be the edge of the plateau
(walls that slope, one object upon another), the edge of the plateau itself is taken, to the pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import Field

from common.config import Parameters
from common.perception.contours_refinement import normals
from common.perception.depth import Depth, DepthError, Rays, is_valid
from common.perception.pinhole import Pinhole

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.uint8]

MARGIN = 12  # of the cut about a contour [px]
WINDOW = 3  # depth is taken from pixels up to so far from a point of the contour [px]
OUTSIDE = 3.0  # the height beside an object is looked at so far from its contour [px]
NARROW = 2.5  # walls that are seen narrower than this may have no pixel of their own [px]
HIGHEST = 98  # percentile of the heights in a contour that lies on the top face
RIDGE = 1e-7  # keeps a wall determined that is seen along its edge only
SQUARE = np.ones((3, 3), np.uint8)


class TopFaceOptions(Parameters):
    """How the top face is found."""

    top_tolerance: float = Field(
        0.002, gt=0, le=0.1, description="heights that differ by less are one face [m]; grows with the depth's noise"
    )
    max_invalid: float = Field(0.05, ge=0, le=1, description="part of a contour that may lack depth")
    rounding: float = Field(0.0, ge=0, le=0.1, description="points are rounded to multiples of this [m]; 0: not at all")


@dataclass(frozen=True, eq=False)
class TopFace:
    """The outline (n, 3) [m] in world, heights [m] of the top and of what lies around it, and how it was found.

    `base` is None when nothing around the object is within the camera's range. `filled` counts pixels of the contour
    without depth; `upright` is whether the walls are.
    """

    outline: Array
    top: float
    base: float | None
    filled: int
    upright: bool


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
    cells = np.rint(contour).astype(int)
    height, width = depth.shape
    cells = np.clip(cells, 0, (width - 1, height - 1))
    filled = int(np.count_nonzero(~is_valid(depth[cells[:, 1], cells[:, 0]])))
    if filled > options.max_invalid * len(cells):
        raise DepthError(
            "invalid" if filled < len(cells) else "far",
            f"{filled} of the {len(cells)} pixels of the contour have no valid depth, more than "
            f"{options.max_invalid:.0%}: out of the camera's range?",
        )
    low = np.maximum(cells.min(axis=0) - MARGIN, 0)
    high = np.minimum(cells.max(axis=0) + MARGIN + 1, (width, height))
    cut = depth[low[1] : high[1], low[0] : high[0]]
    inside = _inside(cells - low, cut.shape, hole=hole)
    columns, rows = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
    heights = Rays.through(camera, np.stack([columns, rows], axis=-1)).at_depth(cut)[..., 2]
    heights[~is_valid(cut)] = np.nan
    core = _core(inside)
    usable = core & np.isfinite(heights)
    if not usable.any():
        raise DepthError("invalid", "no pixel within the contour has a valid depth")
    tolerance = max(options.top_tolerance, 4 * _noise(heights, usable))
    top = _plateau(heights[usable], tolerance)
    out = normals(contour, hole=hole)
    beside = _heights_beside(contour, out, depth, camera)
    points, is_wall = _edges(contour, low, usable, heights, cut, camera, top, tolerance)
    flat = ~is_wall
    points[flat] = _without_narrow_walls(points[flat], contour[flat], out[flat], beside[flat], top - tolerance, camera)
    points[:, 2] = top
    upright = hole or _fits(points, low, usable, heights, tolerance, camera)
    if not upright:
        points = _plateau_edge(low, inside, heights, tolerance, top, camera)
    known = beside[np.isfinite(beside) & (beside < top - tolerance)]
    base = float(np.percentile(known, 10)) if len(known) else None
    return TopFace(rounded(points, options.rounding), top, base, filled, upright)


def rounded(points: Array, step: float) -> Array:
    """Points (n, 3) at multiples of a step [m]; as they are when it is 0."""
    return np.round(np.rint(points / step) * step, 9) if step else points


def _inside(cells: npt.NDArray[np.int_], shape: tuple[int, ...], *, hole: bool) -> Mask:
    """Pixels of the object: within its contour, or around the contour of a hole."""
    polygon = [cells.astype(np.int32)]
    filled = cv2.fillPoly(np.zeros(shape, np.uint8), polygon, 1)
    if not hole:
        return np.asarray(filled, np.uint8)
    edge = cv2.polylines(np.zeros(shape, np.uint8), polygon, True, 1) > 0
    around = cv2.dilate(filled, np.ones((2 * WINDOW + 3, 2 * WINDOW + 3), np.uint8)) > 0
    return np.asarray(around & ((filled == 0) | edge), np.uint8)


def _core(inside: Mask) -> npt.NDArray[np.bool_]:
    """Pixels whose rays certainly meet the object: not those at its edge, unless it is too thin."""
    core = cv2.erode(inside, SQUARE, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    return np.asarray((core if np.count_nonzero(core) >= 9 else inside) > 0)


def _noise(heights: Array, usable: npt.NDArray[np.bool_]) -> float:
    """Standard deviation [m] of the noise of heights, from the differences of neighbours."""
    pairs = usable[:, 1:] & usable[:, :-1]
    steps = np.abs(heights[:, 1:] - heights[:, :-1])[pairs]
    return float(np.median(steps) / 0.6745 / np.sqrt(2)) if len(steps) else 0.0


def _plateau(heights: Array, tolerance: float) -> float:
    """Height [m] of the highest face."""
    top = float(np.percentile(heights, HIGHEST))
    for _ in range(4):
        top = float(np.median(heights[np.abs(heights - top) <= tolerance]))
    return top


def _heights_beside(contour: Array, out: Array, depth: Depth, camera: Pinhole) -> Array:
    """Height [m] of what is seen a little outside of each point of the contour (n,); NaN where that is unknown."""
    places = contour + OUTSIDE * out
    cells = np.rint(places).astype(int)
    height, width = depth.shape
    inside = (cells >= 0).all(axis=1) & (cells < (width, height)).all(axis=1)
    cells = np.clip(cells, 0, (width - 1, height - 1))
    seen = depth[cells[:, 1], cells[:, 0]]
    found = Rays.through(camera, cells).at_depth(seen)[:, 2]
    return np.where(inside & is_valid(seen), found, np.nan)


def _edges(
    contour: Array, low: npt.NDArray[np.int_], usable: npt.NDArray[np.bool_], heights: Array, cut: Depth,
    camera: Pinhole, top: float, tolerance: float,
) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Where the rays of the contour meet the object (n, 3) [m], and which of them meet a wall (n,).

    A plane has 1/depth affine in the pixel, and an upright one has 1/depth = a . h, where h (2,) is the horizontal
    part of the ray. `a` is fitted to the wall pixels around each point; where those lie along one ray only, as at a
    corner, the nearest of them decides.
    """
    steps = np.arange(-WINDOW, WINDOW + 1)
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    grid = grid[np.argsort((grid**2).sum(axis=1), kind="stable")]
    cells = np.rint(contour).astype(int)[:, None, :] - low + grid
    rows, columns = usable.shape
    within = (cells >= 0).all(axis=2) & (cells < (columns, rows)).all(axis=2)
    u, v = np.clip(cells[..., 0], 0, columns - 1), np.clip(cells[..., 1], 0, rows - 1)
    good = within & usable[v, u]
    has = good.any(axis=1)
    if not has.any():
        raise DepthError("invalid", "no pixel beside the contour has a valid depth")
    distance = ((cells + low - contour[:, None, :]) ** 2).sum(axis=2)
    nearest = np.argmin(np.where(good, distance, np.inf), axis=1)
    each = np.arange(len(contour))
    lower = heights[v, u] < top - tolerance
    is_wall = has & lower[each, nearest]
    rays = Rays.through(camera, contour)
    points = rays.at_height(np.full(len(contour), top))
    if is_wall.any():
        w = np.flatnonzero(is_wall)
        use = (good & lower)[w]
        h = Rays.through(camera, cells[w] + low).directions[..., :2]
        inverse = np.where(use, 1.0 / np.where(use, cut[v[w], u[w]], 1.0), 0.0)
        pick = np.arange(len(w))
        near_h, near_inverse = h[pick, nearest[w]], inverse[pick, nearest[w]]
        first = near_h * (near_inverse / np.maximum((near_h**2).sum(axis=1), 1e-12))[:, None]
        weighted = h * use[..., None]
        matrix = np.einsum("nki,nkj->nij", weighted, h) + RIDGE * np.eye(2)
        rest = np.einsum("nki,nk->ni", weighted, inverse - np.einsum("nki,ni->nk", h, first))
        a = first + np.linalg.solve(matrix, rest[..., None])[..., 0]
        slope = (a * rays.directions[w, :2]).sum(axis=1)
        seen = Rays.through(camera, cells[w, nearest[w]] + low).at_depth(cut[v[w, nearest[w]], u[w, nearest[w]]])
        with np.errstate(divide="ignore"):
            met = Rays(rays.origin, rays.directions[w]).at_depth(np.where(slope > 0, 1.0 / slope, 0.0))
        pixel = (top - rays.origin[2]) / rays.directions[w, 2] / camera.fx  # [m]
        near = np.linalg.norm(met[:, :2] - seen[:, :2], axis=1) <= 2 * WINDOW * pixel
        points[w] = np.where(near[:, None], met, seen)
    return points, is_wall


def _without_narrow_walls(
    points: Array, contour: Array, out: Array, beside: Array, below: float, camera: Pinhole
) -> Array:
    """Edges of the top (n, 3), moved inwards by as much of a wall as can be seen without having pixels of its own.

    Walls that face the camera's axis are seen between the edge of the top and the contour, which is their foot. Only
    the part of that shift across the edge counts: along it the outline stays the same.
    """
    rays = Rays.through(camera, contour)
    R = camera.T_world_optical[:3, :3]
    across = (np.column_stack([out[:, 0] / camera.fx, out[:, 1] / camera.fy]) @ R[:, :2].T)[:, :2]
    length = np.linalg.norm(across, axis=1, keepdims=True)
    across = np.divide(across, length, out=np.zeros_like(across), where=length > 0)
    foot = rays.at_height(np.where(beside < below, beside, points[:, 2]))
    shift = ((foot - points)[:, :2] * across).sum(axis=1)
    pixel = (points[:, 2] - rays.origin[2]) / rays.directions[:, 2] / camera.fx  # [m]
    moved = points.copy()
    narrow = (shift < 0) & (shift > -NARROW * pixel)
    moved[narrow, :2] += shift[narrow, None] * across[narrow]
    return moved


def _fits(
    points: Array, low: npt.NDArray[np.int_], usable: npt.NDArray[np.bool_], heights: Array, tolerance: float,
    camera: Pinhole,
) -> bool:
    """Whether an outline goes along the edge of the plateau: they differ by no more than a line of pixels."""
    polygon = np.rint((camera.project(points) - low) * 16).astype(np.int32)
    outlined = cv2.fillPoly(np.zeros(usable.shape, np.uint8), [polygon], 1, cv2.LINE_8, 4)
    level = usable & (np.abs(heights - points[0, 2]) <= tolerance)
    differs = np.asarray((outlined > 0) != _filled(level.astype(np.uint8)), np.uint8)
    return not cv2.erode(differs, np.ones((5, 5), np.uint8)).any()


def _filled(mask: Mask) -> npt.NDArray[np.bool_]:
    """The largest part of a mask, with its holes filled."""
    return np.asarray(cv2.fillPoly(np.zeros_like(mask), [_largest(mask)], 1) > 0)


def _largest(mask: Mask) -> npt.NDArray[np.int32]:
    """The pixels (n, 2) along the outer edge of the largest part of a mask."""
    chains, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return np.asarray(max(chains, key=cv2.contourArea).reshape(-1, 2), np.int32)


def _plateau_edge(
    low: npt.NDArray[np.int_], inside: Mask, heights: Array, tolerance: float, top: float, camera: Pinhole
) -> Array:
    """The pixels along the edge of the plateau as points (n, 3) [m] at its height."""
    level = (inside > 0) & (np.abs(heights - top) <= tolerance)
    chain = _largest(level.astype(np.uint8))
    return Rays.through(camera, chain + low).at_height(np.full(len(chain), top))
