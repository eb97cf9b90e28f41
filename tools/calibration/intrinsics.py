"""Camera intrinsics from images of a board: collect distinct views, then fit all of them."""

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
Pixels = npt.NDArray[np.uint8]

_REJECTIONS = {"nothing": "show no marker", "blurred": "are blurred", "few corners": "show too little of the board",
               "like another view": "repeat an earlier pose", "other board": "show another board",
               "dark": "are too dark", "flipped": "are mirrored or negatives", "other size": "have another size"}
_EXPLAINED = ("other board", "few corners", "flipped")  # rejections with an example
CELLS = 8, 6  # coverage grid of the image, columns and rows
_REGIONS = (("upper left", "upper middle", "upper right"), ("left", "middle", "right"),
            ("lower left", "lower middle", "lower right"))
_OUTLIER = 3.0, 0.15  # residual of a dropped view: times the median, and [px]
_MAX_UNCERTAINTY = 0.02  # relative standard deviation of the focal length; more: views too similar
_FIXED = (cv2.CALIB_FIX_K1, cv2.CALIB_FIX_K2, cv2.CALIB_FIX_K3, cv2.CALIB_FIX_K4, cv2.CALIB_FIX_K5, cv2.CALIB_FIX_K6)


class CalibrationFailed(ZencellError):
    """The images do not allow a calibration; the message says what is missing."""

    exit_code = 1


class CollectingOptions(Parameters):
    """Criteria for usable views."""

    least_views: int = Field(8, ge=3, le=1000, description="distinct views required")
    most_views: int = Field(60, ge=3, le=1000, description="distinct views at which collection stops")
    distinct: float = Field(0.04, gt=0, le=1, description="motion of the board that makes a new view, as a fraction "
                                                          "of the image diagonal")
    max_blur: float = Field(2.5, gt=0, le=50, description="largest standard deviation of edge blur [px]")
    k_coefficients: int = Field(2, ge=0, le=6, description="radial coefficients; 0: no distortion; above 3: "
                                                           "rational model")


@dataclass(frozen=True)
class ViewResidual:
    """Residual of one view."""

    name: str
    corners: int
    rms: float  # [px]


@dataclass(frozen=True, eq=False)
class IntrinsicCalibration:
    """Calibrated intrinsics.

    Attributes:
        size: width and height of the images [px].
        k: fx, fy, cx, cy [px].
        k_std: their standard deviations, from the residuals of corners assumed independent [px].
        d: distortion k1, k2, p1, p2, k3, ... as in OpenCV.
        rms: of all corners [px].
        views: fitted views.
        dropped: outlier views.
        coverage: fraction of the image's cells with a corner.
        unseen: regions of the image without a corner.
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
        """Number of fitted corners."""
        return sum(view.corners for view in self.views)


class ViewSelector:
    """Selects sharp views of the board that differ from earlier ones."""

    def __init__(self, board: Board, options: CollectingOptions | None = None) -> None:
        """Start without views."""
        self.board = board
        self.options = options or CollectingOptions()
        self._by_size: dict[tuple[int, int], list[BoardDetection]] = {}
        self.images = 0
        self._rejected: Counter[str] = Counter()
        self._example: dict[str, str] = {}

    @property
    def views(self) -> list[BoardDetection]:
        """The views of the most frequent size."""
        return max(self._by_size.values(), key=len, default=[])

    @property
    def complete(self) -> bool:
        """Whether more images would add little."""
        return len(self.views) >= self.options.most_views

    def add(self, image: Pixels, name: str) -> str:
        """Evaluate an image; return an empty string for a new view, else the reason."""
        self.images += 1
        detection = self.board.find(image, name)
        if isinstance(detection, NoBoard):
            return self._reject(detection.kind, detection.reason)
        if detection.blur > self.options.max_blur:
            return self._reject("blurred", f"edges are blurred over {detection.blur:.1f} px")
        same_size = self._by_size.setdefault(detection.size, [])
        nearest = min((_distance(detection, view) for view in same_size), default=np.inf)
        if nearest < self.options.distinct:
            return self._reject("like another view", "the board has the same pose as in another view")
        same_size.append(detection)
        return ""

    def require_enough(self) -> None:
        """Check that there are enough views.

        Raises:
            CalibrationFailed: there are too few; reports the count and why other images were rejected.
        """
        least = self.options.least_views
        if len(self.views) >= least:
            return
        hint = ""
        if self._rejected and (kind := self._rejected.most_common(1)[0][0]) in _EXPLAINED:
            hint = f" ({self._example[kind]})"
        missing = least - len(self.views)
        raise CalibrationFailed(
            f"{len(self.views)} of {self.images} images are usable views of the board ({self.board.options}), "
            f"{least} are needed, {missing} more; {self.rejections or 'there were no more images'}{hint}"
        )

    @property
    def rejections(self) -> str:
        """How many images were rejected, and why."""
        other_size = sum(map(len, self._by_size.values())) - len(self.views)
        counts = self._rejected + Counter({"other size": other_size})
        return ", ".join(f"{count} {_REJECTIONS[kind]}" for kind, count in counts.most_common())

    def coverage(self) -> tuple[float, list[str]]:
        """Fraction of image cells with a corner, and names of regions without any."""
        return coverage(self.views)

    def _reject(self, kind: str, reason: str) -> str:
        self._rejected[kind] += 1
        self._example.setdefault(kind, reason)
        return reason


def coverage(views: list[BoardDetection]) -> tuple[float, list[str]]:
    """Fraction of image cells with a corner, and names of the ninths of the image without any."""
    if not views:
        return 0.0, [name for row in _REGIONS for name in row]
    size = np.array(views[0].size)
    positions = np.clip((np.concatenate([view.pixels for view in views]) + 0.5) / size, 0, 1 - 1e-9)
    cells = {tuple(cell) for cell in (positions * CELLS).astype(int)}
    seen = {tuple(region) for region in (positions * 3).astype(int)}
    unseen = [name for y, row in enumerate(_REGIONS) for x, name in enumerate(row) if (x, y) not in seen]
    return len(cells) / (CELLS[0] * CELLS[1]), unseen


def calibrate_intrinsics(views: list[BoardDetection], options: CollectingOptions | None = None) -> IntrinsicCalibration:
    """Fit the intrinsics to all views; outlier views are dropped.

    Zhang's method with nonlinear refinement, by OpenCV. Z. Zhang, A flexible new technique for camera calibration, PAMI
    22 (2000), 1330-1334.

    Raises:
        CalibrationFailed: too few views are left, or they are too similar to determine the focal length.
    """
    o = options or CollectingOptions()
    remaining = list(views)
    dropped: list[ViewResidual] = []
    while True:
        if len(remaining) < o.least_views:
            worst = ", ".join(f"{view.name} {view.rms:.2f} px" for view in dropped[:3])
            raise CalibrationFailed(f"{len(remaining)} of {len(views)} views fit together, {o.least_views} are needed; "
                                    f"outliers: {worst}")
        rms, K, d, deviations, residuals = _fit(remaining, o.k_coefficients)
        limit = max(_OUTLIER[0] * float(np.median(residuals)), _OUTLIER[1])
        outliers = [k for k, residual in enumerate(residuals) if residual > limit]
        if not outliers:
            break
        worst_first = sorted(outliers, key=lambda k: -residuals[k])[: max(1, len(remaining) // 10)]
        dropped += [ViewResidual(remaining[k].name, len(remaining[k].points), float(residuals[k])) for k in worst_first]
        remaining = [view for k, view in enumerate(remaining) if k not in worst_first]
    k = float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
    k_std = float(deviations[0]), float(deviations[1]), float(deviations[2]), float(deviations[3])
    if not np.isfinite(k + k_std).all() or max(k_std[0] / k[0], k_std[1] / k[1]) > _MAX_UNCERTAINTY:
        raise CalibrationFailed(
            f"the views are too similar: the focal length would be {k[0]:.0f} +- {k_std[0]:.0f} px; "
            "tilt the board by 20 to 40 degrees in each direction"
        )
    covered, unseen = coverage(remaining)
    fitted = [ViewResidual(view.name, len(view.points), float(r)) for view, r in zip(remaining, residuals, strict=True)]
    return IntrinsicCalibration(remaining[0].size, k, k_std, d, float(rms), fitted, dropped, covered, unseen)


def _fit(views: list[BoardDetection], k_coefficients: int) -> tuple[float, Array, list[float], Array, Array]:
    """rms [px], K (3, 3), distortion, standard deviations, and rms of each view [px]."""
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
    """Standard deviations of fx, fy, cx, cy [px] for independent corner errors; infinite if undetermined.

    From the normal equations with the poses eliminated. OpenCV's own values are far too small if the views leave a
    parameter undetermined.
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
    eigenvalues = np.maximum(values, 1e-300)
    corners = sum(len(view.points) for view in views)
    freedom = max(2 * corners - count - 6 * len(views), 1)
    variances = rms**2 * corners / freedom * (vectors**2 / eigenvalues).sum(axis=1) / scale**2
    return np.asarray(np.sqrt(variances)[:4], float)


def _distance(a: BoardDetection, b: BoardDetection) -> float:
    """Mean distance of the board's outer corners between two views, as a fraction of the image diagonal."""
    apart = np.linalg.norm(a.outline - b.outline, axis=1).mean()
    return float(apart / np.hypot(*a.size))
