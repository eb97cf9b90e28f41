"""Places the corners of a board to a hundredth of a pixel, by comparing the picture with what was printed.

Around each corner the printed board is drawn as the camera would see it there, and a motion, a gain and a ramp of
brightness are fitted to all pixels: B. D. Lucas, T. Kanade, An iterative image registration technique, IJCAI 1981;
S. Baker, I. Matthews, Lucas-Kanade 20 years on, IJCV 56 (2004), 221-255. The motion is quadratic in place, because the
lens bends what is drawn straight. Saddle points alone give a tenth of a pixel, because between the squares and the
markers there are only a few pixels to look at.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Picture = npt.NDArray[np.uint8]

SMEARED = 1.0  # [px] of a page
_PIXEL = 1 / 12  # [px^2] variance of a pixel, which sees all of its square
_STEPS = 3
_FINER = 3  # rays along each side of a pixel when the board is drawn
_REACH = 0.8  # half side of what is compared, in squares
_LEAST_REACH, _MOST_REACH = 6, 40  # [px]
_NEIGHBOURS = 9  # corners that say how the board lies around one of them
_MOST_SHIFT = 2.0  # [px]; a corner that goes further was none
_LEAST_FIT = 0.8  # part of the variation of brightness that the printed board must explain


@dataclass(frozen=True, eq=False)
class Print:
    """What is printed, as coarse as a camera may see it.

    Attributes:
        pages: grey pictures, each smeared by one of its pixels so that it can be sampled, one square of white around.
        sides: pixels of a square in each of them, increasing.
        rows: of squares.
        square: length of one [m].
    """

    pages: list[npt.NDArray[np.float32]]
    sides: list[int]
    rows: int
    square: float

    def at(self, side: float) -> tuple[npt.NDArray[np.float32], Array, float]:
        """For a picture in which squares have that side [px]: page, (3, 3) from the board's frame [m] to its pixels,
        and the deviation by which it is smeared, in pixels of the picture."""
        level = next((k for k, fine in enumerate(self.sides) if fine >= 1.5 * side), len(self.sides) - 1)
        fine = self.sides[level]
        scale = fine / self.square
        to_pixels = np.array([[scale, 0, fine - 0.5], [0, -scale, (self.rows + 1) * fine - 0.5], [0, 0, 1]])
        return self.pages[level], to_pixels, SMEARED * side / fine


def refine(
    grey: Picture, sheet: Print, points: Array, pixels: Array, blur: float
) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Places of corners in the picture (n, 2) [px], and which of them look as they should (n,).

    Args:
        grey: the picture.
        sheet: what is printed.
        points: (n, 2) the corners in the board's frame [m], at least four.
        pixels: (n, 2) about where they are seen [px].
        blur: standard deviation of smeared edges [px].
    """
    start, here = pixels, pixels.copy()
    good = np.ones(len(points), bool)
    near = np.argsort(np.linalg.norm(points[:, None] - points[None], axis=2), axis=1)[:, :_NEIGHBOURS]
    for _ in range(_STEPS):
        there = here.copy()
        for k in np.flatnonzero(good):
            H = _local(points, here, near[k], good)
            moved = None if H is None else _step(grey, sheet, H, points[k], blur)
            if moved is None or np.linalg.norm(moved - start[k]) > _MOST_SHIFT:
                good[k] = False
            else:
                there[k] = moved
        here = there
    return here, good


def _local(points: Array, pixels: Array, near: npt.NDArray[np.intp], good: npt.NDArray[np.bool_]) -> Array | None:
    """(3, 3) from the board's frame to the picture, as the corners near one of them say; it passes through that one."""
    chosen = [k for k in near if good[k]]
    middle = points[near[0]]
    if len(chosen) < 5 or np.linalg.matrix_rank(points[chosen] - middle, 1e-6) < 2:
        chosen = list(np.flatnonzero(good))
    if len(chosen) < 4:
        return None
    H = homography(points[chosen], pixels[chosen])
    if H is None:
        return None
    off = pixels[near[0]] - mapped(H, middle[None])[0]
    through: Array = np.array([[1, 0, off[0]], [0, 1, off[1]], [0, 0, 1.0]]) @ H
    return through


def _step(grey: Picture, sheet: Print, H: Array, point: Array, blur: float) -> Array | None:
    """Where the corner is, one step nearer; None when the picture does not look like the board there."""
    middle = mapped(H, point[None])[0]
    ends = mapped(H, point + sheet.square * np.array([[1, 0], [0, 1.0]]))
    side = float(np.linalg.norm(ends - middle, axis=1).min())
    reach = int(np.clip(_REACH * side, _LEAST_REACH, _MOST_REACH))
    low = np.round(middle).astype(int) - reach
    high = low + 2 * reach + 1
    if (low < 0).any() or high[0] > grey.shape[1] or high[1] > grey.shape[0]:
        cut = np.maximum(np.maximum(-low, high - (grey.shape[1], grey.shape[0])), 0).max()
        if reach - cut < _LEAST_REACH:
            return None
        reach -= int(cut)
        low, high = low + cut, high - cut
    seen = grey[low[1] : high[1], low[0] : high[0]].astype(float)
    drawn = _drawn(sheet, H, low, reach, side, blur)
    across, down = np.gradient(drawn, axis=1), np.gradient(drawn, axis=0)
    x = np.broadcast_to((low[0] - middle[0] + np.arange(2 * reach + 1)) / reach, drawn.shape)
    y = np.broadcast_to(((low[1] - middle[1]) + np.arange(2 * reach + 1))[:, None] / reach, drawn.shape)
    one = np.ones_like(drawn)
    # seen(p) = gain drawn(p - motion(p)) + ramp: linear in gain, gain times motion, and the ramp.
    motion = (one, x, y, x * x, x * y, y * y)
    terms = (drawn, *(across * part for part in motion), *(down * part for part in motion), one, x, y)
    A = np.stack([term.ravel() for term in terms], axis=1)
    try:
        found = np.linalg.solve(A.T @ A, A.T @ seen.ravel())
    except np.linalg.LinAlgError:  # one colour only
        return None
    gain, left = found[0], seen.ravel() - A @ found
    if gain <= 0.05 or left.var() > (1 - _LEAST_FIT) * seen.var():
        return None
    moved: Array = middle - np.array([found[1], found[7]]) / gain
    return moved


def _drawn(sheet: Print, H: Array, low: npt.NDArray[np.intp], reach: int, side: float, blur: float) -> Array:
    """The board around a corner as the camera would see it: (2 reach + 1, 2 reach + 1)."""
    margin = 3  # [px], so that smearing knows what comes from outside
    whole = 2 * (reach + margin) + 1
    page, to_pixels, smeared = sheet.at(side)
    # From parts of pixels of the window to pixels of the page.
    shift = (1 / _FINER - 1) / 2 - margin
    to_picture = np.array([[1 / _FINER, 0, low[0] + shift], [0, 1 / _FINER, low[1] + shift], [0, 0, 1.0]])
    to_page = to_pixels @ np.linalg.inv(H) @ to_picture
    fine = cv2.warpPerspective(
        page, to_page, (whole * _FINER, whole * _FINER), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderValue=255
    )
    drawn = np.asarray(cv2.resize(fine, (whole, whole), interpolation=cv2.INTER_AREA), float)
    more = float(np.sqrt(max(blur**2 - smeared**2 - _PIXEL, 0.0)))
    if more > 0.2:
        drawn = np.asarray(cv2.GaussianBlur(drawn, (0, 0), more), float)
    return drawn[margin:-margin, margin:-margin]


def homography(points: Array, pixels: Array) -> Array | None:
    """(3, 3) from points (n, 2) to pixels (n, 2) with the least squares of errors; None when they do not tell."""
    found: object = cv2.findHomography(points, pixels)[0]  # None sometimes, which OpenCV's types do not say
    return None if found is None else np.array(found, float)


def mapped(H: Array, points: Array) -> Array:
    """Points (n, 2) through a homography (3, 3)."""
    return np.asarray(cv2.perspectiveTransform(points[:, None].astype(float), H), float)[:, 0]
