"""The pose of a camera is corrected by the floor and the walls of the tray."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from applications.sorting.places import Place
from applications.sorting.registration import Registration, correction
from common.perception.pinhole import Pinhole
from common.robot.transforms import invert, rpy_to_matrix, transform
from tests.applications.sorting.surfaces import Solid, box, sphere

Array = NDArray[np.float64]

TRAY = Place("tray", floor=0.005, rim=0.05, x=0.55, y=0.0, inner=0.192, outer=0.2, color=(180.0, 180.0, 180.0))
HEAP = [box(0.45 + 0.08 * i, 0.09 * j, 0.06, 0.05, 0.03 + 0.01 * i, i + j) for i in range(3) for j in (-1, 0, 1)]
PLATES = [box(0.45 + 0.1 * i, 0.1 * j, 0.08, 0.06, 0.005, i) for i in range(3) for j in (-1, 0, 1)]


def cloud(*solids: Solid, noise: float = 0.001, seed: int = 0) -> Array:
    """Return points (n, 3) of a tray with solids, as seen from straight above."""
    axis = np.arange(-0.23, 0.23, 0.0025)
    x, y = (each.ravel() for each in np.meshgrid(TRAY.x + axis, TRAY.y + axis))
    away = np.maximum(np.abs(x - TRAY.x), np.abs(y - TRAY.y))
    z = np.where(away > TRAY.outer, 0.0, np.where(away > TRAY.inner, TRAY.rim, TRAY.floor))
    for solid in solids:
        height = np.where(away < TRAY.inner, solid(x, y), -1.0)
        z = np.maximum(z, TRAY.floor + height)
    rng = np.random.default_rng(seed)
    return np.column_stack([x, y, z]) + noise * rng.standard_normal((len(x), 3)) * (0.5, 0.5, 1.0)


def error(degrees: float, axis: tuple[float, float, float], shift: tuple[float, float, float]) -> Array:
    """Return (4, 4) T that turns about the middle of the tray and shifts [m]."""
    middle = np.array([TRAY.x, TRAY.y, TRAY.floor])
    turn = cv2.Rodrigues(np.radians(degrees) * np.array(axis) / np.linalg.norm(axis))[0]
    return transform(turn, middle - turn @ middle + np.array(shift))


def moved(T: Array, points: Array) -> Array:
    return np.asarray(points @ T[:3, :3].T + T[:3, 3])


@pytest.mark.parametrize(
    "solids", [[], HEAP, PLATES, [sphere(0.55, 0.0, 0.035)]], ids=["empty", "heap", "plates", "ball"])
@pytest.mark.parametrize("wrong", [
    error(0.0, (0, 0, 1), (0.0, 0.0, 0.0)),
    error(3.0, (1, 0, 0), (0.0, 0.0, 0.003)),
    error(-3.0, (0, 1, 0), (0.003, 0.0, 0.0)),
    error(3.0, (0, 0, 1), (0.0, -0.003, 0.0)),
    error(3.0, (1, -1, 1), (0.002, 0.002, -0.002)),
], ids=["none", "roll", "pitch", "yaw", "all"])
def test_an_error_of_the_pose_is_corrected(solids: list[Solid], wrong: Array) -> None:
    found = correction(moved(wrong, cloud(*solids)), TRAY)
    assert found is not None
    corners = np.array([(TRAY.x + i, TRAY.y + j, TRAY.floor) for i in (-0.18, 0, 0.18) for j in (-0.18, 0, 0.18)])
    left = np.linalg.norm(moved(found @ wrong, corners) - corners, axis=1)
    assert left.max() < (0.0015 if solids is not PLATES else 0.0035)


@pytest.mark.parametrize(("points", "why"), [
    (np.zeros((0, 3)), "nothing is seen"),
    (cloud()[:, :] + (0.0, 0.0, 0.3), "the tray is elsewhere"),
    (cloud()[cloud()[:, 0] < 0.42], "most of it is hidden"),
    (moved(error(15.0, (1, 0, 0), (0, 0, 0)), cloud()), "no calibration is that wrong"),
])
def test_no_correction_without_a_good_view(points: Array, why: str) -> None:
    assert correction(points, TRAY) is None, why


def rendered(camera: Pinhole) -> NDArray[np.float32]:
    """Return the depth of an empty tray below a camera whose pose is the true one."""
    rays = np.stack([*np.meshgrid(*((np.arange(n) - c) / f for n, c, f in (
        (camera.width, camera.cx, camera.fx), (camera.height, camera.cy, camera.fy)))),
        np.ones((camera.height, camera.width))], axis=-1) @ camera.T_world_optical[:3, :3].T
    depth = np.full(rays.shape[:2], np.inf)
    for height in (TRAY.rim, TRAY.floor, 0.0):
        d = (height - camera.position[2]) / rays[..., 2]
        x, y = (camera.position[k] + d * rays[..., k] for k in (0, 1))
        away = np.maximum(np.abs(x - TRAY.x), np.abs(y - TRAY.y))
        wall, floor = (away > TRAY.inner) & (away < TRAY.outer), away <= TRAY.inner
        here = {TRAY.rim: wall, TRAY.floor: floor}.get(height, away > 0)
        depth = np.where(here & np.isinf(depth), d, depth)
    return depth.astype(np.float32)


def test_a_camera_is_corrected_until_its_calibration_changes() -> None:
    T = transform(rpy_to_matrix(np.pi, 0, -np.pi / 2), (0.53, 0, 0.95))
    true = Pinhole(480.0, 480.0, 320.0, 240.0, 640, 480, T)
    wrong = replace(true, T_world_optical=error(3.0, (1, 2, 3), (0.003, 0, 0)) @ true.T_world_optical)
    depth, image = rendered(true), np.zeros((480, 640, 3), np.uint8)
    registration = Registration(TRAY)
    before = registration.apply([(depth, image, wrong)])[0][2]
    registration.update([(depth, image, wrong)])
    after = registration.apply([(depth, image, wrong)])[0][2]
    assert before is wrong
    left = after.T_world_optical @ invert(true.T_world_optical) @ [0.7, 0.15, 0.005, 1.0] - [0.7, 0.15, 0.005, 1.0]
    assert np.linalg.norm(left[:3]) < 0.0015
    registration.update([(depth, image, wrong)])
    assert registration.apply([(depth, image, wrong)])[0][2] is after  # nothing has to be computed again
    registration.update([(np.full_like(depth, np.nan), image, wrong)])  # nothing is seen: the correction remains
    assert registration.apply([(depth, image, wrong)])[0][2] is after
