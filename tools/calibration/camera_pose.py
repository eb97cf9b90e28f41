"""Pose of a fixed camera in world, from images of a board at measured poses."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from common.perception.camera_file import CameraFile
from common.perception.image_sources import read_images
from common.robot.transforms import invert, matrix_to_rpy, transform
from tools.calibration.board import Board, BoardDetection, NoBoard
from tools.calibration.intrinsics import CalibrationFailed, ViewResidual

Array = npt.NDArray[np.float64]

_OUTLIER = 3.0, 0.2  # residual of a dropped image: times the median, and [px]
_MAX_RMS = 2.0  # [px] above which board or camera moved, or the given board pose is wrong
_GRID = 5  # points along each image side at which uncertainty is evaluated


@dataclass(frozen=True, eq=False)
class PoseCalibration:
    """A calibrated pose.

    Attributes:
        T_world_camera: (4, 4) pose of the optical frame in world.
        position_std: standard deviation of the optical center along x, y, z of world [m].
        rotation_std: standard deviation of the rotation over all axes [rad].
        place_std: standard deviation of a point on the board's plane, at the worst point of the image [m].
        rms: residual of all corners in the image [px].
        rms_on_board: residual of all corners on the board [m].
        pictures: fitted images.
        dropped: outlier images.
    """

    T_world_camera: Array
    position_std: tuple[float, float, float]
    rotation_std: float
    place_std: float
    rms: float
    rms_on_board: float
    pictures: list[ViewResidual]
    dropped: list[ViewResidual]

    @property
    def position(self) -> tuple[float, float, float]:
        """Optical center in world [m]."""
        x, y, z = self.T_world_camera[:3, 3]
        return float(x), float(y), float(z)

    @property
    def rpy(self) -> tuple[float, float, float]:
        """Roll, pitch and yaw of the optical frame in world [rad], R = Rz Ry Rx."""
        return matrix_to_rpy(self.T_world_camera[:3, :3])


@dataclass(frozen=True, eq=False)
class _PlacedDetection:
    """A detection with its board's pose: corners in world (n, 3) [m], and undistorted pixels."""

    detection: BoardDetection
    T_world_board: Array
    points: Array
    ideal: Array  # (n, 1, 2) [px], undistorted


def calibrate_pose(
    places: Sequence[tuple[Array, Sequence[BoardDetection]]], camera: CameraFile
) -> PoseCalibration:
    """Fit the camera pose to the corners of all images; outlier images are dropped.

    Args:
        places: pose of the board in world (4, 4), and its detections there; the camera does not move.
        camera: its intrinsics.

    Raises:
        CalibrationFailed: no image shows the board, it has another size, or the images are inconsistent.
    """
    detected = [_undistorted(detection, T, camera) for T, detections in places for detection in detections]
    if not detected:
        raise CalibrationFailed("no image shows the board")
    K, dropped = camera.matrix, []
    while True:
        T_camera_world = _fit(detected, K)
        errors = [_errors(view, T_camera_world, K) for view in detected]
        residuals = [_rms(e) for e in errors]
        limit = max(_OUTLIER[0] * float(np.median(residuals)), _OUTLIER[1])
        worst = int(np.argmax(residuals))
        if residuals[worst] <= limit or len(detected) == 1:
            break
        dropped.append(ViewResidual(detected[worst].detection.name, len(errors[worst]), residuals[worst]))
        detected = [view for k, view in enumerate(detected) if k != worst]
    rms = _rms(np.concatenate(errors))
    if rms > _MAX_RMS or len(dropped) > len(detected):
        raise CalibrationFailed(
            f"the images are inconsistent: residual {rms:.1f} px, {len(dropped)} of {len(dropped) + len(detected)} "
            "dropped; check that camera and board did not move, and the given pose and square size of the board"
        )
    T_world_camera = invert(T_camera_world)
    position, rotation, place = _uncertainty(detected, T_camera_world, K, rms, camera)
    on_board = np.concatenate([_on_board(view, T_world_camera, K) for view in detected])
    pictures = [ViewResidual(view.detection.name, len(view.points), r)
                for view, r in zip(detected, residuals, strict=True)]
    return PoseCalibration(T_world_camera, position, rotation, place, rms, _rms(on_board), pictures, dropped)


def detect_boards_in(
    source: str, board: Board, camera: CameraFile, most: int, seconds: float, report: Callable[[str], object]
) -> list[BoardDetection]:
    """Detect the board in the images of a source, in at most `most` of them.

    Args:
        source: device, file or folder.
        board: to detect.
        camera: its intrinsics.
        most: images with the board.
        seconds: duration for a device.
        report: gets a line for each file that is no image, and one about images without the board.

    Raises:
        CalibrationFailed: no image shows it; reports the most frequent reason.
        ConfigError: the source cannot be read.
    """
    detected: list[BoardDetection] = []
    reasons_: list[str] = []
    for name, picture in read_images(source, (camera.width, camera.height), seconds, report):
        found, reasons = detect_boards(board, [(f"{source}: {name}", picture)], camera)
        detected, reasons_ = detected + found, reasons_ + reasons
        if len(detected) >= most:
            break
    reason = max(set(reasons_), key=reasons_.count, default="there are none")
    if not detected:
        raise CalibrationFailed(f"{source}: the board ({board.options}) is in none of {len(reasons_)} images: {reason}")
    if reasons_:
        report(f"{source}: {len(reasons_)} images left out; most often: {reason}")
    return detected


def detect_boards(board: Board, pictures: Sequence[tuple[str, npt.NDArray[np.uint8]]], camera: CameraFile,
                 max_blur: float = 2.5) -> tuple[list[BoardDetection], list[str]]:
    """Return the detections, and the reason for each image without the board or of another size."""
    found: list[BoardDetection] = []
    reasons: list[str] = []
    for name, picture in pictures:
        height, width = picture.shape[:2]
        if (width, height) != (camera.width, camera.height):
            reasons.append(f"the image is {width}x{height}, but the intrinsics are for {camera.width}x{camera.height}")
            continue
        detection = board.find(picture, name)
        if isinstance(detection, NoBoard):
            reasons.append(detection.reason)
        elif detection.blur > max_blur:
            reasons.append(f"edges are blurred over {detection.blur:.1f} px")
        else:
            found.append(detection)
    return found, reasons


def _undistorted(detection: BoardDetection, T_world_board: Array, camera: CameraFile) -> _PlacedDetection:
    ideal = camera.undistorted(detection.pixels)
    points = detection.points @ T_world_board[:3, :3].T + T_world_board[:3, 3]
    return _PlacedDetection(detection, T_world_board, points, ideal[:, None])


def _fit(detected: Sequence[_PlacedDetection], K: Array) -> Array:
    """T_camera_world (4, 4) with the least residual over all corners.

    A distant plane has two similar poses (T. Collins, A. Bartoli, Infinitesimal plane-based pose estimation, IJCV 109
    (2014), 252-286): both are refined and the better one is returned.
    """
    most = max(detected, key=lambda view: len(view.points))
    _, rotations, translations, _ = cv2.solvePnPGeneric(
        most.detection.points, most.ideal, K, None, flags=cv2.SOLVEPNP_IPPE
    )
    points = np.concatenate([view.points for view in detected])
    ideal = np.concatenate([view.ideal for view in detected])
    best, least = np.eye(4), math.inf
    for rotation, translation in zip(rotations, translations, strict=True):
        start = _pose(rotation, translation) @ invert(most.T_world_board)
        first = cv2.Rodrigues(start[:3, :3])[0], start[:3, 3].reshape(3, 1).copy()
        T = _pose(*cv2.solvePnPRefineLM(points, ideal, K, None, *first))
        residual = _rms(_project(points, T, K) - ideal[:, 0])
        if residual < least and (points @ T[2, :3] + T[2, 3] > 0).all():
            best, least = T, residual
    if not math.isfinite(least):
        raise CalibrationFailed("no pose of the camera fits the corners of the board")
    return best


def _uncertainty(
    detected: Sequence[_PlacedDetection], T_camera_world: Array, K: Array, rms: float, camera: CameraFile
) -> tuple[tuple[float, float, float], float, float]:
    """First order standard deviations of position [m], rotation [rad] and a point on the board's plane [m]."""
    points = np.concatenate([view.points for view in detected])
    nudges = [_nudge(T_camera_world, axis, 1e-6) for axis in range(6)]
    here = _project(points, T_camera_world, K)
    J = np.stack([(_project(points, T, K) - here).ravel() / 1e-6 for T in nudges], axis=1)
    # The rms is that of a corner, of u and v together. Images of one board pose are correlated: they count as one.
    repeated = len(detected) / len({view.T_world_board.tobytes() for view in detected})
    covariance = repeated * rms**2 / 2 * np.linalg.inv(J.T @ J)
    centre = invert(T_camera_world)[:3, 3]
    D = np.stack([(invert(T)[:3, 3] - centre) / 1e-6 for T in nudges], axis=1)
    x, y, z = np.sqrt(np.diag(D @ covariance @ D.T))
    u, v = np.meshgrid(np.linspace(0, camera.width - 1, _GRID), np.linspace(0, camera.height - 1, _GRID))
    grid = np.stack([u.ravel(), v.ravel()], axis=1)
    board = detected[0].T_world_board
    intersection = _on_plane(grid, invert(T_camera_world), K, board)
    G = np.stack([(_on_plane(grid, invert(T), K, board) - intersection) / 1e-6 for T in nudges], axis=-1)  # (n, 2, 6)
    spread = np.sqrt(np.einsum("nik,kl,nil->n", G, covariance, G))
    return (float(x), float(y), float(z)), float(np.sqrt(np.trace(covariance[:3, :3]))), float(np.nanmax(spread))


def _nudge(T: Array, axis: int, by: float) -> Array:
    """Rotate T about (axes 0 to 2), or translate it along (3 to 5), an axis of the camera."""
    step = np.zeros(6)
    step[axis] = by
    return transform(np.asarray(cv2.Rodrigues(step[:3])[0], float), step[3:]) @ T


def _errors(view: _PlacedDetection, T_camera_world: Array, K: Array) -> Array:
    """(n, 2) [px]."""
    return _project(view.points, T_camera_world, K) - view.ideal[:, 0]


def _on_board(view: _PlacedDetection, T_world_camera: Array, K: Array) -> Array:
    """(n, 2) offsets [m] of the pixel rays from their corners on the board."""
    return _on_plane(view.ideal[:, 0], T_world_camera, K, view.T_world_board) - view.detection.points[:, :2]


def _on_plane(pixels: Array, T_world_camera: Array, K: Array, T_world_board: Array) -> Array:
    """(n, 2) intersections of pixel rays with the plane of a board, in its frame [m]; nan without one."""
    T = invert(T_world_board) @ T_world_camera
    rays = np.concatenate([(pixels - K[:2, 2]) / np.diag(K)[:2], np.ones((len(pixels), 1))], axis=1) @ T[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        along = np.where(rays[:, 2] * T[2, 3] < 0, -T[2, 3] / rays[:, 2], np.nan)
    intersection: Array = T[:2, 3] + along[:, None] * rays[:, :2]
    return intersection


def _project(points: Array, T_camera_world: Array, K: Array) -> Array:
    p = points @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
    pixels: Array = p[:, :2] / p[:, 2:] * np.diag(K)[:2] + K[:2, 2]
    return pixels


def _pose(rotation: npt.ArrayLike, translation: npt.ArrayLike) -> Array:
    return transform(np.asarray(cv2.Rodrigues(np.asarray(rotation, float))[0], float), np.ravel(translation))


def _rms(errors: Array) -> float:
    """Root mean square length of (n, 2) errors."""
    return float(np.sqrt((errors**2).sum(axis=1).mean()))
