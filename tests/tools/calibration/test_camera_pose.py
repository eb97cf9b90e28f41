from dataclasses import replace

import cv2
import numpy as np
import pytest

from common.robot.transforms import invert, rpy_to_matrix, transform
from tests.tools.calibration.rendered_boards import BOARD, Lens, render
from tools.calibration.camera_pose import calibrate_pose, detect_boards
from tools.calibration.intrinsics import CalibrationFailed

LENS = Lens()
CAMERA = LENS.camera()
T_WORLD_CAMERA = transform(rpy_to_matrix(np.pi - 0.06, 0.04, -np.pi / 2 + 0.1), (0.42, -0.01, 0.80))


def on_table(x, y, yaw):
    return transform(rpy_to_matrix(0, 0, yaw), (x, y, 0.0))


def seen(T_world_board, seed, T_world_camera=T_WORLD_CAMERA, count=3):
    images = [(f"image {k}", render(BOARD, LENS, invert(T_world_camera) @ T_world_board, seed=k))
              for k in range(seed, seed + count)]
    found, reasons = detect_boards(BOARD, images, CAMERA)
    assert not reasons
    return T_world_board, found


def errors(found, truth=T_WORLD_CAMERA):
    """Return distance [m] and angle [deg] from the truth."""
    T = invert(truth) @ found.T_world_camera
    return np.linalg.norm(T[:3, 3]), np.degrees(np.linalg.norm(cv2.Rodrigues(T[:3, :3])[0]))


@pytest.fixture(scope="module")
def places():
    return [seen(on_table(0.35, -0.15, 0.1), 0), seen(on_table(0.3, 0.15, 1.7), 5), seen(on_table(0.55, -0.35, 1.2), 9)]


def test_several_board_poses_reduce_error_and_uncertainty_of_one(places):
    one, several = calibrate_pose(places[:1], CAMERA), calibrate_pose(places, CAMERA)
    distance, angle = errors(one)
    assert distance < 1e-3 and angle < 0.1
    assert one.rms < 0.05 and one.rms_on_board < 1e-4 and len(one.pictures) == 3 and not one.dropped
    np.testing.assert_allclose(rpy_to_matrix(*one.rpy), one.T_world_camera[:3, :3], atol=1e-9)
    assert one.position == pytest.approx(tuple(one.T_world_camera[:3, 3]))
    distance, angle = errors(several)
    assert distance < 0.3e-3 and angle < 0.03
    assert max(several.position_std) < max(one.position_std) / 2
    assert several.rotation_std < one.rotation_std / 2 and several.place_std < one.place_std / 2


def test_upright_rotated_board_is_supported():
    looks_ahead = transform(rpy_to_matrix(-np.pi / 2, 0, -np.pi / 2), (0.0, 0.0, 0.5))  # along +x, upright
    upright = transform(rpy_to_matrix(np.pi / 2, 0, -np.pi / 2 + 0.3), (0.7, 0.12, 0.4))
    distance, angle = errors(calibrate_pose([seen(upright, 0, looks_ahead, 1)], CAMERA), looks_ahead)
    assert distance < 2e-3 and angle < 0.1


def test_moved_board_is_dropped_in_one_image_and_rejected_in_all(places):
    T_world_board, (first, second, third) = places[0]
    moved = replace(second, name="moved", pixels=second.pixels + np.array([2.5, -1.0]))
    found = calibrate_pose([(T_world_board, [first, moved, third]), *places[1:]], CAMERA)
    assert [view.name for view in found.dropped] == ["moved"]
    assert errors(found)[0] < 0.5e-3
    wrong = [(on_table(0.35, -0.05, 0.1), places[0][1]), *places[1:]]
    with pytest.raises(CalibrationFailed, match="are inconsistent"):
        calibrate_pose(wrong, CAMERA)


def test_missing_board_and_wrong_size_are_one_line_errors():
    with pytest.raises(CalibrationFailed, match="no image shows the board"):
        calibrate_pose([(np.eye(4), [])], CAMERA)
    images = [("a", np.zeros((240, 320, 3), np.uint8)), ("b", np.full((480, 640, 3), 90, np.uint8)),
              ("c", np.zeros((480, 640, 3), np.uint8))]
    assert detect_boards(BOARD, images, CAMERA) == ([], [
        "the image is 320x240, but the intrinsics are for 640x480", "no marker is visible",
        "too dark: its brightest part is 0 of 255"])
