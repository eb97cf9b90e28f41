"""Correct the pose of a depth camera by the tray that it sees: its floor is flat, its walls are where the world says.

A calibration that is wrong by 3 degrees raises the floor at one side of the tray by a centimeter, and shifts what is
seen there. The floor determines height, roll and pitch, the tops of the walls x, y and yaw. What lies in the tray is
higher than the floor and next to the walls, and counts as outliers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from applications.sorting.places import Place
from applications.sorting.seeing import View, world_points
from common.perception.pinhole import Pinhole
from common.robot.transforms import invert, rpy_to_matrix, transform

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

SKIP = 2  # [px] every second pixel of every second row is enough
BORDER = 0.012  # [m] of the floor next to the walls that is not used
BLOCKS = 8  # along each side of the tray, in each of which the lowest points are floor
LOWEST = 20.0  # [%] of the points of a block
FEW = 12  # points of a block or of a piece of a wall that are too few
NEAR = (0.006, 0.004, 0.003)  # [m] from the plane found before, in rounds
SEARCH = 0.018  # [m] on both sides of a wall, in which its top is looked for
PIECES = 24  # of each wall
TOP = 0.008  # [m] from the rim
SEEN = 0.5  # least fraction of blocks and of pieces of a wall
MOST_SHIFT, MOST_TURN = 0.03, math.radians(8.0)  # of a calibration; more is no calibration but a moved tray
EVERY = 10  # images between two measurements, after the first few: a calibration changes slowly
FIRST = 3  # images
SAME_SHIFT, SAME_TURN = 0.0008, math.radians(0.25)  # changes that are noise


class Registration:
    """Corrections of cameras, each in its optical frame: valid while a camera moves with the arm, too."""

    def __init__(self, tray: Place) -> None:
        """Start without corrections."""
        self._tray = tray
        self._images = 0
        self._corrections: dict[int, Array] = {}
        self._corrected: dict[int, tuple[Pinhole, Pinhole]] = {}  # the given camera and the corrected one

    def update(self, views: Sequence[View]) -> None:
        """Measure the corrections in the first images, and in some later ones; nothing may be in front of the tray."""
        self._images += 1
        if self._images > FIRST and self._images % EVERY:
            return
        for number, (depth, _, camera) in enumerate(views):
            step = slice(None, None, SKIP)
            x, y, z = (each.reshape(depth.shape)[step, step].ravel().astype(float)
                       for each in world_points(depth, camera))
            found = correction(np.column_stack([x, y, z])[np.isfinite(z)], self._tray)
            if found is None:
                continue
            T = camera.T_world_optical
            new, old = invert(T) @ found @ T, self._corrections.get(number, np.eye(4))
            change = invert(T @ old) @ T @ new
            at_tray = T @ new @ invert(T @ old) @ [self._tray.x, self._tray.y, self._tray.floor, 1.0]
            shift = np.linalg.norm(at_tray[:3] - (self._tray.x, self._tray.y, self._tray.floor))
            if shift > SAME_SHIFT or _angle(change) > SAME_TURN:
                self._corrections[number] = new
                self._corrected.pop(number, None)

    def apply(self, views: Sequence[View]) -> list[View]:
        """Return the views with corrected cameras; each stays the same object while nothing changes."""
        return [(depth, image, self._camera(number, camera)) for number, (depth, image, camera) in enumerate(views)]

    def _camera(self, number: int, camera: Pinhole) -> Pinhole:
        if number not in self._corrections:
            return camera
        given, corrected = self._corrected.get(number, (None, camera))
        if given is not camera:
            corrected = replace(camera, T_world_optical=camera.T_world_optical @ self._corrections[number])
            self._corrected[number] = camera, corrected
        return corrected


def correction(points: Array, tray: Place) -> Array | None:
    """Return (4, 4) T that moves points (n, 3) [m] in world to where the tray says; None if the tray is not seen well.

    Without enough of the walls, only height, roll and pitch are corrected.
    """
    center = np.array([tray.x, tray.y, tray.floor])
    local = points - center
    near = (np.abs(local[:, :2]) < tray.outer + 2 * SEARCH).all(axis=1) & (np.abs(local[:, 2]) < 0.2)
    local = local[near]
    plane = _floor(local, tray)
    if plane is None:
        return None
    leveled = _leveling(plane)
    walls = _walls(local @ leveled[:3, :3].T + leveled[:3, 3], tray)
    moved = walls @ leveled if walls is not None else leveled
    if np.linalg.norm(moved[:3, 3]) > MOST_SHIFT or _angle(moved) > MOST_TURN:
        return None
    there = transform(np.eye(3), center)
    return np.asarray(there @ moved @ invert(there))


def _floor(local: Array, tray: Place) -> Array | None:
    """Return a, b, c [m] of the floor z = a x + b y + c of points (n, 3) relative to the middle of the tray."""
    half = tray.inner - BORDER
    points = local[(np.abs(local[:, :2]) < half).all(axis=1)]
    block = np.floor((points[:, :2] + half) / (2 * half) * BLOCKS).astype(int) @ [BLOCKS, 1]
    lowest = [points[own][_low(points[own, 2])] for own in (block == k for k in range(BLOCKS**2)) if own.sum() >= FEW]
    if len(lowest) < SEEN * BLOCKS**2:
        return None
    means = np.array([each.mean(axis=0) for each in lowest])
    plane = _trimmed_plane(means)
    for near in NEAR:
        off = points[:, 2] - points[:, :2] @ plane[:2] - plane[2]
        chosen = points[np.abs(off - np.median(off[np.abs(off) < 2 * near] if (np.abs(off) < 2 * near).any() else 0))
                        < near]
        if len(chosen) < FEW:
            return None
        plane = _fitted_plane(chosen)
    return plane


def _low(z: Array) -> Bools:
    return np.asarray(z <= np.percentile(z, LOWEST))


def _trimmed_plane(points: Array) -> Array:
    """Return the plane of points (n, 3) without those far above it: blocks that are covered by objects."""
    plane = np.array([0.0, 0.0, float(np.median(points[:, 2]))])
    for share in (0.9, 0.7, 0.6):
        off = points[:, 2] - points[:, :2] @ plane[:2] - plane[2]
        plane = _fitted_plane(points[off <= np.quantile(off, share)])
    return plane


def _fitted_plane(points: Array) -> Array:
    A = np.column_stack([points[:, :2], np.ones(len(points))])
    return np.asarray(np.linalg.lstsq(A, points[:, 2], rcond=None)[0])


def _leveling(plane: Array) -> Array:
    """Return (4, 4) T that moves a floor z = a x + b y + c into z = 0."""
    a, b, c = plane
    R = rpy_to_matrix(-math.atan(b), math.atan(a), 0.0)
    height = (R @ [0.0, 0.0, c])[2]
    return transform(R, (0.0, 0.0, -float(height)))


def _walls(local: Array, tray: Place) -> Array | None:
    """Return (4, 4) T that turns and shifts the tops of the walls to where they are; None if one is not seen."""
    rim, middle = tray.rim - tray.floor, (tray.inner + tray.outer) / 2
    tops = local[np.abs(local[:, 2] - rim) < TOP]
    offsets, turns = np.zeros(2), []
    for axis in (0, 1):
        for side in (-1, 1):
            found = _wall(tops[:, axis] - side * middle, tops[:, 1 - axis], tray.inner - SEARCH)
            if found is None:
                return None
            offsets[axis] += found[0] / 2
            turns.append(-found[1] if axis == 0 else found[1])
    yaw = float(np.median(turns))
    R = rpy_to_matrix(0.0, 0.0, -yaw)
    return transform(R, R @ [-offsets[0], -offsets[1], 0.0])


def _wall(across: Array, along: Array, reach: float) -> tuple[float, float] | None:
    """Return offset [m] and slope of a wall's top, of points across and along it [m]; None if too little is seen."""
    near = (np.abs(across) < SEARCH) & (np.abs(along) < reach)
    across, along = across[near], along[near]
    piece = np.floor((along + reach) / (2 * reach) * PIECES).astype(int)
    found = np.array([(along[own].mean(), np.median(across[own]))
                      for own in (piece == k for k in range(PIECES)) if own.sum() >= FEW // 2])
    if len(found) < SEEN * PIECES:
        return None
    first, second = np.triu_indices(len(found), PIECES // 6)  # Theil and Sen: the median of slopes of pairs
    between = found[second] - found[first]
    slope = float(np.median(between[:, 1] / between[:, 0]))
    return float(np.median(found[:, 1] - slope * found[:, 0])), slope


def _angle(T: Array) -> float:
    """Return the angle [rad] by which a (4, 4) pose is turned."""
    return math.acos(min(max((float(np.trace(T[:3, :3])) - 1) / 2, -1.0), 1.0))
