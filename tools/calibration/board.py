"""The ChArUco calibration board: print it and detect it.

The frame of a board has its origin at the lower left corner of the printed squares, x right, y up, z out of the paper:
on a board lying face up, z points up.
"""

from __future__ import annotations

from dataclasses import dataclass
from statistics import NormalDist
from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from common.config import Parameters
from tools.calibration.corners import PAGE_BLUR, PrintedBoard, homography, mapped, refine

Array = npt.NDArray[np.float64]
Pixels = npt.NDArray[np.uint8]

Dictionary = Literal["4x4_50", "4x4_250", "5x5_50", "5x5_250", "6x6_50", "6x6_250", "apriltag_36h11"]

_MARGIN = 0.012  # [m] white border; the lower one holds the print instructions
_PRINT_DENSITY = 300 / 0.0254  # [px/m], about
_MIN_CORNERS = 6
MIN_MARKERS = 4  # that determine how they are arranged
_DARK = 30  # [grey levels] of the brightest part
_MIN_FITTING = 0.7  # fraction of markers that must match the board
_MARKER_TOLERANCE = 0.1, 1.5  # of marker length: relative, or shrinkage by blur [px]
_PAGE_SIDES = (24, 48, 96, 192)  # [px] of a square in the reference pages
_WINDOW = 15  # [px] of edge analysis
_MIN_CONTRAST = 30  # grey levels needed to judge blur
_BLURRED = 1.3  # [px] blur that explains a failed detection


class BoardOptions(Parameters):
    """A printed board. The default fits on A4 paper."""

    columns: int = Field(7, ge=3, le=50, description="squares along x")
    rows: int = Field(5, ge=3, le=50, description="squares along y")
    square: float = Field(0.036, gt=0, le=1, description="length of a square [m]")
    marker: float = Field(0.027, gt=0, le=1, description="length of a marker [m]")
    dictionary: Dictionary = Field("4x4_50", description="dictionary of the markers")
    legacy: bool = Field(False, description="pattern of OpenCV before 4.6: with an even number of rows, the upper left "
                                            "square is white")

    @model_validator(mode="after")
    def _fits_together(self) -> BoardOptions:
        if not 0.4 * self.square <= self.marker <= 0.95 * self.square:
            raise ValueError(f"marker {self.marker:g} must be 0.4 to 0.95 of square {self.square:g}")
        have, need = len(_dictionary(self.dictionary).bytesList), self.columns * self.rows // 2
        if need > have:
            raise ValueError(f"{self.columns}x{self.rows} squares need {need} markers; dictionary has {have}")
        return self

    def __str__(self) -> str:
        return (f"{self.columns} x {self.rows} squares of {1e3 * self.square:g} mm, "
                f"markers of {1e3 * self.marker:g} mm, {self.dictionary}{', legacy' if self.legacy else ''}")


@dataclass(frozen=True, eq=False)
class BoardDetection:
    """Inner corners of a board detected in an image.

    Attributes:
        name: of the image.
        size: width and height of the image [px].
        points: (n, 3) corners in the board's frame [m].
        pixels: (n, 2) the same corners in the image; (0, 0) is the center of the upper left pixel [px].
        blur: standard deviation of edge blur [px].
        outline: (4, 2) outer corners of the board, inside the image or not [px].
    """

    name: str
    size: tuple[int, int]
    points: Array
    pixels: Array
    blur: float
    outline: Array


@dataclass(frozen=True)
class NoBoard:
    """Why an image shows no board: `kind` for counting, `reason` for people."""

    kind: Literal["nothing", "blurred", "few corners", "other board", "dark", "flipped"]
    reason: str


class Board:
    """A ChArUco board: draws and detects itself."""

    def __init__(self, options: BoardOptions | None = None) -> None:
        """Prepare the detector."""
        o = self.options = options or BoardOptions()
        self._board = _charuco(o)
        self._detector = cv2.aruco.CharucoDetector(self._board)
        self._markers = self._markers_of(self._board)
        self.corners = self._to_board_frame(self._board.getChessboardCorners())
        """(n, 3) inner corners in the frame of the board [m], z = 0."""

        pages = []
        for side in _PAGE_SIDES:
            page = np.pad(self._draw(side), side, constant_values=255)
            pages.append(np.asarray(cv2.GaussianBlur(page, (0, 0), PAGE_BLUR), np.float32))
        self._print = PrintedBoard(pages, list(_PAGE_SIDES), o.rows, o.square)

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of all squares [m]."""
        return self.options.columns * self.options.square, self.options.rows * self.options.square

    def _markers_of(self, board: cv2.aruco.CharucoBoard) -> dict[int, Array]:
        """(4, 2) corners of each marker in the board's frame [m]."""
        return {int(number): self._to_board_frame(corners)[:, :2]
                for number, corners in zip(board.getIds(), board.getObjPoints(), strict=True)}

    def _to_board_frame(self, points: npt.ArrayLike) -> Array:
        """Convert from OpenCV's frame (origin upper left, y down) to the board's."""
        p = np.array(points, dtype=float).reshape(-1, 3)
        return p * (1, -1, 1) + (0, self.size[1], 0)

    def _draw(self, side: int) -> npt.NDArray[np.float32]:
        """Draw squares of `side` pixels, antialiased; OpenCV rounds markers to whole pixels."""
        o, dictionary = self.options, self._board.getDictionary()
        dark = np.indices((o.rows, o.columns)).sum(axis=0) % 2 == (o.legacy and o.rows % 2 == 0)
        page = np.where(np.kron(dark, np.ones((side, side), bool)), np.float32(0), np.float32(255))
        cells = dictionary.markerSize + 2
        for number, corners in zip(self._board.getIds(), self._board.getObjPoints(), strict=True):
            low = np.asarray(corners, float)[0, :2] * side / o.square
            marker = cv2.aruco.generateImageMarker(dictionary, int(number), cells).astype(float)
            first = np.floor(low).astype(int)
            count = int(np.ceil(side * o.marker / o.square)) + 1
            edges = np.arange(cells + 1) * side * o.marker / o.square / cells
            across, down = (_overlap(edges + low[axis] - first[axis], count) for axis in (0, 1))
            page[first[1] : first[1] + count, first[0] : first[0] + count] += down @ (marker - 255) @ across.T
        return np.asarray(page, np.float32)

    def page(self) -> tuple[Pixels, float]:
        """Return the grey image to print, with instructions in its border, and its density [px/m].

        The density is slightly below 300 dpi: squares and, if possible, marker cells are whole numbers of pixels.
        """
        o = self.options
        bits = self._board.getDictionary().markerSize + 2
        near = round(_PRINT_DENSITY * o.square)
        side = min(range(max(16, int(0.95 * near)), max(16, near) + 1), key=lambda side: _rounding_error(side, o, bits))
        density = side / o.square
        margin = round(_MARGIN * density)
        page = np.pad(np.asarray(np.rint(self._draw(side)), np.uint8), margin, constant_values=255)
        bottom, mm = page.shape[0] - margin, density / 1000
        length = min(100, int(1e3 * o.columns * o.square) // 10 * 10)  # [mm]
        right, y = margin + round(length * mm), round(bottom + 3 * mm)
        cv2.line(page, (margin, y), (right, y), 0, 2)
        for x in (margin, right):
            cv2.line(page, (x, round(y - mm)), (x, round(y + mm)), 0, 2)
        lines = (f"print at 100 %: this line is {length} mm long    {o}",
                 "frame: origin at the lower left corner of the squares, x to the right, y up, z towards you")
        for row, text in enumerate(lines):
            place, scale = (margin, round(bottom + (6.0 + 3.2 * row) * mm)), 0.09 * mm
            cv2.putText(page, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, 0, max(1, round(0.15 * mm)), cv2.LINE_AA)
        return page, density

    def find(self, image: Pixels, name: str) -> BoardDetection | NoBoard:
        """Detect the board in a bgr8 or grey image; otherwise return the reason."""
        grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8) if image.ndim == 3 else image
        pixels, ids, marker_pixels, marker_ids = self._detector.detectBoard(grey)
        if (marker_ids is None or len(marker_ids) < MIN_MARKERS) and (flipped := self._flipped(grey)):
            return flipped
        if marker_ids is None or not len(marker_ids):
            return _too_poor(grey) or NoBoard("nothing", "no marker is visible")
        markers = {int(number): np.asarray(corners, float).reshape(4, 2)
                   for number, corners in zip(np.ravel(marker_ids), marker_pixels, strict=True)}
        mismatch = self._other_board(markers)
        if mismatch:
            return self._flipped(grey) or NoBoard("other board", mismatch)
        if ids is None or len(ids) < _MIN_CORNERS or self._board.checkCharucoCornersCollinear(ids):
            return _too_poor(grey) or NoBoard("few corners", f"{0 if ids is None else len(ids)} corners are visible; "
                                                            f"{_MIN_CORNERS} not on one line are needed")
        points, found = self.corners[np.ravel(ids)], np.asarray(pixels, float).reshape(-1, 2)
        mismatch = self._other_length(homography(points[:, :2], found), markers)
        if mismatch:
            return _too_poor(grey) or NoBoard("other board", mismatch)
        low, high = np.maximum(found.min(axis=0) - _WINDOW, 0).astype(int), found.max(axis=0).astype(int) + _WINDOW
        blur = _blur(grey[low[1] : high[1], low[0] : high[0]])
        found, matching = refine(grey, self._print, points[:, :2], found, blur)
        if matching.sum() < _MIN_CORNERS or np.linalg.matrix_rank(points[matching] - points[matching][0], 1e-6) < 2:
            return _too_poor(grey) or NoBoard("few corners", f"{matching.sum()} of {len(matching)} corners match the "
                                                            f"print; {_MIN_CORNERS} not on one line are needed")
        points, found = points[matching], found[matching]
        H = homography(points[:, :2], found)
        if H is None:
            return NoBoard("few corners", "the visible corners do not determine the pose of the board")
        width, height = self.size
        outer = np.array([[0, 0], [width, 0], [width, height], [0, height]])
        outline = mapped(H, outer)
        size = (grey.shape[1], grey.shape[0])
        return BoardDetection(name, size, points, found, blur, outline)

    def _other_board(self, markers: dict[int, Array]) -> str:
        """Why the visible markers belong to another board; empty if they match."""
        foreign = [number for number in markers if number not in self._markers]
        if len(foreign) > 0.3 * len(markers):
            return (f"marker {max(foreign)} is not on a board of {self.options.columns}x{self.options.rows} squares, "
                    f"which has {len(self._markers)}")
        o, share = self.options, _share(markers, self._markers)
        mismatch = f"the layout of the markers differs from a board of {o.columns}x{o.rows} squares"
        other = o.model_copy(update={"legacy": not o.legacy})
        if _share(markers, self._markers_of(_charuco(other))) > max(share + 0.05, _MIN_FITTING):
            return mismatch + (", but is that of OpenCV before 4.6: add --legacy" if other.legacy else
                               " of OpenCV before 4.6: leave out --legacy")
        return "" if share >= _MIN_FITTING else mismatch

    def _flipped(self, grey: Pixels) -> NoBoard | None:
        """Return that the image is mirrored or a negative if the markers fit the board only otherwise."""
        for changed, name in ((cv2.flip(grey, 1), "mirrored"), (255 - grey, "a negative")):
            _, _, found, ids = self._detector.detectBoard(np.ascontiguousarray(changed))
            markers = {int(number): np.asarray(corners, float).reshape(4, 2)
                       for number, corners in zip(np.ravel(ids if ids is not None else ()), found, strict=False)}
            known = markers.keys() & self._markers.keys()
            if len(known) >= MIN_MARKERS and _share(markers, self._markers) >= _MIN_FITTING:
                return NoBoard("flipped", f"the image is {name}: its markers can be read only after undoing that")
        return None

    def _other_length(self, H: Array | None, markers: dict[int, Array]) -> str:
        """Why the marker length differs from the board's; empty if it matches or is unknown."""
        if H is None or not (set(markers) & set(self._markers)):
            return ""
        back = np.asarray(np.linalg.inv(H), float)
        known = [corners for number, corners in markers.items() if number in self._markers]
        length = float(np.median([_side(mapped(back, corners)) for corners in known]))
        pixels = float(np.median([_side(corners) for corners in known]))
        relative, blurred = _MARKER_TOLERANCE
        if abs(length / self.options.marker - 1) <= max(relative, blurred / pixels):
            return ""
        return (f"markers are {length / self.options.square:.2f} of a square long, not "
                f"{self.options.marker / self.options.square:.2f} as {1e3 * self.options.marker:g} mm would be")


def _charuco(o: BoardOptions) -> cv2.aruco.CharucoBoard:
    board = cv2.aruco.CharucoBoard((o.columns, o.rows), o.square, o.marker, _dictionary(o.dictionary))
    board.setLegacyPattern(o.legacy)
    return board


def _share(markers: dict[int, Array], expected: dict[int, Array]) -> float:
    """Share of the known markers that are arranged as expected; 1 if they are too few."""
    known = [number for number in markers if number in expected]
    if len(known) < MIN_MARKERS:
        return 1.0
    points = np.array([expected[number].mean(axis=0) for number in known])
    seen = np.array([markers[number].mean(axis=0) for number in known])
    side = float(np.median([_side(markers[number]) for number in known]))
    _, fitting = cv2.findHomography(points, seen, cv2.RANSAC, max(2.0, 0.25 * side))
    return 1.0 if fitting is None else float(fitting.mean())


def _dictionary(name: str) -> cv2.aruco.Dictionary:
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name.upper()}"))


def _overlap(edges: Array, count: int) -> Array:
    """(count, n) fraction of each of `count` pixels covered by each of the n intervals between edges [px]."""
    low = np.arange(count)[:, None]
    return np.asarray(np.clip(np.minimum(low + 1, edges[1:]) - np.maximum(low, edges[:-1]), 0, 1), float)


def _side(corners: Array) -> float:
    """Mean side length of a (4, 2) polygon."""
    return float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).mean())


def _rounding_error(side: int, options: BoardOptions, bits: int) -> float:
    """Deviation of marker edges from whole pixels at a square side [px]."""
    edge = side * (options.square - options.marker) / options.square / 2
    cell = side * options.marker / options.square / bits
    return round(abs(edge - round(edge)) + bits * abs(cell - round(cell)), 6)


def _too_poor(grey: Pixels) -> NoBoard | None:
    """Why an image cannot show a board: too dark or blurred; None if it can."""
    low, high = np.percentile(grey, (1, 99))
    if high < _DARK:
        return NoBoard("dark", f"too dark: its brightest part is {high:.0f} of 255")
    if high - low < _MIN_CONTRAST:
        return None
    blur = _blur(grey)
    return NoBoard("blurred", f"edges are blurred over {blur:.1f} px") if blur > _BLURRED else None


def _blur(grey: Pixels) -> float:
    """Standard deviation of the blur of the strongest edges in an image [px]; about 0.4 if sharp.

    A step of height h, blurred by a Gaussian of deviation s, rises by h (2 Phi(1 / s) - 1) over two pixels.
    """
    around = np.ones((_WINDOW, _WINDOW), np.uint8)
    height = np.asarray(cv2.morphologyEx(grey, cv2.MORPH_GRADIENT, around), float)
    across, down = cv2.Sobel(grey, cv2.CV_64F, 1, 0, scale=1 / 8), cv2.Sobel(grey, cv2.CV_64F, 0, 1, scale=1 / 8)
    slope = np.asarray(cv2.dilate(np.hypot(across, down), around), float)
    edges = height >= 0.7 * float(np.percentile(height, 99))
    rise = float(np.median(slope[edges] / np.maximum(height[edges], 1.0)))  # per pixel, of the whole step
    return 1 / NormalDist().inv_cdf(0.5 + min(max(rise, 1e-3), 0.499))
