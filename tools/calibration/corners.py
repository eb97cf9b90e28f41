"""Refine board corners to a hundredth of a pixel by registering the image with the printed board.

The board is rendered around each corner as the camera sees it; a displacement, a gain and a brightness ramp are fitted
to all pixels: B. D. Lucas, T. Kanade, An iterative image registration technique, IJCAI 1981; S. Baker, I. Matthews,
Lucas-Kanade 20 years on, IJCV 56 (2004), 221-255. The displacement is quadratic in position, because the lens bends
straight lines. Saddle point refinement alone reaches a tenth of a pixel, because squares and markers are only a few
pixels apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Pixels = npt.NDArray[np.uint8]

PAGE_BLUR = 1.0  # [px] of a page
_PIXEL = 1 / 12  # [px^2] variance of a square pixel's aperture
_STEPS = 3
_OVERSAMPLING = 3  # samples along each pixel side when rendering
_REACH = 0.8  # half side of the compared window, in squares
_MIN_REACH, _MAX_REACH = 6, 40  # [px]
_NEIGHBORS = 9  # corners that define the local homography
_MAX_SHIFT = 2.0  # [px] of a valid corner
_MIN_FIT = 0.8  # fraction of brightness variance that the print must explain


@dataclass(frozen=True, eq=False)
class PrintedBoard:
    """The printed board at several resolutions.

    Attributes:
        pages: grey images with a border of one white square, blurred by one pixel so that they can be sampled.
        sides: pixels of a square in each page, increasing.
        rows: of squares.
        square: side length [m].
    """

    pages: list[npt.NDArray[np.float32]]
    sides: list[int]
    rows: int
    square: float

    def at(self, side: float) -> tuple[npt.NDArray[np.float32], Array, float]:
        """Select the page for squares of `side` pixels in the image.

        Returns:
            The page, (3, 3) from the board's frame [m] to its pixels, and its blur in pixels of the image.
        """
        level = next((k for k, fine in enumerate(self.sides) if fine >= 1.5 * side), len(self.sides) - 1)
        fine = self.sides[level]
        scale = fine / self.square
        to_pixels = np.array([[scale, 0, fine - 0.5], [0, -scale, (self.rows + 1) * fine - 0.5], [0, 0, 1]])
        return self.pages[level], to_pixels, PAGE_BLUR * side / fine


def refine(
    grey: Pixels, sheet: PrintedBoard, points: Array, pixels: Array, blur: float
) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Refine corner positions.

    Args:
        grey: the image.
        sheet: the printed board.
        points: (n, 2) corners in the board's frame [m], at least four.
        pixels: (n, 2) approximate positions [px].
        blur: standard deviation of edge blur [px].

    Returns:
        (n, 2) refined positions [px], and (n,) which corners match the print.
    """
    start, current = pixels, pixels.copy()
    valid = np.ones(len(points), bool)
    near = np.argsort(np.linalg.norm(points[:, None] - points[None], axis=2), axis=1)[:, :_NEIGHBORS]
    for _ in range(_STEPS):
        refined = current.copy()
        for k in np.flatnonzero(valid):
            H = _local(points, current, near[k], valid)
            moved = None if H is None else _step(grey, sheet, H, points[k], blur)
            if moved is None or np.linalg.norm(moved - start[k]) > _MAX_SHIFT:
                valid[k] = False
            else:
                refined[k] = moved
        current = refined
    return current, valid


def _local(points: Array, pixels: Array, near: npt.NDArray[np.intp], valid: npt.NDArray[np.bool_]) -> Array | None:
    """(3, 3) homography from the board to the image by the corners near one of them, passing through that one."""
    selected = [k for k in near if valid[k]]
    center = points[near[0]]
    if len(selected) < 5 or np.linalg.matrix_rank(points[selected] - center, 1e-6) < 2:
        selected = list(np.flatnonzero(valid))
    if len(selected) < 4:
        return None
    H = homography(points[selected], pixels[selected])
    if H is None:
        return None
    off = pixels[near[0]] - mapped(H, center[None])[0]
    through: Array = np.array([[1, 0, off[0]], [0, 1, off[1]], [0, 0, 1.0]]) @ H
    return through


def _step(grey: Pixels, sheet: PrintedBoard, H: Array, point: Array, blur: float) -> Array | None:
    """One refinement step of a corner; None if the image does not match the print there."""
    center = mapped(H, point[None])[0]
    ends = mapped(H, point + sheet.square * np.array([[1, 0], [0, 1.0]]))
    side = float(np.linalg.norm(ends - center, axis=1).min())
    reach = int(np.clip(_REACH * side, _MIN_REACH, _MAX_REACH))
    low = np.round(center).astype(int) - reach
    high = low + 2 * reach + 1
    if (low < 0).any() or high[0] > grey.shape[1] or high[1] > grey.shape[0]:
        cut = np.maximum(np.maximum(-low, high - (grey.shape[1], grey.shape[0])), 0).max()
        if reach - cut < _MIN_REACH:
            return None
        reach -= int(cut)
        low, high = low + cut, high - cut
    seen = grey[low[1] : high[1], low[0] : high[0]].astype(float)
    drawn = _render(sheet, H, low, reach, side, blur)
    across, down = np.gradient(drawn, axis=1), np.gradient(drawn, axis=0)
    x = np.broadcast_to((low[0] - center[0] + np.arange(2 * reach + 1)) / reach, drawn.shape)
    y = np.broadcast_to(((low[1] - center[1]) + np.arange(2 * reach + 1))[:, None] / reach, drawn.shape)
    ones = np.ones_like(drawn)
    # seen(p) = gain drawn(p - motion(p)) + ramp is linear in gain, gain times motion, and the ramp.
    motion = (ones, x, y, x * x, x * y, y * y)
    terms = (drawn, *(across * part for part in motion), *(down * part for part in motion), ones, x, y)
    A = np.stack([term.ravel() for term in terms], axis=1)
    try:
        found = np.linalg.solve(A.T @ A, A.T @ seen.ravel())
    except np.linalg.LinAlgError:  # uniform image
        return None
    gain, residual = found[0], seen.ravel() - A @ found
    if gain <= 0.05 or residual.var() > (1 - _MIN_FIT) * seen.var():
        return None
    moved: Array = center - np.array([found[1], found[7]]) / gain
    return moved


def _render(sheet: PrintedBoard, H: Array, low: npt.NDArray[np.intp], reach: int, side: float, blur: float) -> Array:
    """Render the board around a corner as the camera sees it: (2 reach + 1, 2 reach + 1)."""
    margin = 3  # [px] for the blur kernel
    size = 2 * (reach + margin) + 1
    page, to_pixels, page_blur = sheet.at(side)
    # From oversampled window pixels to page pixels.
    shift = (1 / _OVERSAMPLING - 1) / 2 - margin
    to_picture = np.array([[1 / _OVERSAMPLING, 0, low[0] + shift], [0, 1 / _OVERSAMPLING, low[1] + shift], [0, 0, 1.0]])
    to_page = to_pixels @ np.linalg.inv(H) @ to_picture
    fine = cv2.warpPerspective(
        page, to_page, (size * _OVERSAMPLING, size * _OVERSAMPLING),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderValue=255,
    )
    drawn = np.asarray(cv2.resize(fine, (size, size), interpolation=cv2.INTER_AREA), float)
    extra_blur = float(np.sqrt(max(blur**2 - page_blur**2 - _PIXEL, 0.0)))
    if extra_blur > 0.2:
        drawn = np.asarray(cv2.GaussianBlur(drawn, (0, 0), extra_blur), float)
    return drawn[margin:-margin, margin:-margin]


def homography(points: Array, pixels: Array) -> Array | None:
    """(3, 3) least squares homography from points (n, 2) to pixels (n, 2); None if undetermined."""
    found: object = cv2.findHomography(points, pixels)[0]  # may be None, despite OpenCV's types
    return None if found is None else np.array(found, float)


def mapped(H: Array, points: Array) -> Array:
    """Map points (n, 2) by a homography (3, 3)."""
    return np.asarray(cv2.perspectiveTransform(points[:, None].astype(float), H), float)[:, 0]
