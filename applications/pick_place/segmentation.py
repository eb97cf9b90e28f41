"""Segment an image by color: masks, connected blobs, and blob outlines as camera rays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from common.perception.illumination import BoolMask, amplify_green, green_gain
from common.perception.pinhole import Pinhole

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.uint8]
Contour = npt.NDArray[np.int32]
Part = tuple[Contour, bool]  # a contour, and whether it bounds a hole
OutlineKey = tuple[tuple[bytes, bool], ...]  # the contours of an outline as bytes: equal for an unchanged blob

_REACH = 3  # contour points to either side for the direction of the outline
MOST_NARROW = 0.05  # fraction of an image that may be narrow; above it the image is noise
_LEAST_POINTS = 16  # shorter contours are noise


@dataclass(frozen=True)
class Outline:
    """Points on the edge of a red region as rays; the border of the image is no edge.

    Attributes:
        pixels: (n, 2) [px].
        rays: (n, 3) unit vectors in world, from the optical center.
        inward: (n, 3) unit vectors in world, perpendicular to the ray and to the edge, into the red region.
    """

    pixels: Array
    rays: Array
    inward: Array

    def __len__(self) -> int:
        return len(self.pixels)

    def take(self, which: npt.NDArray[np.bool_] | npt.NDArray[np.intp]) -> Outline:
        """Return the points selected by an index or boolean array."""
        return Outline(self.pixels[which], self.rays[which], self.inward[which])


def all_of(outlines: Sequence[Outline]) -> tuple[Outline, npt.NDArray[np.intp]]:
    """Concatenate outlines; also return the index of each point's outline (n,)."""
    pixels, rays, inward = (np.concatenate([getattr(each, name) for each in outlines])
                            for name in ("pixels", "rays", "inward"))
    return Outline(pixels, rays, inward), np.repeat(np.arange(len(outlines)), [len(each) for each in outlines])


@dataclass(frozen=True)
class Blob:
    """One connected region.

    Attributes:
        area: inside its outer edge [px^2].
        centroid: (2,) of its area [px].
        outline: of the regions of the finer mask within it, including holes.
        border: (m, 2) its pixels at the border of the image [px].
        traced: key of its outline.
    """

    area: float
    centroid: Array
    outline: Outline
    border: Array
    traced: OutlineKey = ()


def find_blobs(
    closed: Mask, fine: Mask, camera: Pinhole, min_area: float, known: Mapping[OutlineKey, Outline] | None = None
) -> list[Blob]:
    """Return blobs of the closed mask of at least `min_area` [px^2], with outlines from the mask before closing.

    Closing bridges gaps between near neighbors and fills notches; the mask before shows the true shape of a ball.

    Args:
        closed: red pixels after closing.
        fine: red pixels before closing.
        camera: the camera.
        min_area: smaller blobs are ignored [px^2].
        known: outlines of the camera's last image by key; an unchanged blob gets the identical object.
    """
    outer, _ = cv2.findContours(closed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    large = [(np.asarray(c, np.int32), area) for c in outer if (area := cv2.contourArea(c)) >= min_area]
    if not large:
        return []
    contours, hierarchy = cv2.findContours(fine, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    within: list[list[Part]] = [[] for _ in large]
    for contour, links in zip(contours, hierarchy[0] if hierarchy is not None else (), strict=True):
        if len(contour) < _LEAST_POINTS:
            continue
        u, v = (float(value) for value in contour[0, 0])
        for index, (outside, _) in enumerate(large):
            if cv2.pointPolygonTest(outside, (u, v), False) >= 0:
                within[index].append((np.asarray(contour, np.int32), bool(links[3] >= 0)))
                break
    blobs = []
    traced = [tuple((part.tobytes(), is_hole) for part, is_hole in parts) for parts in within]
    cached = known or {}
    computed = iter(_outlines([parts for parts, key in zip(within, traced, strict=True) if key not in cached], camera))
    outlines = [cached[key] if key in cached else next(computed) for key in traced]
    for (contour, area), outline, key in zip(large, outlines, traced, strict=True):
        moments = cv2.moments(contour)
        centroid = np.array([moments["m10"], moments["m01"]]) / moments["m00"]
        flat = contour.reshape(-1, 2).astype(float)
        border = flat[~_off_border(flat, camera)]
        blobs.append(Blob(area, centroid, outline, border, key))
    return blobs


def small_blobs(closed: Mask, min_area: float) -> list[tuple[float, float]]:
    """Return the centers (u, v) [px] of blobs below `min_area` [px^2] in the closed mask."""
    outer, _ = cv2.findContours(closed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    small = [np.asarray(c).reshape(-1, 2).mean(axis=0) for c in outer if cv2.contourArea(c) < min_area]
    return [(float(u), float(v)) for u, v in small]


def blob_centers(closed: Mask, min_area: float) -> list[tuple[tuple[float, float], Contour]]:
    """Return center (u, v) [px] and outer edge of blobs of at least `min_area` [px^2] in the closed mask."""
    outer, _ = cv2.findContours(closed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    found = []
    for contour in outer:
        if cv2.contourArea(contour) >= min_area:
            u, v = np.asarray(contour).reshape(-1, 2).mean(axis=0).tolist()
            found.append(((float(u), float(v)), np.asarray(contour, np.int32)))
    return found


def long_components(narrow: Mask, camera: Pinhole, plane: float, least: float) -> list[tuple[float, float]]:
    """Return a central pixel (u, v) [px] of each long component in a mask of narrow regions.

    Args:
        narrow: the mask.
        camera: the camera.
        plane: height at which the length is measured [m].
        least: shorter components are ignored [m].
    """
    if cv2.countNonZero(narrow) > MOST_NARROW * narrow.size:  # noise, of which some parts are long by chance
        return []
    outer, _ = cv2.findContours(narrow, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    long = [np.asarray(c).reshape(-1, 2).astype(float) for c in outer if max(cv2.boundingRect(c)[2:]) >= _LEAST_POINTS]
    if not long:
        return []
    ends = np.array([points[[*points.argmin(axis=0), *points.argmax(axis=0)]] for points in long])
    ground = np.asarray(camera.on_plane(ends.reshape(-1, 2), plane)).reshape(len(long), 4, 2)
    found = []
    for points, on in zip(long, ground, strict=True):
        if np.isfinite(on).all() and np.linalg.norm(np.ptp(on, axis=0)) >= least:
            u, v = points[np.linalg.norm(points - points.mean(axis=0), axis=1).argmin()].tolist()
            found.append((float(u), float(v)))
    return found


def _off_border(pixels: Array, camera: Pinhole) -> npt.NDArray[np.bool_]:
    u, v = pixels[:, 0], pixels[:, 1]
    clear: npt.NDArray[np.bool_] = (u >= 1) & (u <= camera.width - 2) & (v >= 1) & (v <= camera.height - 2)
    return clear


def _outlines(blobs: Sequence[Sequence[Part]], camera: Pinhole) -> list[Outline]:
    """Return one outline for each blob; the rays of all blobs are computed at once."""
    pixels, normals, sizes = [np.empty((0, 2))], [np.empty((0, 2))], []
    for parts in blobs:
        sizes.append(0)
        for contour, is_hole in parts:
            points, inward_px = _inward(contour, camera, is_hole=is_hole)
            pixels.append(points)
            normals.append(inward_px)
            sizes[-1] += len(points)
    p, n = np.concatenate(pixels), np.concatenate(normals)
    n /= np.maximum(np.hypot(n[:, 0], n[:, 1]), 1e-12)[:, None]
    both = camera.directions(np.stack([p, p + n]))
    rays, inward = both[0], both[1] - both[0]
    inward -= np.einsum("ij,ij->i", inward, rays)[:, None] * rays
    inward /= np.sqrt(np.maximum(np.einsum("ij,ij->i", inward, inward), 1e-24))[:, None]
    ends = np.cumsum(sizes)
    cuts = [slice(end - size, end) for end, size in zip(ends, sizes, strict=True)]
    return [Outline(p[cut], rays[cut], inward[cut]) for cut in cuts]


def _inward(contour: Contour, camera: Pinhole, *, is_hole: bool) -> tuple[Array, Array]:
    """Return contour points (n, 2) off the image border, and directions (n, 2) into the red region [px]."""
    points = contour.reshape(-1, 2).astype(float)
    round_again = np.concatenate([points[-_REACH:], points, points[:_REACH]])
    along = round_again[2 * _REACH :] - round_again[: -2 * _REACH]
    turned = along[:, ::-1] * (-1.0, 1.0)
    # A quarter turn points into the area enclosed by a contour with positive orientation: for the edge of a hole,
    # the hole.
    if (cv2.contourArea(contour, oriented=True) > 0) == is_hole:
        turned = -turned
    keep = np.abs(turned).sum(axis=1) > 0
    clear = _off_border(points, camera)
    if not clear.all():  # a direction computed across the image border is not that of the outline
        keep &= clear & np.roll(clear, _REACH) & np.roll(clear, -_REACH)
    return points[keep], turned[keep]


Picture = npt.NDArray[np.uint8]
Window = tuple[tuple[int, int, int], tuple[int, int, int]]  # lower and upper end: hue, saturation, value
Rectangle = tuple[slice, slice]  # rows and columns

_SQUARE = np.ones((2, 2), np.uint8)
_MOST = 0.5  # fraction of the image; above it the complete image is processed


@dataclass(frozen=True)
class Colours:
    """What counts as red: windows in OpenCV's HSV, and the width of the ellipse for opening and closing [px]."""

    windows: tuple[Window, ...]
    kernel_px: int


class RedMasks(NamedTuple):
    """Red pixels (255) after opening, after closing as well, and those too narrow to remain after opening."""

    opened: Mask
    closed: Mask
    narrow: Mask


@dataclass(frozen=True)
class _Known:
    picture: Picture
    colours: Colours
    gain: float  # of green, to correct the color of the light
    table: BoolMask | None
    masks: RedMasks


class Masks:
    """Masks of successive images; only changed parts are computed, with the same result."""

    def __init__(self) -> None:
        """Start without an image."""
        self._known: _Known | None = None

    def of(self, picture: Picture, colours: Colours, table: BoolMask | None = None) -> RedMasks:
        """Return what is red in a bgr8 image. The masks must not be written to.

        Args:
            picture: the image.
            colours: what counts as red.
            table: where the table is visible, see `green_gain`; pass the identical array while it stays the same.
        """
        known, part = self._known, None
        if known is not None and known.colours == colours and known.picture.shape == picture.shape:
            part = changed(known.picture, picture)
            if part is None and known.table is table:
                return known.masks
        gain = green_gain(picture, table)
        if known is None or part is None or gain != known.gain or _share(part, picture) > _MOST:
            masks = _masks(amplify_green(picture, gain), colours)
            self._known = _Known(picture.copy(), colours, gain, table, masks)
            return masks
        reach = 4 * (colours.kernel_px // 2) + 2  # range over which a pixel affects the masks
        inner, outer = _grown(part, reach, picture), _grown(part, 2 * reach, picture)
        masks = RedMasks(*(mask.copy() for mask in known.masks))
        known.picture[part] = picture[part]
        offset = inner[0].start - outer[0].start, inner[1].start - outer[1].start
        size = inner[0].stop - inner[0].start, inner[1].stop - inner[1].start
        within = slice(offset[0], offset[0] + size[0]), slice(offset[1], offset[1] + size[1])
        for whole, fresh in zip(masks, _masks(amplify_green(picture[outer], gain), colours), strict=True):
            whole[inner] = fresh[within]
        self._known = _Known(known.picture, colours, gain, table, masks)
        return masks


def changed(before: Picture, after: Picture) -> Rectangle | None:
    """Return the rectangle in which two images of the same shape differ; None if they are equal."""
    other = _words(before) != _words(after)
    rows = np.flatnonzero(other.any(axis=1))
    if not len(rows):
        return None
    top, bottom = int(rows[0]), int(rows[-1]) + 1
    columns = np.flatnonzero(other[top:bottom].any(axis=0))
    width, words = before.shape[1], other.shape[1]
    left, right = int(columns[0]) * width // words, -(-(int(columns[-1]) + 1) * width // words)
    return slice(top, bottom), slice(left, right)


def _words(picture: Picture) -> npt.NDArray[np.unsignedinteger]:
    """Return the rows of an image as 64-bit words, which compare faster than bytes."""
    flat = np.ascontiguousarray(picture).reshape(len(picture), -1)
    return flat.view(np.uint64) if flat.shape[1] % 8 == 0 else flat


def _share(part: Rectangle, picture: Picture) -> float:
    return float(picture[part].size / picture.size)


def _grown(part: Rectangle, by: int, picture: Picture) -> Rectangle:
    rows, columns = (
        slice(max(0, side.start - by), min(size, side.stop + by))
        for side, size in zip(part, picture.shape[:2], strict=True)
    )
    return rows, columns


def _masks(picture: Picture, colours: Colours) -> RedMasks:
    hsv = cv2.cvtColor(picture, cv2.COLOR_BGR2HSV)
    red = np.zeros(picture.shape[:2], np.uint8)
    for low, high in colours.windows:
        red = np.asarray(cv2.bitwise_or(red, cv2.inRange(hsv, np.array(low), np.array(high))), np.uint8)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (colours.kernel_px, colours.kernel_px))
    opened = cv2.morphologyEx(red, cv2.MORPH_OPEN, kernel)
    closed = cv2.morphologyEx(opened, cv2.MORPH_CLOSE, kernel)
    # Exclude the rim of what remains, and noise: it has no 2x2 squares in a row.
    narrow = cv2.morphologyEx(cv2.subtract(red, cv2.dilate(opened, kernel)), cv2.MORPH_OPEN, _SQUARE)
    return RedMasks(*(np.asarray(mask, np.uint8) for mask in (opened, closed, narrow)))
