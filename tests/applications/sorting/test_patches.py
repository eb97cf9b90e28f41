"""Patches of heights lie in the grasp's frame, with the closing axis along the columns."""

import numpy as np
import pytest

from applications.sorting.learning.patches import RANGE, SCALE, SIZE, STEP, patches_of
from applications.sorting.surface import Surface

FLOOR = 0.005
TIP_DOWN = np.diag([1.0, -1.0, -1.0, 1.0])  # closing frame with y along -y of world


def surface() -> Surface:
    """A floor with a block of 40 mm at x 0.53 to 0.57 and y 0.03 to 0.05, and an unknown strip at y < -0.05."""
    top = np.full((200, 200), FLOOR, np.float32)
    made = Surface((0.35, -0.20), 0.002, top, np.zeros((200, 200, 3), np.uint8), FLOOR)
    (row, column), (last_row, last_column) = made.cells([[0.53, 0.03], [0.57, 0.05]])
    top[row:last_row, column:last_column] = FLOOR + 0.04
    top[:75] = np.nan
    return made


def frame(x: float, y: float, z: float, yaw: float = 0.0) -> np.ndarray:
    T = TIP_DOWN.copy()
    c, s = np.cos(yaw), np.sin(yaw)
    T[:3, :3] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ T[:3, :3]
    T[:3, 3] = x, y, z
    return T


def middle_of_mass(patch: np.ndarray) -> tuple[float, float]:
    """(row, column) [m] of what is above the tool center point, from the middle of the patch."""
    rows, columns = np.nonzero(patch > 0.1)
    return (rows.mean() - (SIZE - 1) / 2) * STEP, (columns.mean() - (SIZE - 1) / 2) * STEP


@pytest.mark.parametrize("yaw, row, column", [
    (0.0, 0.0, -0.03), (np.pi, 0.0, 0.03), (np.pi / 2, 0.03, 0.0), (-np.pi / 2, -0.03, 0.0),
], ids=["along -y", "along y", "along x", "along -x"])
def test_rows_and_columns_are_x_and_y_of_the_closing_frame(yaw: float, row: float, column: float) -> None:
    patch, = patches_of(surface(), frame(0.55, 0.01, 0.02, yaw)[None])
    assert middle_of_mass(patch) == pytest.approx((row, column), abs=0.002)


def test_heights_are_those_against_the_approach_and_clipped() -> None:
    low, high = patches_of(surface(), np.stack([frame(0.55, 0.04, 0.02), frame(0.55, 0.04, 0.12)]))
    middle = SIZE // 2
    assert low[middle, middle] == pytest.approx((FLOOR + 0.04 - 0.02) / SCALE, abs=1e-4)
    assert high[middle, middle] == pytest.approx(-RANGE / SCALE)


def test_unknown_cells_count_as_floor() -> None:
    patch, = patches_of(surface(), frame(0.55, -0.10, 0.02)[None])
    assert patch == pytest.approx(np.full((SIZE, SIZE), (FLOOR - 0.02) / SCALE), abs=1e-4)


def test_tilted_grasp_sees_a_level_floor_as_a_slope() -> None:
    T = frame(0.55, -0.10, 0.02)
    c, s = np.cos(0.3), np.sin(0.3)
    T[:3, :3] = T[:3, :3] @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    patch, = patches_of(surface(), T[None])
    slope = np.diff(patch * SCALE, axis=1) / STEP
    assert np.allclose(np.abs(slope[np.abs(patch[:, 1:]) < 1.9]), s * c, atol=1e-3)


def test_many_grasps_fit_in_one_call_and_none_is_allowed() -> None:
    assert patches_of(surface(), np.repeat(frame(0.55, 0.0, 0.02)[None], 1500, axis=0)).shape == (1500, SIZE, SIZE)
    assert patches_of(surface(), np.zeros((0, 4, 4))).shape == (0, SIZE, SIZE)
