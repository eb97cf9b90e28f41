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
Part = tuple[Contour, bool]  # a contour, and whether it is that of a hole
Traced = tuple[tuple[bytes, bool], ...]  # the parts of an outline

_REACH = 3  # contour points to either side from which the direction of the outline is taken
MOST_NARROW = 0.05  # part of a picture that may be narrow for what is long in it to be told
_LEAST_POINTS = 16  # shorter contours are specks or pin holes


@dataclass(frozen=True)
class Outline:
    """Points on the edge of something red, as rays; the edge of the picture is not an edge of it.

    Attributes:
        pixels: (n, 2) [px].
        rays: (n, 3) unit vectors in world, from the optical centre.
        inward: (n, 3) unit vectors in world, perpendicular to the ray and to the edge, into the red.
    """

    pixels: Array
    rays: Array
    inward: Array

    def __len__(self) -> int:
        return len(self.pixels)

    def take(self, which: npt.NDArray[np.bool_] | npt.NDArray[np.intp]) -> Outline:
        """The points that an index or boolean array picks."""
        return Outline(self.pixels[which], self.rays[which], self.inward[which])


def all_of(outlines: Sequence[Outline]) -> tuple[Outline, npt.NDArray[np.intp]]:
    """The points of one or more outlines as one, and the index of the outline that each is of (n,)."""
    pixels, rays, inward = (np.concatenate([getattr(each, name) for each in outlines])
                            for name in ("pixels", "rays", "inward"))
    return Outline(pixels, rays, inward), np.repeat(np.arange(len(outlines)), [len(each) for each in outlines])


@dataclass(frozen=True)
class Blob:
    """One connected region.

    Attributes:
        area: inside its outer edge [px^2].
        centroid: (2,) of its area [px].
        outline: of the regions of the finer mask within it, holes included.
        border: (m, 2) its pixels at the border of the picture [px].
        traced: the pixels of its outline, as they were followed.
    """

    area: float
    centroid: Array
    outline: Outline
    border: Array
    traced: Traced = ()


def find_blobs(
    closed: Mask, fine: Mask, camera: Pinhole, min_area: float, known: Mapping[Traced, Outline] | None = None
) -> list[Blob]:
    """Blobs of the closed mask of at least `min_area` [px^2], outlined by the finer mask from before closing.

    Closing bridges the gaps between near neighbours and fills notches: what a ball looks like is in the finer mask.

    Args:
        closed: what is red, closed.
        fine: what is red, before closing.
        camera: the camera.
        min_area: smaller blobs are left out [px^2].
        known: outlines of the same camera's last picture by what was traced: that of a blob which is there again is
            the very same one.
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
    again = known or {}
    anew = iter(_outlines([parts for parts, key in zip(within, traced, strict=True) if key not in again], camera))
    outlines = [again[key] if key in again else next(anew) for key in traced]
    for (contour, area), outline, key in zip(large, outlines, traced, strict=True):
        moments = cv2.moments(contour)
        centroid = np.array([moments["m10"], moments["m01"]]) / moments["m00"]
        flat = contour.reshape(-1, 2).astype(float)
        border = flat[~_off_border(flat, camera)]
        blobs.append(Blob(area, centroid, outline, border, key))
    return blobs


def small_blobs(closed: Mask, min_area: float) -> list[tuple[float, float]]:
    """Where there are blobs of less than `min_area` [px^2] in the closed mask: centres (u, v) [px]."""
    outer, _ = cv2.findContours(closed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    small = [np.asarray(c).reshape(-1, 2).mean(axis=0) for c in outer if cv2.contourArea(c) < min_area]
    return [(float(u), float(v)) for u, v in small]


def middles(closed: Mask, min_area: float) -> list[tuple[tuple[float, float], Contour]]:
    """Blobs of at least `min_area` [px^2] in the closed mask: the middle (u, v) [px] and the outer edge of each."""
    outer, _ = cv2.findContours(closed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    found = []
    for contour in outer:
        if cv2.contourArea(contour) >= min_area:
            u, v = np.asarray(contour).reshape(-1, 2).mean(axis=0).tolist()
            found.append(((float(u), float(v)), np.asarray(contour, np.int32)))
    return found


def long_ones(narrow: Mask, camera: Pinhole, plane: float, least: float) -> list[tuple[float, float]]:
    """Where a mask of narrow things has one that is long: a pixel (u, v) on it, in the middle of its outline [px].

    Args:
        narrow: the mask.
        camera: the camera.
        plane: height at which its length is taken [m].
        least: shorter ones are left out [m].
    """
    if cv2.countNonZero(narrow) > MOST_NARROW * narrow.size:  # specks all over, of which some are long by chance
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
    """One outline for each blob, of all its parts; the rays are computed for all of them at once."""
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
    """Points (n, 2) of a contour that are not at the border of the picture, and directions (n, 2) into the red [px]."""
    points = contour.reshape(-1, 2).astype(float)
    round_again = np.concatenate([points[-_REACH:], points, points[:_REACH]])
    along = round_again[2 * _REACH :] - round_again[: -2 * _REACH]
    turned = along[:, ::-1] * (-1.0, 1.0)
    # Turning a quarter leads into the area that a contour with positive orientation encloses: for the edge of a hole
    # that is the hole.
    if (cv2.contourArea(contour, oriented=True) > 0) == is_hole:
        turned = -turned
    keep = np.abs(turned).sum(axis=1) > 0
    clear = _off_border(points, camera)
    if not clear.all():  # a direction taken across the border of the picture is not that of the outline
        keep &= clear & np.roll(clear, _REACH) & np.roll(clear, -_REACH)
    return points[keep], turned[keep]


Picture = npt.NDArray[np.uint8]
Window = tuple[tuple[int, int, int], tuple[int, int, int]]  # lower and upper end: hue, saturation, value
Rectangle = tuple[slice, slice]  # rows and columns

_SQUARE = np.ones((2, 2), np.uint8)
_MOST = 0.5  # of a picture: where more has changed, all of it is looked at


@dataclass(frozen=True)
class Colours:
    """What counts as red: windows in OpenCV's HSV, and the width of the ellipse for opening and closing [px]."""

    windows: tuple[Window, ...]
    kernel_px: int


class RedMasks(NamedTuple):
    """What is red, 255 where it is: opened; then closed; and what is too narrow to outlive opening."""

    opened: Mask
    closed: Mask
    narrow: Mask


@dataclass(frozen=True)
class _Known:
    picture: Picture
    colours: Colours
    gain: float  # of green, for the colour of the light
    table: BoolMask | None
    masks: RedMasks


class Masks:
    """Masks of one picture after the other: for each the same as if it were the first."""

    def __init__(self) -> None:
        """Nothing was seen yet."""
        self._known: _Known | None = None

    def of(self, picture: Picture, colours: Colours, table: BoolMask | None = None) -> RedMasks:
        """What is red in a bgr8 picture. The masks are not to be written to.

        Args:
            picture: the picture.
            colours: what counts as red.
            table: where it is shown, see `green_gain`: the very same array as long as it is there.
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
        reach = 4 * (colours.kernel_px // 2) + 2  # of erosion and dilation, twice: so far a pixel acts on the masks
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
    """The rectangle in which two pictures of one shape differ; None where they do not."""
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
    """The rows of a picture as long words, which are compared sooner than bytes; their last axis is its width."""
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
    # Not the rim of what outlived, nor specks: noise has no squares of four pixels in a row.
    narrow = cv2.morphologyEx(cv2.subtract(red, cv2.dilate(opened, kernel)), cv2.MORPH_OPEN, _SQUARE)
    return RedMasks(*(np.asarray(mask, np.uint8) for mask in (opened, closed, narrow)))
