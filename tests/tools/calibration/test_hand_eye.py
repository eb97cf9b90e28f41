import math

import numpy as np
import pytest

from common.config import load_cell
from common.robot.model import RobotModel
from common.robot.transforms import invert, rpy_to_matrix, transform
from tests.tools.calibration.rendered_boards import BOARD, Lens, facing, render
from tools.calibration.board import BoardDetection
from tools.calibration.hand_eye import View, calibrate_hand_eye
from tools.calibration.intrinsics import CalibrationFailed

LENS = Lens()
CAMERA = LENS.camera()
ROBOT = RobotModel.load(load_cell("panda").robot)
TRUTH = {  # the camera in the tool center point, or in world; the board in world, or in the tool center point
    "hand": (transform(rpy_to_matrix(0.05, -0.1, 1.5), (0.06, 0.01, -0.09)),
             transform(rpy_to_matrix(0, 0, 0.3), (0.45, 0, 0))),
    "beside": (transform(rpy_to_matrix(-2.2, 0.1, 1.6), (1.2, 0.05, 0.7)),
               transform(rpy_to_matrix(0.1, 0.05, 0.7), (0.01, -0.02, 0.03))),
}


def hands(mount: str, count: int, turn: float = 0.45) -> list[np.ndarray]:
    """Return poses of the tool center point from which the camera sees the complete board, turned to all sides."""
    A, B = TRUTH[mount]
    rng, found = np.random.default_rng(5), []
    while len(found) < count:
        T_camera_board = facing(BOARD, *rng.uniform(-0.05, 0.05, 2), rng.uniform(0.35, 0.55),
                                *rng.uniform(-turn, turn, 2), rng.uniform(-turn, turn))
        M = A @ T_camera_board @ invert(B)
        found.append(invert(M) if mount == "hand" else M)
    return found


def view(T_camera_board: np.ndarray, T_world_tcp: np.ndarray, seed: int, noise: float = 0.0) -> View:
    """Compute a view with noise [px]."""
    pixels = LENS.project(T_camera_board, BOARD.corners)
    pixels = pixels + np.random.default_rng(seed).normal(0, noise, pixels.shape)
    return View(BoardDetection(f"p{seed}", (640, 480), BOARD.corners, pixels, 0.5, pixels[:4]), T_world_tcp)


def board_seen(mount: str, T_world_tcp: np.ndarray) -> np.ndarray:
    A, B = TRUTH[mount]
    return invert(A) @ (invert(T_world_tcp) if mount == "hand" else T_world_tcp) @ B


def views_of(mount: str, count: int, noise: float = 0.1, seed: int = 0) -> list[View]:
    return [view(board_seen(mount, T), T, seed + n, noise) for n, T in enumerate(hands(mount, count))]


def off(found: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Return distance [m] and angle [rad]."""
    turn = found[:3, :3].T @ truth[:3, :3]
    return float(np.linalg.norm(found[:3, 3] - truth[:3, 3])), math.acos(min((np.trace(turn) - 1) / 2, 1.0))


def test_camera_next_to_the_arm_is_found_in_rendered_images():
    mount, views = "beside", []
    for n, T in enumerate(hands(mount, 8)):
        detection = BOARD.find(render(BOARD, LENS, board_seen(mount, T), seed=n), f"p{n}")
        assert isinstance(detection, BoardDetection)
        views.append(View(detection, T))
    result = calibrate_hand_eye(views, CAMERA, mount)
    metres, radians = off(result.T_mount_camera, TRUTH[mount][0])
    assert metres < 5e-4 and radians < 1e-3 and result.rms < 0.1
    assert off(result.T_other_board, TRUTH[mount][1])[0] < 5e-4
    assert result.verdict.startswith("good") and len(result.pictures) == 8 and not result.dropped
    assert np.allclose(rpy_to_matrix(*result.rpy), result.T_mount_camera[:3, :3])


@pytest.mark.slow
@pytest.mark.parametrize("mount", TRUTH)
def test_reported_uncertainty_matches_the_error(mount):
    ratios = []
    for trial in range(12):
        result = calibrate_hand_eye(views_of(mount, 12, 0.5, 100 * trial), CAMERA, mount)
        ratios.append(off(result.T_mount_camera, TRUTH[mount][0])[0] / np.linalg.norm(result.position_std))
    assert 0.4 < float(np.sqrt(np.mean(np.square(ratios)))) < 1.6


@pytest.mark.parametrize("mount", TRUTH)
def test_inaccurate_arm_worsens_the_verdict(mount):
    rng = np.random.default_rng(2)
    wrong = [transform(rpy_to_matrix(*rng.normal(0, 4e-3, 3)), rng.normal(0, 2e-3, 3)) for _ in range(14)]
    views = [View(view.detection, view.T_world_tcp @ T) for view, T in zip(views_of(mount, 14), wrong, strict=True)]
    result = calibrate_hand_eye(views, CAMERA, mount)
    assert not result.verdict.startswith("good") and result.rms > 1.0


@pytest.mark.parametrize("mount", TRUTH)
def test_view_with_wrong_joints_is_dropped_by_name(mount):
    views = views_of(mount, 10)
    views[3] = View(views[3].detection, views[7].T_world_tcp)
    result = calibrate_hand_eye(views, CAMERA, mount)
    assert [view.name for view in result.dropped] == ["p3"]
    assert off(result.T_mount_camera, TRUTH[mount][0])[0] < 1e-3


def test_undetermined_problems_are_rejected():
    views = views_of("hand", 8)
    still = [View(view.detection, views[0].T_world_tcp @ transform(rpy_to_matrix(0, 0, 0.3 * n), (0, 0, 0)))
             for n, view in enumerate(views)]
    for given, mount, reason in ((views[:5], "hand", "5 views of the board, 6 are needed"),
                                 (still, "hand", "degrees about a second axis, 5 are needed"),
                                 (views, "beside", r"are inconsistent.* the camera is next to the arm")):
        with pytest.raises(CalibrationFailed, match=reason):
            calibrate_hand_eye(given, CAMERA, mount)


def test_gripper_poses_follow_from_the_joints():
    rng, home = np.random.default_rng(0), ROBOT.named("home")
    truth = transform(rpy_to_matrix(*rng.uniform(-0.1, 0.1, 3)), (0.05, 0.0, -0.1))
    board = ROBOT.fk(home) @ truth @ facing(BOARD, 0, 0, 0.4)
    poses = [ROBOT.fk(home + rng.uniform(-0.35, 0.35, 7)) for _ in range(12)]
    views = [view(invert(T @ truth) @ board, T, n) for n, T in enumerate(poses)]
    assert off(calibrate_hand_eye(views, CAMERA, "hand").T_mount_camera, truth)[0] < 1e-4
