"""Intrinsics of a camera from pictures of a board: distinct views are collected, then everything is fitted at once."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import Field

from common.config import Parameters
from common.errors import ZencellError
from tools.calibration.board import Board, BoardDetection, NoBoard

Array = npt.NDArray[np.float64]
Picture = npt.NDArray[np.uint8]

CELLS = 8, 6  # of the picture, across and down: where corners were seen
_REGIONS = (("upper left", "upper middle", "upper right"), ("left", "middle", "right"),
            ("lower left", "lower middle", "lower right"))
_OUTLIER = 3.0, 0.15  # a view is dropped when its residual is above so many medians, and above so many [px]
_MOST_UNCERTAIN = 0.02  # of the focal length, one standard deviation; more means that the views are too much alike
_FIXED = (cv2.CALIB_FIX_K1, cv2.CALIB_FIX_K2, cv2.CALIB_FIX_K3, cv2.CALIB_FIX_K4, cv2.CALIB_FIX_K5, cv2.CALIB_FIX_K6)


class CalibrationFailed(ZencellError):
    """Pictures that a camera cannot be calibrated with: says what is missing."""

    exit_code = 1


class CollectingOptions(Parameters):
    """Which pictures count."""

    least_views: int = Field(8, ge=3, le=1000, description="distinct views that are needed")
    most_views: int = Field(60, ge=3, le=1000, description="distinct views at which collecting ends")
    distinct: float = Field(0.04, gt=0, le=1, description="a view is new when the board moved by this part of the "
                                                          "picture's diagonal")
    max_blur: float = Field(2.5, gt=0, le=50, description="standard deviation of smeared edges [px]")
    k_coefficients: int = Field(2, ge=0, le=6, description="radial coefficients; 0: no distortion at all, above 3: "
                                                           "the rational model")


@dataclass(frozen=True)
class ViewResidual:
    """How well a view fits."""

    name: str
    corners: int
    rms: float  # [px]


@dataclass(frozen=True, eq=False)
class IntrinsicCalibration:
    """A calibrated lens.

    Attributes:
        size: width and height of the pictures [px].
        k: fx, fy, cx, cy [px].
        k_std: standard deviation of each of them, from the residuals of corners that are taken as independent [px].
        d: distortion k1, k2, p1, p2, k3, ... as OpenCV's.
        rms: of all corners [px].
        views: those that were fitted.
        dropped: those that did not fit.
        coverage: part of the picture's cells in which a corner was seen.
        unseen: regions of the picture in which no corner was seen.
    """

    size: tuple[int, int]
    k: tuple[float, float, float, float]
    k_std: tuple[float, float, float, float]
    d: list[float]
    rms: float
    views: list[ViewResidual]
    dropped: list[ViewResidual]
    coverage: float
    unseen: list[str]

    @property
    def corners(self) -> int:
        """How many corners were fitted."""
        return sum(view.corners for view in self.views)


class ViewSelector:
    """Takes pictures one after another and keeps views of the board that are sharp and unlike those before."""

    def __init__(self, board: Board, options: CollectingOptions | None = None) -> None:
        """No picture was seen yet."""
        self.board = board
        self.options = options or CollectingOptions()
        self.views: list[BoardDetection] = []
        self.pictures = 0
        self._left_out: Counter[str] = Counter()
        self._example: dict[str, str] = {}

    @property
    def complete(self) -> bool:
        """Whether further pictures would add little."""
        return len(self.views) >= self.options.most_views

    def add(self, picture: Picture, name: str) -> str:
        """Look at a picture; empty when it is a new view, else why it is not.

        Raises:
            CalibrationFailed: it has another size than the ones before.
        """
        self.pictures += 1
        sighting = self.board.find(picture, name)
        if isinstance(sighting, NoBoard):
            return self._leave_out(sighting.kind, sighting.reason)
        if self.views and sighting.size != self.views[0].size:
            raise CalibrationFailed(f"{name} is {sighting.size[0]}x{sighting.size[1]}, but {self.views[0].name} is "
                                    f"{self.views[0].size[0]}x{self.views[0].size[1]}: one size is needed")
        if sighting.blur > self.options.max_blur:
            return self._leave_out("blurred", f"edges are smeared over {sighting.blur:.1f} px")
        nearest = min((_distance(sighting, view) for view in self.views), default=np.inf)
        if nearest < self.options.distinct:
            return self._leave_out("like another view", "the board is where it was in another view")
        self.views.append(sighting)
        return ""

    def require_enough(self) -> None:
        """Return when there are enough views.

        Raises:
            CalibrationFailed: there are not; says how many there are and what became of the other pictures.
        """
        least = self.options.least_views
        if len(self.views) >= least:
            return
        said = {"nothing": "show no marker", "blurred": "are blurred", "few corners": "show too little of the board",
                "like another view": "show it where it was before", "other board": "show another board"}
        parts = [f"{count} {said[kind]}" for kind, count in self._left_out.most_common()]
        hint = ""
        if self._left_out and (kind := self._left_out.most_common(1)[0][0]) in ("other board", "few corners"):
            hint = f" ({self._example[kind]})"
        missing = least - len(self.views)
        raise CalibrationFailed(
            f"{len(self.views)} of {self.pictures} pictures are usable views of the board ({self.board.options}), "
            f"{least} are needed, {missing} more; {', '.join(parts) or 'there were no more pictures'}{hint}"
        )

    def coverage(self) -> tuple[float, list[str]]:
        """Part of the picture's cells in which a corner was seen, and names of regions without any."""
        return coverage(self.views)

    def _leave_out(self, kind: str, reason: str) -> str:
        self._left_out[kind] += 1
        self._example.setdefault(kind, reason)
        return reason


def coverage(views: list[BoardDetection]) -> tuple[float, list[str]]:
    """Part of the picture's cells in which a corner was seen, and names of the ninths of it without any."""
    if not views:
        return 0.0, [name for row in _REGIONS for name in row]
    size = np.array(views[0].size)
    places = np.clip((np.concatenate([view.pixels for view in views]) + 0.5) / size, 0, 1 - 1e-9)
    cells = {tuple(cell) for cell in (places * CELLS).astype(int)}
    seen = {tuple(region) for region in (places * 3).astype(int)}
    unseen = [name for y, row in enumerate(_REGIONS) for x, name in enumerate(row) if (x, y) not in seen]
    return len(cells) / (CELLS[0] * CELLS[1]), unseen


def calibrate_intrinsics(views: list[BoardDetection], options: CollectingOptions | None = None) -> IntrinsicCalibration:
    """The lens that fits all views best; views that do not fit the others are dropped.

    Zhang's method, refined over all corners, as OpenCV has it. Z. Zhang, A flexible new technique for camera
    calibration, PAMI 22 (2000), 1330-1334.

    Raises:
        CalibrationFailed: too few views are left, or they are too much alike to tell the focal length.
    """
    o = options or CollectingOptions()
    left = list(views)
    dropped: list[ViewResidual] = []
    while True:
        if len(left) < o.least_views:
            worst = ", ".join(f"{view.name} {view.rms:.2f} px" for view in dropped[:3])
            raise CalibrationFailed(f"{len(left)} of {len(views)} views fit together, {o.least_views} are needed; "
                                    f"do not fit: {worst}")
        rms, K, d, deviations, residuals = _fit(left, o.k_coefficients)
        limit = max(_OUTLIER[0] * float(np.median(residuals)), _OUTLIER[1])
        bad = [k for k, residual in enumerate(residuals) if residual > limit]
        if not bad:
            break
        worst_first = sorted(bad, key=lambda k: -residuals[k])[: max(1, len(left) // 10)]
        dropped += [ViewResidual(left[k].name, len(left[k].points), float(residuals[k])) for k in worst_first]
        left = [view for k, view in enumerate(left) if k not in worst_first]
    k = float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
    k_std = float(deviations[0]), float(deviations[1]), float(deviations[2]), float(deviations[3])
    if not np.isfinite(k + k_std).all() or max(k_std[0] / k[0], k_std[1] / k[1]) > _MOST_UNCERTAIN:
        raise CalibrationFailed(
            f"the views are too much alike: the focal length would be {k[0]:.0f} +- {k_std[0]:.0f} px; "
            "tilt the board by 20 to 40 degrees, to each side"
        )
    part, unseen = coverage(left)
    fitted = [ViewResidual(view.name, len(view.points), float(r)) for view, r in zip(left, residuals, strict=True)]
    return IntrinsicCalibration(left[0].size, k, k_std, d, float(rms), fitted, dropped, part, unseen)


def _fit(views: list[BoardDetection], k_coefficients: int) -> tuple[float, Array, list[float], Array, Array]:
    """rms [px], K (3, 3), distortion, standard deviations, and the rms of each view [px]."""
    flags = sum(_FIXED[k_coefficients:]) | (cv2.CALIB_RATIONAL_MODEL if k_coefficients > 3 else 0)
    if k_coefficients == 0:
        flags |= cv2.CALIB_ZERO_TANGENT_DIST
    points = [np.ascontiguousarray(view.points, np.float32) for view in views]
    pixels = [np.ascontiguousarray(view.pixels[:, None], np.float32) for view in views]
    try:
        rms, K, d, rotations, translations, _, _, residuals = cv2.calibrateCameraExtended(  # type: ignore[call-overload]
            points, pixels, views[0].size, None, None, flags=flags
        )
    except cv2.error as error:
        raise CalibrationFailed(f"no lens fits these {len(views)} views: {error.err}") from None
    length = 0 if k_coefficients == 0 else 4 if k_coefficients < 3 else 5 if k_coefficients == 3 else 8
    distortion = [float(value) for value in np.ravel(d)[:length]]
    poses = list(zip(rotations, translations, strict=True))
    K = np.asarray(K, float)
    return rms, K, distortion, _deviations(views, K, distortion, poses, rms), np.ravel(residuals)


def _deviations(
    views: list[BoardDetection], K: Array, distortion: list[float], poses: list[tuple[Array, Array]], rms: float
) -> Array:
    """Standard deviations of fx, fy, cx, cy [px] when corners err independently; infinite for what cannot be told.

    From the normal equations, of which the poses of the views are eliminated. OpenCV has its own, but they are tiny
    where the views leave a parameter open.
    """
    count = 4 + len(distortion)
    normal = np.zeros((count, count))
    for view, (rotation, translation) in zip(views, poses, strict=True):
        d = np.array(distortion or [0.0] * 4)
        _, jacobian = cv2.projectPoints(view.points, np.asarray(rotation), np.asarray(translation), K, d)
        J, P = np.asarray(jacobian)[:, 6 : 6 + count], np.asarray(jacobian)[:, :6]
        normal += J.T @ J - J.T @ P @ np.linalg.pinv(P.T @ P) @ P.T @ J
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    values, vectors = np.linalg.eigh(normal / np.outer(scale, scale))
    told = np.maximum(values, 1e-300)
    corners = sum(len(view.points) for view in views)
    freedom = max(2 * corners - count - 6 * len(views), 1)
    variances = rms**2 * corners / freedom * (vectors**2 / told).sum(axis=1) / scale**2
    return np.asarray(np.sqrt(variances)[:4], float)


def _distance(a: BoardDetection, b: BoardDetection) -> float:
    """How far the outer corners of the board lie apart in two views, as a part of the picture's diagonal."""
    apart = np.linalg.norm(a.outline - b.outline, axis=1).mean()
    return float(apart / np.hypot(*a.size))
