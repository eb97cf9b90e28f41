"""Hand-eye calibration: pose of a camera on the gripper or next to the arm, from views of a board and joint readings.

Camera on the gripper, board fixed: finds the camera in the tool center point, and the board in world. Camera fixed,
board on the gripper: finds the camera in world, and the board in the tool center point. In both cases
T_camera_board = A^-1 M B for each view, where M follows from the joints and A and B are constant.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt

from common.perception.camera_file import CameraFile
from common.robot.transforms import invert, matrix_to_rpy, transform
from tools.calibration.board import BoardDetection
from tools.calibration.intrinsics import CalibrationFailed, ViewResidual

Array = npt.NDArray[np.float64]
Mount = Literal["hand", "beside"]

MIN_VIEWS = 6
_MIN_ROTATION = math.radians(5)  # about a second axis; without it the position along the first is undetermined
_OUTLIER = 3.0, 0.3  # residual of a dropped view: times the median, and [px]
_MAX_RMS = 5.0  # [px] above which the views are inconsistent
_STEPS, _CLOSE = 30, 1e-9  # of the refinement: limit, and step size that ends it
_SUBSETS, _OF = 40, 4  # random subsets for the initial guess, and views in each
GOOD, FAIR = 1e-3, 3e-3  # [m] limits of the position uncertainty


@dataclass(frozen=True, eq=False)
class View:
    """A detection of the board, and the tool center point in world (4, 4) and joints (n,) at that time."""

    detection: BoardDetection
    T_world_tcp: Array
    q: Array = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True, eq=False)
class HandEyeCalibration:
    """A calibrated camera.

    Attributes:
        mount: on the gripper ("hand") or fixed next to the arm ("beside").
        T_mount_camera: (4, 4) optical frame in the tool center point, or in world.
        T_other_board: (4, 4) board in world, or in the tool center point.
        position_std: standard deviation of the optical center along x, y, z [m], by leaving out each view.
        rotation_std: that of the rotation over all axes [rad].
        rms: residual of all corners in the images [px]: of lens, joints and board together.
        rms_at_board: the same at the distance of the board [m].
        turned: rotation range about the axis with the second largest one [rad].
        pictures: fitted views.
        dropped: outlier views.
    """

    mount: Mount
    T_mount_camera: Array
    T_other_board: Array
    position_std: tuple[float, float, float]
    rotation_std: float
    rms: float
    rms_at_board: float
    turned: float
    pictures: list[ViewResidual]
    dropped: list[ViewResidual]

    @property
    def position(self) -> tuple[float, float, float]:
        """Optical center [m]."""
        x, y, z = self.T_mount_camera[:3, 3]
        return float(x), float(y), float(z)

    @property
    def rpy(self) -> tuple[float, float, float]:
        """Roll, pitch and yaw of the optical frame [rad], R = Rz Ry Rx."""
        return matrix_to_rpy(self.T_mount_camera[:3, :3])

    @property
    def verdict(self) -> str:
        """Expected accuracy, and how to improve it."""
        worst = max(*self.position_std, self.rms_at_board)
        if worst <= GOOD:
            return f"good: accurate to about {1e3 * worst:.1f} mm"
        verdict = f"{'fair' if worst <= FAIR else 'poor'}: accurate to about {1e3 * worst:.1f} mm only"
        if max(self.position_std) > self.rms_at_board:
            return f"{verdict}; take more views, with the gripper tilted further in all directions"
        return (f"{verdict}; the residual limits it: check that the board is flat and fixed, the arm is calibrated, "
                "and was at rest")


def calibrate_hand_eye(views: Sequence[View], camera: CameraFile, mount: Mount) -> HandEyeCalibration:
    """Fit both poses to the corners of all views; outlier views are dropped.

    Raises:
        CalibrationFailed: too few views, too little rotation of the gripper, or inconsistent views.
    """
    if len(views) < MIN_VIEWS:
        raise CalibrationFailed(f"{len(views)} views of the board, {MIN_VIEWS} are needed")
    turned = _rotation_range(views)
    if turned < _MIN_ROTATION:
        raise CalibrationFailed(
            f"the gripper was rotated by {math.degrees(turned):.0f} degrees about a second axis, "
            f"{math.degrees(_MIN_ROTATION):.0f} are needed: tilt it in all directions")
    problem = _Problem(views, camera, mount)
    dropped = []
    A, B = problem.initial_guess()
    while True:
        A, B = problem.refined(A, B)
        residuals = [_rms(errors) for errors in problem.errors(A, B)]
        limit = max(_OUTLIER[0] * float(np.median(residuals)), _OUTLIER[1])
        worst = int(np.argmax(residuals))
        if residuals[worst] <= limit or len(problem.views) <= MIN_VIEWS:
            break
        dropped.append(ViewResidual(problem.views[worst].detection.name, len(problem.ideal[worst]), residuals[worst]))
        problem = _Problem([view for k, view in enumerate(problem.views) if k != worst], camera, mount)
    rms = _rms(np.concatenate(problem.errors(A, B)))
    if rms > _MAX_RMS or len(dropped) > len(problem.views):
        raise CalibrationFailed(
            f"the views are inconsistent: residual {rms:.1f} px, {len(dropped)} of {len(views)} dropped; check "
            f"that the camera is {'on the gripper' if mount == 'hand' else 'next to the arm'}, that nothing slipped, "
            "that the joints belong to the images, and the square size")
    position, rotation = problem.jackknife(A, B)
    far = float(np.median([(invert(A) @ M @ B)[2, 3] for M in problem.known]))
    pictures = [ViewResidual(view.detection.name, len(ideal), r)
                for view, ideal, r in zip(problem.views, problem.ideal, residuals, strict=True)]
    return HandEyeCalibration(mount, A, B, position, rotation, rms, rms * far / camera.fx, turned, pictures, dropped)


def _rotation_range(views: Sequence[View]) -> float:
    """Rotation [rad] about the second principal axis of all rotations between views."""
    turns = [cv2.Rodrigues(a.T_world_tcp[:3, :3].T @ b.T_world_tcp[:3, :3])[0].ravel()
             for n, a in enumerate(views) for b in views[n + 1:]]
    return float(np.linalg.svd(np.array(turns), compute_uv=False)[1] / math.sqrt(len(turns)))


class _Problem:
    """The views of the problem T_camera_board = A^-1 M B."""

    def __init__(self, views: Sequence[View], camera: CameraFile, mount: Mount) -> None:
        self.views, self._camera, self._mount, self._K = list(views), camera, mount, camera.matrix
        self.ideal = [camera.undistorted(view.detection.pixels) for view in views]
        self.known = [invert(view.T_world_tcp) if mount == "hand" else view.T_world_tcp for view in views]

    def initial_guess(self) -> tuple[Array, Array]:
        """Initial A and B: of guesses from random subsets, the one that fits most views; robust to outliers."""
        boards = [self._board_pose(n) for n in range(len(self.views))]
        rng, every = np.random.default_rng(0), np.arange(len(boards))
        best, least = None, math.inf
        for subset in [every, *(rng.choice(every, _OF, replace=False) for _ in range(_SUBSETS))]:
            A = _guess([self.known[n] for n in subset], [boards[n] for n in subset])
            for n in subset:
                B = invert(self.known[n]) @ A @ boards[n]
                residual = float(np.median([_rms(errors) for errors in self.errors(A, B)]))
                if residual < least:
                    best, least = (A, B), residual
        if best is None:
            raise CalibrationFailed("no pose of the camera fits the views")
        return best

    def _board_pose(self, n: int) -> Array:
        """(4, 4) board in the optical frame, from the corners of one view."""
        points, pixels, K = self.views[n].detection.points, self.ideal[n][:, None], self._K
        found, rotation, translation = cv2.solvePnP(points, pixels, K, None, flags=cv2.SOLVEPNP_IPPE)
        if not found:
            raise CalibrationFailed(f"{self.views[n].detection.name}: no pose of the board fits its corners")
        rotation, translation = cv2.solvePnPRefineLM(points, pixels, K, None, rotation, translation)
        return transform(np.asarray(cv2.Rodrigues(rotation)[0], float), np.ravel(translation))

    def errors(self, A: Array, B: Array, jackknife: int = -1) -> list[Array]:
        """(n, 2) of each view [px]."""
        inverse = invert(A)
        found = []
        for n, (M, view, ideal) in enumerate(zip(self.known, self.views, self.ideal, strict=True)):
            if n == jackknife:
                continue
            T = inverse @ M @ B
            p = view.detection.points @ T[:3, :3].T + T[:3, 3]
            z = np.maximum(p[:, 2:], 1e-3)  # avoids division by 0 behind the camera
            found.append(p[:, :2] / z * np.diag(self._K)[:2] + self._K[:2, 2] - ideal)
        return found

    def refined(self, A: Array, B: Array, jackknife: int = -1) -> tuple[Array, Array]:
        """Refine A and B to the least residual over all corners by Levenberg-Marquardt."""
        damping, residual = 1e-3, np.concatenate(self.errors(A, B, jackknife)).ravel()
        for _ in range(_STEPS):
            J = np.stack([
                (np.concatenate(self.errors(*_moved(A, B, axis, 1e-6), jackknife)).ravel() - residual) / 1e-6
                for axis in range(12)], axis=1)
            square, slope = J.T @ J, J.T @ residual
            step = np.asarray(-np.linalg.solve(square + damping * np.diag(np.diag(square) + 1e-12), slope), float)
            candidate = _stepped(A, B, step)
            new_residual = np.concatenate(self.errors(*candidate, jackknife)).ravel()
            if new_residual @ new_residual < residual @ residual:
                (A, B), residual, damping = candidate, new_residual, damping / 10
                if np.abs(step).max() < _CLOSE:
                    break
            else:
                damping *= 10
                if damping > 1e6:
                    break
        return A, B

    def jackknife(self, A: Array, B: Array) -> tuple[tuple[float, float, float], float]:
        """Standard deviations of A's position [m] and rotation [rad] by the jackknife over views.

        Errors within a view are correlated, as those of the arm are; the influence of each view is the better measure.
        """
        others = [self.refined(A, B, jackknife=n)[0] for n in range(len(self.views))]
        scale = math.sqrt(len(others) - 1)
        moved = np.array([T[:3, 3] - A[:3, 3] for T in others])
        turned = np.array([cv2.Rodrigues(A[:3, :3].T @ T[:3, :3])[0].ravel() for T in others])
        x, y, z = scale * moved.std(axis=0)
        return (float(x), float(y), float(z)), float(scale * np.sqrt((turned.std(axis=0) ** 2).sum()))


def _guess(known: Sequence[Array], boards: Sequence[Array]) -> Array:
    """A (4, 4) from M and T_camera_board (4, 4) of some views.

    Between two views P A = A Q, with P = Mj Mi^-1 and Q = Tj Ti^-1: the rotation axes determine the rotation of A, then
    its translation follows linearly (F. Park, B. Martin, Robot sensor calibration: solving AX = XB on the Euclidean
    group, IEEE Transactions on Robotics and Automation 10 (1994), 717-721). OpenCV 5 offers its own in C++ only.
    """
    pairs = [(n, k) for n in range(len(known)) for k in range(n + 1, len(known))]
    moved = [(known[k] @ invert(known[n]), boards[k] @ invert(boards[n])) for n, k in pairs]
    P, Q = (np.array([cv2.Rodrigues(T[:3, :3])[0].ravel() for T in side]) for side in zip(*moved, strict=True))
    U, _, V = np.linalg.svd(P.T @ Q)
    R = U @ np.diag([1, 1, np.linalg.det(U @ V)]) @ V
    left = np.concatenate([p[:3, :3] - np.eye(3) for p, _ in moved])
    right = np.concatenate([R @ q[:3, 3] - p[:3, 3] for p, q in moved])
    return transform(R, np.linalg.lstsq(left, right)[0])


def _moved(A: Array, B: Array, axis: int, by: float) -> tuple[Array, Array]:
    step = np.zeros(12)
    step[axis] = by
    return _stepped(A, B, step)


def _stepped(A: Array, B: Array, step: Array) -> tuple[Array, Array]:
    """A and B, each rotated about its axes by three numbers [rad] and translated along them by three [m]."""
    a, b = (transform(np.asarray(cv2.Rodrigues(part[:3])[0], float), part[3:]) for part in (step[:6], step[6:]))
    return A @ a, B @ b


def _rms(errors: Array) -> float:
    """Root mean square length of (n, 2) errors."""
    return float(np.sqrt((errors**2).sum(axis=1).mean()))
