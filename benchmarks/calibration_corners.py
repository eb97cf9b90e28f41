"""Our corner fitting against OpenCV's CharucoDetector and cornerSubPix, on drawn boards whose lens and pose are known.

    python -m benchmarks.calibration_corners [--pictures 60] [--sets 6]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from common.perception.camera_file import CameraFile
from common.robot.transforms import invert, rpy_to_matrix, transform
from tests.tools.calibration.rendered_boards import BOARD, Lens, many_poses, render
from tools.calibration import board as calibration_board
from tools.calibration.board import BoardDetection
from tools.calibration.camera_pose import calibrate_pose
from tools.calibration.corners import refine
from tools.calibration.intrinsics import CollectingOptions, calibrate_intrinsics

Array = npt.NDArray[np.float64]
Placed = tuple[Array, npt.NDArray[np.bool_]]
Place = Callable[[Any, Any, Array, Array, float], Placed]

STOP = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4)
T_WORLD_CAMERA = transform(rpy_to_matrix(np.pi - 0.06, 0.04, -np.pi / 2 + 0.1), (0.42, -0.01, 0.80))
PLACES = ((0.35, -0.15, 0.1), (0.3, 0.15, 1.7), (0.55, -0.35, 1.2))


def as_detected(_grey: Any, _sheet: Any, _points: Array, pixels: Array, _blur: float) -> Placed:
    """What CharucoDetector says: it refines with cornerSubPix itself, in a window of its own choice."""
    return pixels, np.ones(len(pixels), bool)


def sub_pix(half: int | None) -> Place:
    """The cornerSubPix of OpenCV in a window of that half side [px]; None: as far as the markers are away."""

    def place(grey: Any, sheet: Any, points: Array, pixels: Array, _blur: float) -> Placed:
        away = half
        if away is None:
            H, _ = cv2.findHomography(points, pixels)
            ends = cv2.perspectiveTransform((points[:1, None] + [[[0, 0]], [[sheet.square, 0]]]).astype(float), H)[:, 0]
            gap = (1 - BOARD.options.marker / BOARD.options.square) / 2
            away = int(np.clip(gap * np.linalg.norm(ends[1] - ends[0]), 2, 15))
        found = cv2.cornerSubPix(grey, pixels.astype(np.float32)[:, None].copy(), (away, away), (-1, -1), STOP)
        return np.asarray(found, float)[:, 0], np.ones(len(pixels), bool)

    return place


def detector(method: int) -> cv2.aruco.CharucoDetector:
    """A detector that refines the corners of markers first."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = method
    return cv2.aruco.CharucoDetector(BOARD._board, detectorParams=parameters)


USUAL = BOARD._detector
WAYS: dict[str, tuple[Place, cv2.aruco.CharucoDetector]] = {
    "ours": (refine, USUAL),
    "CharucoDetector": (as_detected, USUAL),
    "  and cornerSubPix 2": (sub_pix(2), USUAL),
    "  and cornerSubPix 3": (sub_pix(3), USUAL),
    "  and cornerSubPix 5": (sub_pix(5), USUAL),
    "  and to the markers": (sub_pix(None), USUAL),
    "  markers: sub-pixel": (as_detected, detector(cv2.aruco.CORNER_REFINE_SUBPIX)),
    "  markers: contour": (as_detected, detector(cv2.aruco.CORNER_REFINE_CONTOUR)),
}


@contextmanager
def by(way: str) -> Iterator[None]:
    """Find boards that way during the block."""
    place, found_by = WAYS[way]
    before = calibration_board.refine
    calibration_board.refine, BOARD._detector = place, found_by  # type: ignore[assignment]
    try:
        yield
    finally:
        calibration_board.refine, BOARD._detector = before, USUAL


def corner_errors(way: str, lens: Lens, poses: list[Array], pictures: list[Any]) -> tuple[Array, float]:
    """(n,) distances of corners from where they are [px], and how long a picture took [ms of one core]."""
    errors = []
    with by(way):
        start = time.thread_time()
        seen = [BOARD.find(picture, "x") for picture in pictures]
        spent = 1e3 * (time.thread_time() - start) / len(pictures)
    for T, found in zip(poses, seen, strict=True):
        if isinstance(found, BoardDetection):
            rotation = cv2.Rodrigues(T[:3, :3])[0]
            truth = cv2.projectPoints(found.points, rotation, T[:3, 3], lens.k, np.array(lens.d))[0][:, 0]
            errors.append(np.linalg.norm(found.pixels - truth, axis=1))
    return np.concatenate(errors), spent


def corners(count: int) -> None:
    """How far corners are from where they are, in pictures of several kinds."""
    near = Lens()
    fine = Lens(1066, 1058, 653.5, 468.9, near.d, 1280, 960)
    kinds: dict[str, tuple[Lens, tuple[float, float], dict[str, float]]] = {
        "as in the tests": (near, (0.45, 0.75), {}),
        "noise of 6": (near, (0.45, 0.75), {"noise": 6}),
        "blur of 1 px": (near, (0.45, 0.75), {"blur": 1.0}),
        "near": (near, (0.3, 0.4), {}),
        "1280 x 960": (fine, (0.45, 0.75), {}),
    }
    print(f"{'corners off by [px], rms and 99 %':34s}" + "".join(f"{kind:>18s}" for kind in kinds) + "      ms")
    drawn = []
    for lens, depth, how in kinds.values():
        poses = many_poses(BOARD, count, seed=3, z=depth)
        drawn.append((lens, poses, [render(BOARD, lens, T, seed=k, **how) for k, T in enumerate(poses)]))
    for way in WAYS:
        cells, spent = [], 0.0
        for number, (lens, poses, pictures) in enumerate(drawn):
            errors, took = corner_errors(way, lens, poses, pictures)
            spent = took if number == 0 else spent
            cells.append(f"{np.sqrt((errors**2).mean()):10.3f} {np.percentile(errors, 99):7.3f}")
        print(f"{way:34s}{''.join(cells)} {spent:7.1f}")


def calibrations(sets: int) -> None:
    """What becomes of it: lens, pose of the camera, places on the table."""
    lens = Lens()
    camera = CameraFile(width=640, height=480, fx=lens.fx, fy=lens.fy, cx=lens.cx, cy=lens.cy, d=list(lens.d))
    views = [[render(BOARD, lens, T, seed=100 * k + n) for n, T in enumerate(many_poses(BOARD, 14, seed=k))]
             for k in range(sets)]
    lying = []
    for k in range(sets):
        rng = np.random.default_rng(k)
        boards = [transform(rpy_to_matrix(0, 0, yaw + rng.uniform(-0.3, 0.3)), (*rng.normal((x, y), 0.03), 0))
                  for x, y, yaw in PLACES]
        lying.append([(T, [render(BOARD, lens, invert(T_WORLD_CAMERA) @ T, seed=10 * k + n) for n in range(3)])
                      for T in boards])
    head = ("focal length [%]", "residual [px]", "one place: [mm]", "table [mm]", "two places: [mm]", "table [mm]")
    print(f"\n{f'off by, median (most) of {sets}':24s}" + "".join(f"{name:>20s}" for name in head))
    for way in WAYS:
        with by(way):
            figures: list[list[float]] = [[] for _ in head]
            for pictures in views:
                seen = [found for picture in pictures if isinstance(found := BOARD.find(picture, "x"), BoardDetection)]
                lens_found = calibrate_intrinsics(seen, CollectingOptions())
                figures[0].append(100 * max(abs(lens_found.k[0] / lens.fx - 1), abs(lens_found.k[1] / lens.fy - 1)))
                figures[1].append(lens_found.rms)
            for placed in lying:
                seen_at = [(T, [s for p in pictures if isinstance(s := BOARD.find(p, "x"), BoardDetection)])
                           for T, pictures in placed]
                for column, count in ((2, 1), (4, 2)):
                    found = calibrate_pose(seen_at[:count], camera).T_world_camera
                    figures[column].append(1e3 * float(np.linalg.norm(found[:3, 3] - T_WORLD_CAMERA[:3, 3])))
                    figures[column + 1].append(table_error(found, lens))
        print(f"{way:24s}" + "".join(f"{f'{np.median(values):.3f} ({max(values):.3f})':>20s}" for values in figures))


def table_error(T_world_camera: Array, lens: Lens) -> float:
    """How far places on the table are off, where it is worst in the picture [mm]."""
    u, v = np.meshgrid(np.linspace(20, lens.width - 20, 9), np.linspace(20, lens.height - 20, 7))
    rays = np.stack([(u.ravel() - lens.cx) / lens.fx, (v.ravel() - lens.cy) / lens.fy, np.ones(u.size)], axis=1)
    places = []
    for T in (T_world_camera, T_WORLD_CAMERA):
        d = rays @ T[:3, :3].T
        places.append(T[:2, 3] - d[:, :2] * (T[2, 3] / d[:, 2:]))
    return 1e3 * float(np.linalg.norm(places[0] - places[1], axis=1).max())


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--pictures", type=int, default=60)
    parser.add_argument("--sets", type=int, default=6)
    options = parser.parse_args()
    corners(options.pictures)
    calibrations(options.sets)


if __name__ == "__main__":
    main()
