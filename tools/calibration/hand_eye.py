"""Where a camera is that sits on the hand, or looks at it: from views of a board for which the joints were read.

Camera on the hand, board fixed somewhere: the pose of the camera in the tool centre point is found, and where the board
is. Camera fixed, board on the hand: the pose of the camera in world is found, and how the board is held. In both cases
T_camera_board = A^-1 M B for each view, where M is known from the joints and A and B are the same for all views.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
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

LEAST_VIEWS = 6
_LEAST_TURN = math.radians(5)  # about a second axis, without which the position along the first cannot be told
_OUTLIER = 3.0, 0.3  # a view is dropped when its residual is above so many medians, and above so many [px]
_WORST_FIT = 5.0  # [px] rms above which the views do not belong together
_STEPS, _CLOSE = 30, 1e-9  # of the refinement at most; a step that is smaller ends it
_SUBSETS, _OF = 40, 4  # of the views, so many at a time, from which a first guess is made
GOOD, FAIR = 1e-3, 3e-3  # [m] of uncertainty of the position up to which a calibration is called so


@dataclass(frozen=True, eq=False)
class View:
    """A picture of the board, and the tool centre point in world (4, 4) when it was taken."""

    sighting: BoardDetection
    T_world_tcp: Array


@dataclass(frozen=True, eq=False)
class HandEyeCalibration:
    """A calibrated camera.

    Attributes:
        mount: whether it is on the hand or beside the arm.
        T_mount_camera: (4, 4) the optical frame in the tool centre point, or in world.
        T_other_board: (4, 4) the board in world, or in the tool centre point.
        position_std: standard deviation of the optical centre along x, y, z [m], of fits that leave out a view each.
        rotation_std: that of the rotation, over all axes [rad].
        rms: residual of all corners in the pictures [px]: of lens, joints and board together.
        rms_at_board: the same at the distance of the board [m].
        turned: how much the hand was turned about the axis that it was turned about least [rad].
        pictures: those that were fitted.
        dropped: those that did not fit.
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
        """Optical centre [m]."""
        x, y, z = self.T_mount_camera[:3, 3]
        return float(x), float(y), float(z)

    @property
    def rpy(self) -> tuple[float, float, float]:
        """Roll, pitch and yaw of the optical frame [rad], R = Rz Ry Rx."""
        return matrix_to_rpy(self.T_mount_camera[:3, :3])

    @property
    def verdict(self) -> str:
        """What a person may expect of it."""
        worst = max(*self.position_std, self.rms_at_board)
        if worst <= GOOD:
            return f"good: places are right to about {1e3 * worst:.1f} mm"
        said = f"{'fair' if worst <= FAIR else 'poor'}: places are right to about {1e3 * worst:.1f} mm only"
        if max(self.position_std) > self.rms_at_board:
            return f"{said}; more views, with the hand turned further to all sides, make it better"
        return (f"{said}; the views do not fit better: is the board flat and held fast, is the arm itself calibrated, "
                "did it rest?")


def calibrate_hand_eye(views: Sequence[View], camera: CameraFile, mount: Mount) -> HandEyeCalibration:
    """The poses that fit the corners of all views best; views that do not fit the others are dropped.

    Raises:
        CalibrationFailed: too few views, the hand was hardly turned, or the views contradict each other.
    """
    if len(views) < LEAST_VIEWS:
        raise CalibrationFailed(f"{len(views)} views of the board, {LEAST_VIEWS} are needed")
    turned = _turned(views)
    if turned < _LEAST_TURN:
        raise CalibrationFailed(
            f"the hand was turned by {math.degrees(turned):.0f} degrees about a second axis, "
            f"{math.degrees(_LEAST_TURN):.0f} are needed: tilt it to all sides, do not only turn it about one axis")
    problem = _Problem(views, camera, mount)
    dropped = []
    A, B = problem.begin()
    while True:
        A, B = problem.refined(A, B)
        residuals = [_rms(errors) for errors in problem.errors(A, B)]
        limit = max(_OUTLIER[0] * float(np.median(residuals)), _OUTLIER[1])
        worst = int(np.argmax(residuals))
        if residuals[worst] <= limit or len(problem.views) <= LEAST_VIEWS:
            break
        dropped.append(ViewResidual(problem.views[worst].sighting.name, len(problem.ideal[worst]), residuals[worst]))
        problem = _Problem([view for k, view in enumerate(problem.views) if k != worst], camera, mount)
    rms = _rms(np.concatenate(problem.errors(A, B)))
    if rms > _WORST_FIT or len(dropped) > len(problem.views):
        raise CalibrationFailed(
            f"the views do not fit together: residual {rms:.1f} px, {len(dropped)} of {len(views)} dropped; is the "
            f"camera {'on the hand' if mount == 'hand' else 'beside the arm'}, was the board or the camera moved, are "
            "the joints those of the pictures, are its squares as long?")
    position, rotation = problem.left_out(A, B)
    far = float(np.median([(invert(A) @ M @ B)[2, 3] for M in problem.known]))
    pictures = [ViewResidual(view.sighting.name, len(ideal), r)
                for view, ideal, r in zip(problem.views, problem.ideal, residuals, strict=True)]
    return HandEyeCalibration(mount, A, B, position, rotation, rms, rms * far / camera.fx, turned, pictures, dropped)


def _turned(views: Sequence[View]) -> float:
    """How much the hand was turned [rad] about the axis that comes second, of all turns from one view to another."""
    turns = [cv2.Rodrigues(a.T_world_tcp[:3, :3].T @ b.T_world_tcp[:3, :3])[0].ravel()
             for n, a in enumerate(views) for b in views[n + 1:]]
    return float(np.linalg.svd(np.array(turns), compute_uv=False)[1] / math.sqrt(len(turns)))


class _Problem:
    """What is known of the views: T_camera_board = A^-1 M B."""

    def __init__(self, views: Sequence[View], camera: CameraFile, mount: Mount) -> None:
        self.views, self._camera, self._mount, self._K = list(views), camera, mount, camera.matrix
        self.ideal = [camera.undistorted(view.sighting.pixels) for view in views]
        self.known = [invert(view.T_world_tcp) if mount == "hand" else view.T_world_tcp for view in views]

    def begin(self) -> tuple[Array, Array]:
        """A and B to begin with: of guesses from a few views each that which fits most views, as some may be wrong."""
        boards = [self._seen(n) for n in range(len(self.views))]
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

    def _seen(self, n: int) -> Array:
        """(4, 4) the board of a view in the optical frame, from its corners alone."""
        points, pixels, K = self.views[n].sighting.points, self.ideal[n][:, None], self._K
        found, rotation, translation = cv2.solvePnP(points, pixels, K, None, flags=cv2.SOLVEPNP_IPPE)
        if not found:
            raise CalibrationFailed(f"{self.views[n].sighting.name}: no pose of the board fits its corners")
        rotation, translation = cv2.solvePnPRefineLM(points, pixels, K, None, rotation, translation)
        return transform(np.asarray(cv2.Rodrigues(rotation)[0], float), np.ravel(translation))

    def errors(self, A: Array, B: Array, left_out: int = -1) -> list[Array]:
        """(n, 2) of each view [px]."""
        inverse = invert(A)
        found = []
        for n, (M, view, ideal) in enumerate(zip(self.known, self.views, self.ideal, strict=True)):
            if n == left_out:
                continue
            T = inverse @ M @ B
            p = view.sighting.points @ T[:3, :3].T + T[:3, 3]
            z = np.maximum(p[:, 2:], 1e-3)  # behind the camera it fits nothing, but is no division by 0
            found.append(p[:, :2] / z * np.diag(self._K)[:2] + self._K[:2, 2] - ideal)
        return found

    def refined(self, A: Array, B: Array, left_out: int = -1) -> tuple[Array, Array]:
        """A and B with the least residual over all corners: Levenberg and Marquardt's way down."""
        damping, residual = 1e-3, np.concatenate(self.errors(A, B, left_out)).ravel()
        for _ in range(_STEPS):
            J = np.stack([
                (np.concatenate(self.errors(*_moved(A, B, axis, 1e-6), left_out)).ravel() - residual) / 1e-6
                for axis in range(12)], axis=1)
            square, slope = J.T @ J, J.T @ residual
            step = np.asarray(-np.linalg.solve(square + damping * np.diag(np.diag(square) + 1e-12), slope), float)
            tried = _stepped(A, B, step)
            after = np.concatenate(self.errors(*tried, left_out)).ravel()
            if after @ after < residual @ residual:
                (A, B), residual, damping = tried, after, damping / 10
                if np.abs(step).max() < _CLOSE:
                    break
            else:
                damping *= 10
                if damping > 1e6:
                    break
        return A, B

    def left_out(self, A: Array, B: Array) -> tuple[tuple[float, float, float], float]:
        """Standard deviations of A's position [m] and rotation [rad]: the jackknife over views.

        Corners of a view err alike, as the arm does: how much the result hangs on each view says more than they do.
        """
        others = [self.refined(A, B, left_out=n)[0] for n in range(len(self.views))]
        scale = math.sqrt(len(others) - 1)
        moved = np.array([T[:3, 3] - A[:3, 3] for T in others])
        turned = np.array([cv2.Rodrigues(A[:3, :3].T @ T[:3, :3])[0].ravel() for T in others])
        x, y, z = scale * moved.std(axis=0)
        return (float(x), float(y), float(z)), float(scale * np.sqrt((turned.std(axis=0) ** 2).sum()))


def _guess(known: Sequence[Array], boards: Sequence[Array]) -> Array:
    """A (4, 4) from M and T_camera_board (4, 4) of some views.

    From one view to another P A = A Q, with P = Mj Mi^-1 and Q = Tj Ti^-1: the axes of the turns say how A is turned,
    then where it is follows linearly (F. Park, B. Martin, Robot sensor calibration: solving AX = XB on the Euclidean
    group, IEEE Transactions on Robotics and Automation 10 (1994), 717-721). OpenCV 5 has its own for C++ only.
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
    """A and B, each turned about its axes by three numbers [rad] and moved along them by three [m]."""
    a, b = (transform(np.asarray(cv2.Rodrigues(part[:3])[0], float), part[3:]) for part in (step[:6], step[6:]))
    return A @ a, B @ b


def _rms(errors: Array) -> float:
    """Root of the mean squared length of (n, 2) errors."""
    return float(np.sqrt((errors**2).sum(axis=1).mean()))
