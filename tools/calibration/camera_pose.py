"""Pose of a camera in world from pictures of a board that lies where a person measured."""

from __future__ import annotations

import math
from collections.abc import Sequence
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

_OUTLIER = 3.0, 0.2  # a picture is dropped when its residual is above so many medians, and above so many [px]
_WORST_FIT = 2.0  # [px] rms above which the board cannot have lain still where it is said to have been
_GRID = 5  # places along each side of the picture at which the uncertainty is looked at


@dataclass(frozen=True, eq=False)
class PoseCalibration:
    """A calibrated pose.

    Attributes:
        T_world_camera: (4, 4) pose of the optical frame in world.
        position_std: standard deviation of the optical centre, along x, y, z of world [m].
        rotation_std: standard deviation of the rotation, over all axes [rad].
        place_std: standard deviation of a place on the board's plane, at the worst place of the picture [m].
        rms: residual of all corners in the picture [px].
        rms_on_board: residual of all corners on the board [m].
        pictures: those that were fitted.
        dropped: those that did not fit.
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
        """Optical centre in world [m]."""
        x, y, z = self.T_world_camera[:3, 3]
        return float(x), float(y), float(z)

    @property
    def rpy(self) -> tuple[float, float, float]:
        """Roll, pitch and yaw of the optical frame in world [rad], R = Rz Ry Rx."""
        return matrix_to_rpy(self.T_world_camera[:3, :3])


@dataclass(frozen=True, eq=False)
class _Seen:
    """A sighting with the place of its board: corners in world (n, 3) [m], and in the picture without distortion."""

    sighting: BoardDetection
    T_world_board: Array
    points: Array
    ideal: Array  # (n, 1, 2) [px], as a pinhole with the same k would see them


def calibrate_pose(
    places: Sequence[tuple[Array, Sequence[BoardDetection]]], camera: CameraFile
) -> PoseCalibration:
    """The pose that fits the corners of all pictures best; pictures that do not fit the others are dropped.

    Args:
        places: pose of the board in world (4, 4), and what was seen of it there; the camera is always where it is.
        camera: its intrinsics.

    Raises:
        CalibrationFailed: no picture shows the board, it has another size, or the pictures contradict each other.
    """
    seen = [_straightened(sighting, T, camera) for T, sightings in places for sighting in sightings]
    if not seen:
        raise CalibrationFailed("no picture shows the board")
    K, dropped = camera.matrix, []
    while True:
        T_camera_world = _fit(seen, K)
        errors = [_errors(one, T_camera_world, K) for one in seen]
        residuals = [_rms(e) for e in errors]
        limit = max(_OUTLIER[0] * float(np.median(residuals)), _OUTLIER[1])
        worst = int(np.argmax(residuals))
        if residuals[worst] <= limit or len(seen) == 1:
            break
        dropped.append(ViewResidual(seen[worst].sighting.name, len(errors[worst]), residuals[worst]))
        seen = [one for k, one in enumerate(seen) if k != worst]
    rms = _rms(np.concatenate(errors))
    if rms > _WORST_FIT or len(dropped) > len(seen):
        raise CalibrationFailed(
            f"the pictures do not fit together: residual {rms:.1f} px, {len(dropped)} of {len(dropped) + len(seen)} "
            "dropped; did the camera or the board move, is the board where it is said to be, are its squares as long?"
        )
    T_world_camera = invert(T_camera_world)
    position, rotation, place = _uncertainty(seen, T_camera_world, K, rms, camera)
    on_board = np.concatenate([_on_board(one, T_world_camera, K) for one in seen])
    pictures = [ViewResidual(one.sighting.name, len(one.points), r) for one, r in zip(seen, residuals, strict=True)]
    return PoseCalibration(T_world_camera, position, rotation, place, rms, _rms(on_board), pictures, dropped)


def detect_boards_in(source: str, board: Board, camera: CameraFile, most: int, seconds: float) -> list[BoardDetection]:
    """What is seen of the board in pictures of a source, in so many of them at most.

    Args:
        source: device, file or folder.
        board: that is looked for.
        camera: its intrinsics.
        most: pictures with the board.
        seconds: how long a device is looked at.

    Raises:
        CalibrationFailed: the board is in none; why it is not in most of them.
        ConfigError: the source is nothing that pictures can be read from.
    """
    seen: list[BoardDetection] = []
    why: list[str] = []
    for name, picture in read_images(source, (camera.width, camera.height), seconds):
        found, reasons = detect_boards(board, [(f"{source}: {name}", picture)], camera)
        seen, why = seen + found, why + reasons
        if len(seen) >= most:
            break
    if not seen:
        raise CalibrationFailed(f"{source}: the board ({board.options}) is in none of {len(why)} pictures: "
                                f"{max(set(why), key=why.count)}")
    return seen


def detect_boards(board: Board, pictures: Sequence[tuple[str, npt.NDArray[np.uint8]]], camera: CameraFile,
                 max_blur: float = 2.5) -> tuple[list[BoardDetection], list[str]]:
    """Where the board is seen, and for each picture without it the reason.

    Raises:
        CalibrationFailed: a picture has another size than the intrinsics are for.
    """
    found: list[BoardDetection] = []
    reasons: list[str] = []
    for name, picture in pictures:
        height, width = picture.shape[:2]
        if (width, height) != (camera.width, camera.height):
            raise CalibrationFailed(f"{name} is {width}x{height}, but the intrinsics are for "
                                    f"{camera.width}x{camera.height}")
        sighting = board.find(picture, name)
        if isinstance(sighting, NoBoard):
            reasons.append(sighting.reason)
        elif sighting.blur > max_blur:
            reasons.append(f"edges are smeared over {sighting.blur:.1f} px")
        else:
            found.append(sighting)
    return found, reasons


def _straightened(sighting: BoardDetection, T_world_board: Array, camera: CameraFile) -> _Seen:
    ideal = camera.undistorted(sighting.pixels)
    points = sighting.points @ T_world_board[:3, :3].T + T_world_board[:3, 3]
    return _Seen(sighting, T_world_board, points, ideal[:, None])


def _fit(seen: Sequence[_Seen], K: Array) -> Array:
    """T_camera_world (4, 4) with the least residual over all corners.

    A plane that is seen from afar has two poses that look much alike (T. Collins, A. Bartoli, Infinitesimal
    plane-based pose estimation, IJCV 109 (2014), 252-286): both are refined, the better one is taken.
    """
    most = max(seen, key=lambda one: len(one.points))
    _, rotations, translations, _ = cv2.solvePnPGeneric(
        most.sighting.points, most.ideal, K, None, flags=cv2.SOLVEPNP_IPPE
    )
    points, ideal = np.concatenate([one.points for one in seen]), np.concatenate([one.ideal for one in seen])
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
    seen: Sequence[_Seen], T_camera_world: Array, K: Array, rms: float, camera: CameraFile
) -> tuple[tuple[float, float, float], float, float]:
    """Standard deviations of position [m], rotation [rad] and of a place on the board's plane [m], to first order."""
    points = np.concatenate([one.points for one in seen])
    nudges = [_nudge(T_camera_world, axis, 1e-6) for axis in range(6)]
    here = _project(points, T_camera_world, K)
    J = np.stack([(_project(points, T, K) - here).ravel() / 1e-6 for T in nudges], axis=1)
    # The rms is that of a corner, of u and v together. Pictures of one place err alike: they count as one.
    repeated = len(seen) / len({one.T_world_board.tobytes() for one in seen})
    covariance = repeated * rms**2 / 2 * np.linalg.inv(J.T @ J)
    centre = invert(T_camera_world)[:3, 3]
    D = np.stack([(invert(T)[:3, 3] - centre) / 1e-6 for T in nudges], axis=1)
    x, y, z = np.sqrt(np.diag(D @ covariance @ D.T))
    u, v = np.meshgrid(np.linspace(0, camera.width - 1, _GRID), np.linspace(0, camera.height - 1, _GRID))
    grid = np.stack([u.ravel(), v.ravel()], axis=1)
    board = seen[0].T_world_board
    there = _on_plane(grid, invert(T_camera_world), K, board)
    G = np.stack([(_on_plane(grid, invert(T), K, board) - there) / 1e-6 for T in nudges], axis=-1)  # (n, 2, 6)
    spread = np.sqrt(np.einsum("nik,kl,nil->n", G, covariance, G))
    return (float(x), float(y), float(z)), float(np.sqrt(np.trace(covariance[:3, :3]))), float(np.nanmax(spread))


def _nudge(T: Array, axis: int, by: float) -> Array:
    """T turned about (axes 0 to 2) or moved along (3 to 5) an axis of the camera."""
    step = np.zeros(6)
    step[axis] = by
    return transform(np.asarray(cv2.Rodrigues(step[:3])[0], float), step[3:]) @ T


def _errors(one: _Seen, T_camera_world: Array, K: Array) -> Array:
    """(n, 2) [px]."""
    return _project(one.points, T_camera_world, K) - one.ideal[:, 0]


def _on_board(one: _Seen, T_world_camera: Array, K: Array) -> Array:
    """(n, 2) how far from its corners the rays of their pixels meet the board [m]."""
    return _on_plane(one.ideal[:, 0], T_world_camera, K, one.T_world_board) - one.sighting.points[:, :2]


def _on_plane(pixels: Array, T_world_camera: Array, K: Array, T_world_board: Array) -> Array:
    """(n, 2) where rays through pixels meet the plane of a board, in its frame [m]; nan where they do not."""
    T = invert(T_world_board) @ T_world_camera
    rays = np.concatenate([(pixels - K[:2, 2]) / np.diag(K)[:2], np.ones((len(pixels), 1))], axis=1) @ T[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        along = np.where(rays[:, 2] * T[2, 3] < 0, -T[2, 3] / rays[:, 2], np.nan)
    there: Array = T[:2, 3] + along[:, None] * rays[:, :2]
    return there


def _project(points: Array, T_camera_world: Array, K: Array) -> Array:
    p = points @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
    pixels: Array = p[:, :2] / p[:, 2:] * np.diag(K)[:2] + K[:2, 2]
    return pixels


def _pose(rotation: npt.ArrayLike, translation: npt.ArrayLike) -> Array:
    return transform(np.asarray(cv2.Rodrigues(np.asarray(rotation, float))[0], float), np.ravel(translation))


def _rms(errors: Array) -> float:
    """Root of the mean squared length of (n, 2) errors."""
    return float(np.sqrt((errors**2).sum(axis=1).mean()))
