from dataclasses import replace

import cv2
import numpy as np
import pytest

from common.perception.camera_file import CameraFile
from common.robot.transforms import invert, rpy_to_matrix, transform
from tests.tools.calibration.rendered_boards import BOARD, Lens, render
from tools.calibration.camera_pose import calibrate_pose, detect_boards
from tools.calibration.intrinsics import CalibrationFailed

LENS = Lens()
CAMERA = CameraFile(width=640, height=480, fx=LENS.fx, fy=LENS.fy, cx=LENS.cx, cy=LENS.cy, d=list(LENS.d))
T_WORLD_CAMERA = transform(rpy_to_matrix(np.pi - 0.06, 0.04, -np.pi / 2 + 0.1), (0.42, -0.01, 0.80))


def lying(x, y, yaw, z=0.0):
    return transform(rpy_to_matrix(0, 0, yaw), (x, y, z))


def seen_at(T_world_board, count=3, seed=0):
    pictures = [(f"picture {seed + k}", render(BOARD, LENS, invert(T_WORLD_CAMERA) @ T_world_board, seed=seed + k))
                for k in range(count)]
    found, reasons = detect_boards(BOARD, pictures, CAMERA)
    assert not reasons
    return T_world_board, found


def errors(found, truth=T_WORLD_CAMERA):
    """Distance [m] and angle [deg] from the truth."""
    T = invert(truth) @ found.T_world_camera
    return np.linalg.norm(found.T_world_camera[:3, 3] - truth[:3, 3]), np.degrees(
        np.linalg.norm(cv2.Rodrigues(T[:3, :3])[0])
    )


@pytest.fixture(scope="module")
def places():
    return [seen_at(lying(0.35, -0.15, 0.1)), seen_at(lying(0.3, 0.15, 1.7), seed=5),
            seen_at(lying(0.55, -0.35, 1.2), seed=9)]


def test_one_board_pose_gives_the_camera_within_a_millimeter_and_a_tenth_of_a_degree(places):
    found = calibrate_pose(places[:1], CAMERA)
    distance, angle = errors(found)
    assert distance < 1e-3 and angle < 0.1
    assert found.rms < 0.05 and found.rms_on_board < 1e-4 and len(found.pictures) == 3 and not found.dropped
    np.testing.assert_allclose(rpy_to_matrix(*found.rpy), found.T_world_camera[:3, :3], atol=1e-9)
    assert found.position == pytest.approx(tuple(found.T_world_camera[:3, 3]))


def test_several_board_poses_reduce_error_and_uncertainty(places):
    one, several = calibrate_pose(places[:1], CAMERA), calibrate_pose(places, CAMERA)
    distance, angle = errors(several)
    assert distance < 0.3e-3 and angle < 0.03
    assert max(several.position_std) < max(one.position_std) / 2
    assert several.rotation_std < one.rotation_std / 2 and several.place_std < one.place_std / 2


def test_upright_rotated_board_is_supported():
    looks_ahead = transform(rpy_to_matrix(-np.pi / 2, 0, -np.pi / 2), (0.0, 0.0, 0.5))  # along +x, upright
    upright = transform(rpy_to_matrix(np.pi / 2, 0, -np.pi / 2 + 0.3), (0.7, 0.12, 0.4))
    pictures = [("a", render(BOARD, LENS, invert(looks_ahead) @ upright))]
    found = calibrate_pose([(upright, detect_boards(BOARD, pictures, CAMERA)[0])], CAMERA)
    distance, angle = errors(found, looks_ahead)
    assert distance < 2e-3 and angle < 0.1


def test_image_with_a_moved_board_is_dropped_by_name(places):
    T_world_board, seen = places[0]
    moved = replace(seen[1], name="moved", pixels=seen[1].pixels + np.array([2.5, -1.0]))
    found = calibrate_pose([(T_world_board, [seen[0], moved, seen[2]]), *places[1:]], CAMERA)
    assert [view.name for view in found.dropped] == ["moved"]
    assert errors(found)[0] < 0.5e-3


def test_inconsistent_board_poses_are_rejected(places):
    wrong = [(lying(0.35, -0.05, 0.1), places[0][1]), *places[1:]]
    with pytest.raises(CalibrationFailed, match="are inconsistent"):
        calibrate_pose(wrong, CAMERA)


def test_missing_board_and_wrong_size_are_one_line_errors():
    with pytest.raises(CalibrationFailed, match="no image shows the board"):
        calibrate_pose([(np.eye(4), [])], CAMERA)
    with pytest.raises(CalibrationFailed, match="a is 320x240, but the intrinsics are for 640x480"):
        detect_boards(BOARD, [("a", np.zeros((240, 320, 3), np.uint8))], CAMERA)
    found, reasons = detect_boards(BOARD, [("a", np.zeros((480, 640, 3), np.uint8))], CAMERA)
    assert not found and reasons == ["no marker is visible"]
