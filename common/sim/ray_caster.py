"""Ray caster: color and depth of the nearest triangle at each pixel of a pinhole camera.

All rays share an origin, so the rays of a triangle are the pixels within its projection: looping over triangles and
testing rays row by row needs no search tree. For the few thousand triangles of a work cell, numpy is faster than
embree ray by ray (benchmarks/outline_perception.py compares time and depth). It gives the same result on every
platform and adds no binary dependency.

A ray that passes within rounding of a shared edge meets one of the two triangles: there are no gaps.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from common.perception.pinhole import Pinhole

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Pixels = npt.NDArray[np.uint8]
Depth = npt.NDArray[np.float32]

log = logging.getLogger(__name__)

NEAREST = 0.01  # near clipping plane [m]
SLACK = 1e-7  # [px] widens spans, so that rounding leaves no gaps
MAX_LAYERS = 100  # of image-filling triangles; the rest is not drawn
BATCH_PIXELS = 2_000_000  # triangle pixels processed together
SAMPLES = 16  # rays per edge pixel


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles of one color: `corners` (n, 3, 3) [m] in world, `color` red, green and blue, 0 to 1."""

    corners: Array
    color: tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class View:
    """Rendered image: bgr `colour` (height, width, 3), and `depth` along the optical axis [m], inf for background."""

    colour: Pixels
    depth: Depth

    def depth_within(self, nearest: float, farthest: float) -> Depth:
        """Depth (height, width) [m] within a measuring range; NaN outside."""
        return np.where((self.depth >= nearest) & (self.depth <= farthest), self.depth, np.float32(np.nan))


def empty_view(camera: Pinhole, color: tuple[float, float, float]) -> View:
    """Return a view of a uniform color at infinite depth."""
    shape = (camera.height, camera.width)
    return View(np.full((*shape, 3), _bgr(color), np.uint8), np.full(shape, np.inf, np.float32))


def cast(meshes: Sequence[Mesh], camera: Pinhole, behind: View) -> View:
    """Return the view of the meshes in front of, or behind, an existing view.

    Depth is sampled at pixel centers. The color of an edge pixel is the mean of `SAMPLES` rays spread over the pixel,
    as in a real camera: it carries sub-pixel edge positions.

    Args:
        meshes: in world; no shading.
        camera: intrinsics and pose.
        behind: of the same size; not modified.
    """
    colour, depth = behind.colour.copy(), behind.depth.copy()
    corners, owner = _in_front(meshes, camera)
    if not len(corners):
        return View(colour, depth)
    palette = np.array([_bgr(mesh.color) for mesh in meshes], np.uint8)
    pixels, plane = _project(corners, camera)
    order = np.argsort(owner, kind="stable")
    order = order[: _drawable(pixels[order], camera)]
    nearness, winner = _cast_centers(pixels[order], plane[order], camera, depth)
    hit = np.flatnonzero(winner >= 0)
    mesh_of = np.full(winner.shape, -1, np.int64)
    mesh_of[hit] = owner[order][winner[hit]]
    depth.ravel()[hit] = 1.0 / nearness[hit]
    colour.reshape(-1, 3)[hit] = palette[mesh_of[hit]]
    grid = mesh_of.reshape(camera.height, camera.width)
    _antialias(pixels[order], plane[order], palette[owner[order]], grid, colour, behind)
    return View(colour, depth)


def _in_front(meshes: Sequence[Mesh], camera: Pinhole) -> tuple[Array, Ints]:
    """Triangles (n, 3, 3) [m] in the optical frame, clipped at `NEAREST`, and the mesh index of each (n,)."""
    parts: list[Array] = []
    owners: list[Ints] = []
    for index, mesh in enumerate(meshes):
        corners = camera.to_camera(mesh.corners)
        before = corners[..., 2] > NEAREST
        complete, cut = before.all(axis=1), before.any(axis=1) & ~before.all(axis=1)
        clipped = [corners[complete], *(_clip(triangle) for triangle in corners[cut])]
        parts += clipped
        owners.append(np.full(sum(len(part) for part in clipped), index))
    if not parts:
        return np.empty((0, 3, 3)), np.empty(0, np.int64)
    return np.concatenate(parts), np.concatenate(owners)


def _clip(triangle: Array) -> Array:
    """Clip a triangle at z = `NEAREST` to one or two triangles (k, 3, 3)."""
    clipped: list[Array] = []
    for a, b in zip(triangle, np.roll(triangle, -1, axis=0), strict=True):
        if a[2] > NEAREST:
            clipped.append(a)
        if (a[2] > NEAREST) != (b[2] > NEAREST):
            clipped.append(a + (NEAREST - a[2]) / (b[2] - a[2]) * (b - a))
    return np.array([[clipped[0], clipped[i], clipped[i + 1]] for i in range(1, len(clipped) - 1)])


def _project(corners: Array, camera: Pinhole) -> tuple[Array, Array]:
    """Corners (n, 3, 2) [px] of the triangles, and 1/depth as a plane (n, 3) over pixels.

    1/depth of a plane is affine in the pixel: a u + b v + c. Triangles seen edge-on get a plane of zeros.
    """
    z = corners[..., 2]
    pixels = np.stack([camera.fx * corners[..., 0] / z + camera.cx, camera.fy * corners[..., 1] / z + camera.cy], -1)
    ones = np.concatenate([pixels, np.ones((*pixels.shape[:2], 1))], axis=2)
    area = np.linalg.det(ones)
    solvable = np.abs(area) > 1e-9  # [px^2]
    plane = np.zeros((len(corners), 3))
    plane[solvable] = np.linalg.solve(ones[solvable], 1.0 / z[solvable][..., None])[..., 0]
    return pixels, plane


def pixel_spans(pixels: Array, width: int, height: int, reach: float) -> tuple[Ints, Ints, Ints, Ints]:
    """For each triangle and row that it meets: index, row, first and last column.

    With `reach` 0: pixels whose centers are inside; with 0.5: a superset of the pixels that it touches.
    """
    left, low = np.moveaxis(pixels.min(axis=1), -1, 0)
    right, high = np.moveaxis(pixels.max(axis=1), -1, 0)
    first = np.maximum(np.ceil(low - reach - SLACK), 0).astype(np.int64)
    last = np.minimum(np.floor(high + reach + SLACK), height - 1).astype(np.int64)
    inward = _inward(pixels)
    seen = (last >= first) & (right > -1) & (left < width) & np.isfinite(inward[:, 0, 0])
    which = np.flatnonzero(seen)
    triangle, step = _ramps(which, (last - first + 1)[which])
    row = first[triangle] + step
    # A side meets a row at x - lean (row - y), and in the rows' band up to lean (reach + SLACK) aside.
    across, along = inward[..., 0].T, inward[..., 1].T
    lean = np.divide(along, across, out=np.zeros_like(across), where=across != 0)
    aside = np.abs(lean) * (reach + SLACK)
    start, end = left[triangle], right[triangle]
    for k in range(3):
        x = pixels[triangle, k, 0] - lean[k, triangle] * (row - pixels[triangle, k, 1])
        start = np.maximum(start, np.where(across[k] > 0, -aside[k], -np.inf)[triangle] + x)
        end = np.minimum(end, np.where(across[k] < 0, aside[k], np.inf)[triangle] + x)
    start = np.maximum(np.ceil(np.clip(start - reach, -1, width) - SLACK), 0).astype(np.int64)
    end = np.minimum(np.floor(np.clip(end + reach, -1, width) + SLACK), width - 1).astype(np.int64)
    full = end >= start
    return triangle[full], row[full], start[full], end[full]


def _areas(pixels: Array, width: int, height: int) -> Array:
    """Upper estimate of the number of pixels (n,) that each triangle meets."""
    size = np.array([width, height])
    low, high = np.clip(pixels.min(axis=1) - 1, 0, size), np.clip(pixels.max(axis=1) + 1, 0, size)
    sides = np.roll(pixels, -1, axis=1) - pixels
    estimate = np.abs(_cross(sides[:, 0], sides[:, 1])) / 2 + 2 * np.abs(sides).sum(axis=(1, 2)) + 4
    return np.asarray(np.minimum(np.prod(high - low, axis=1), estimate) + 1)


def _drawable(pixels: Array, camera: Pinhole) -> int:
    """Number of triangles, from the first, within the limit of image-filling layers."""
    areas = np.cumsum(_areas(pixels, camera.width, camera.height))
    most = MAX_LAYERS * camera.width * camera.height
    count = int(np.searchsorted(areas, most, side="right"))
    if count < len(pixels):
        log.warning("%d of %d triangles are not drawn: together they fill the image %.0f times",
                    len(pixels) - count, len(pixels), areas[-1] / (camera.width * camera.height))
    return count


def _batches(pixels: Array, width: int, height: int) -> list[slice]:
    """Slices of the triangles that limit memory per batch."""
    batch = np.cumsum(_areas(pixels, width, height)) // BATCH_PIXELS
    ends = [*(np.flatnonzero(np.diff(batch)) + 1), len(pixels)]
    return [slice(begin, end) for begin, end in zip([0, *ends[:-1]], ends, strict=True)]


def _ramps(values: Ints, counts: Ints) -> tuple[Ints, Ints]:
    """Repeat each value by its count, and count 0, 1, 2, ... within each repetition."""
    offsets = np.cumsum(counts) - counts
    return np.repeat(values, counts), np.arange(int(counts.sum())) - np.repeat(offsets, counts)


def _cast_centers(pixels: Array, plane: Array, camera: Pinhole, depth: Depth) -> tuple[Array, Ints]:
    """1/depth (height * width,) at each pixel center, and the triangle hit; -1 where none is nearer."""
    with np.errstate(divide="ignore"):
        best = (1.0 / depth.astype(np.float64)).ravel()
    winner = np.full(best.shape, -1, np.int64)
    for batch in _batches(pixels, camera.width, camera.height):
        triangle, row, start, end = pixel_spans(pixels[batch], camera.width, camera.height, 0.0)
        triangle += batch.start
        count = end - start + 1
        column, step = _ramps(start, count)
        column += step
        flat = np.repeat(row * camera.width, count) + column
        a, b, c = plane[triangle].T
        near = np.repeat(a, count) * column + np.repeat(b * row + c, count)
        nearer = near > best[flat]
        of, near, flat = np.repeat(triangle, count)[nearer], near[nearer], flat[nearer]
        np.maximum.at(best, flat, near)
        won = near == best[flat]
        winner[flat[won][::-1]] = of[won][::-1]  # at equal depth the first mesh wins
    return best, winner


def _antialias(pixels: Array, plane: Array, colors: Pixels, meshes: Ints, colour: Pixels, behind: View) -> None:
    """Mix the colors of edge pixels from `SAMPLES` rays each."""
    import cv2  # the supervisor imports this module without drawing

    levels = (meshes + 1).astype(np.float32)
    square = np.ones((3, 3), np.uint8)
    edge = cv2.dilate(levels, square) != cv2.erode(levels, square)
    flat_edges = np.flatnonzero(edge)
    if not len(flat_edges):
        return
    height, width = meshes.shape
    before = np.concatenate([[0], np.cumsum(edge)])  # number of edge pixels before each pixel, row by row
    offsets = _spread(SAMPLES)
    with np.errstate(divide="ignore"):
        least = 1.0 / behind.depth.ravel()[flat_edges].astype(np.float64)  # of 1/depth in all of an edge pixel
    best = np.repeat(least[:, None], SAMPLES, axis=1)
    mixed = np.repeat(behind.colour.reshape(-1, 3)[flat_edges][:, None], SAMPLES, axis=1)
    inward = _inward(pixels)
    reach, tilt = np.abs(inward).sum(axis=2) / 2, np.abs(plane[:, :2]).sum(axis=1) / 2  # from the center to a corner
    for batch in _batches(pixels, width, height):
        triangle, row, start, end = pixel_spans(pixels[batch], width, height, 0.5)
        first, last = before[row * width + start], before[row * width + end + 1]
        of, step = _ramps(triangle + batch.start, last - first)
        at = np.repeat(first, last - first) + step
        v, u = np.divmod(flat_edges[at], width)
        # Of each side, and 1/depth: at the center of the pixel. A product is negative outside of the side.
        side = (inward[of] * (np.stack([u, v], axis=1)[:, None] - pixels[of])).sum(axis=2)
        near = plane[of, 0] * u + plane[of, 1] * v + plane[of, 2]
        covered = (side >= reach[of] - SLACK).all(axis=1)
        np.maximum.at(least, at[covered], (near - tilt[of])[covered])
        possible = (side >= -reach[of] - SLACK).all(axis=1) & (near + tilt[of] >= least[at])
        of, at, side, near = of[possible], at[possible], side[possible], near[possible]
        inside = np.ones((len(of), SAMPLES), bool)
        for k in range(3):
            inside &= side[:, k, None] + inward[of, k] @ offsets.T >= -SLACK
        hit, sample = np.nonzero(inside)
        of, at, near = of[hit], at[hit], (near[:, None] + plane[of, :2] @ offsets.T)[inside]
        nearer = near > best[at, sample]
        of, at, sample, near = of[nearer], at[nearer], sample[nearer], near[nearer]
        np.maximum.at(best, (at, sample), near)
        won = near == best[at, sample]
        mixed[at[won][::-1], sample[won][::-1]] = colors[of[won][::-1]]
    colour.reshape(-1, 3)[flat_edges] = np.rint(mixed.mean(axis=1)).astype(np.uint8)


def _inward(pixels: Array) -> Array:
    """Normals (n, 3, 2) of the sides of triangles, towards the inside and as long as the side; NaN of flat ones."""
    sides = np.roll(pixels, -1, axis=1) - pixels
    turn = np.sign(_cross(sides[:, 0], sides[:, 1]))
    turn[turn == 0] = np.nan
    return turn[:, None, None] * np.stack([-sides[..., 1], sides[..., 0]], axis=-1)


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def _spread(count: int) -> Array:
    """Sample positions (count, 2) within a pixel, -0.5 to 0.5, each in its own row and column (Hammersley points)."""
    bits = max(1, (count - 1).bit_length())
    mirrored = [int(f"{i:0{bits}b}"[::-1], 2) / 2**bits for i in range(count)]
    return np.column_stack([(np.arange(count) + 0.5) / count, np.array(mirrored) + 0.5 / 2**bits]) - 0.5


def _bgr(color: tuple[float, float, float]) -> tuple[int, int, int]:
    r, g, b = (round(255 * value) for value in color)
    return b, g, r
