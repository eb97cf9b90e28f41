import math

import cv2
import numpy as np
import pytest

from common.config import load_cell
from common.perception.camera_file import CameraFile
from common.robot.model import RobotModel
from common.robot.transforms import invert, rpy_to_matrix, transform
from tests.tools.calibration.rendered_boards import BOARD, Lens, facing, render
from tools.calibration.board import BoardDetection
from tools.calibration.hand_eye import View, calibrate_hand_eye
from tools.calibration.intrinsics import CalibrationFailed

LENS = Lens()
CAMERA = CameraFile(width=LENS.width, height=LENS.height, fx=LENS.fx, fy=LENS.fy, cx=LENS.cx, cy=LENS.cy,
                    d=list(LENS.d))
ROBOT = RobotModel.load(load_cell("panda").robot)
TRUTH = {  # the camera in the tool centre point, or in world; the board in world, or in the tool centre point
    "hand": (transform(rpy_to_matrix(0.05, -0.1, 1.5), (0.06, 0.01, -0.09)),
             transform(rpy_to_matrix(0, 0, 0.3), (0.45, 0, 0))),
    "beside": (transform(rpy_to_matrix(-2.2, 0.1, 1.6), (1.2, 0.05, 0.7)),
               transform(rpy_to_matrix(0.1, 0.05, 0.7), (0.01, -0.02, 0.03))),
}


def hands(mount: str, count: int, turn: float = 0.45) -> list[np.ndarray]:
    """Poses of the tool centre point in world from which the camera sees the board whole, turned to all sides."""
    A, B = TRUTH[mount]
    rng, found = np.random.default_rng(5), []
    while len(found) < count:
        T_camera_board = facing(BOARD, *rng.uniform(-0.05, 0.05, 2), rng.uniform(0.35, 0.55),
                                *rng.uniform(-turn, turn, 2), rng.uniform(-turn, turn))
        M = A @ T_camera_board @ invert(B)
        found.append(invert(M) if mount == "hand" else M)
    return found


def seen(mount: str, T_world_tcp: np.ndarray, seed: int, *, noise: float = 0.1, drawn: bool = False) -> View:
    """What the camera sees of the board: drawn, or just computed, with noise [px]."""
    A, B = TRUTH[mount]
    T = invert(A) @ (invert(T_world_tcp) if mount == "hand" else T_world_tcp) @ B
    if drawn:
        sighting = BOARD.find(render(BOARD, LENS, T, seed=seed), f"p{seed}")
        assert isinstance(sighting, BoardDetection)
        return View(sighting, T_world_tcp)
    pixels = cv2.projectPoints(BOARD.corners, cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], LENS.k, np.array(LENS.d))[0][:, 0]
    pixels = pixels + np.random.default_rng(seed).normal(0, noise, pixels.shape)
    return View(BoardDetection(f"p{seed}", (640, 480), BOARD.corners, pixels, 0.5, pixels[:4]), T_world_tcp)


def off(found: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """[m], [rad]."""
    turn = found[:3, :3].T @ truth[:3, :3]
    return float(np.linalg.norm(found[:3, 3] - truth[:3, 3])), math.acos(min((np.trace(turn) - 1) / 2, 1.0))


@pytest.mark.parametrize("mount", TRUTH)
def test_hand_eye_calibration_finds_the_camera_in_rendered_images(mount):
    result = calibrate_hand_eye(
        [seen(mount, T, n, drawn=True) for n, T in enumerate(hands(mount, 10))], CAMERA, mount)
    metres, radians = off(result.T_mount_camera, TRUTH[mount][0])
    assert metres < 5e-4 and radians < 1e-3 and result.rms < 0.1
    assert off(result.T_other_board, TRUTH[mount][1])[0] < 5e-4
    assert result.verdict.startswith("good") and len(result.pictures) == 10 and not result.dropped
    assert np.allclose(rpy_to_matrix(*result.rpy), result.T_mount_camera[:3, :3])


@pytest.mark.slow
@pytest.mark.parametrize("mount", TRUTH)
def test_reported_uncertainty_matches_the_error(mount):
    ratios = []
    for trial in range(12):
        views = [seen(mount, T, 100 * trial + n, noise=0.5) for n, T in enumerate(hands(mount, 12))]
        result = calibrate_hand_eye(views, CAMERA, mount)
        ratios.append(off(result.T_mount_camera, TRUTH[mount][0])[0] / np.linalg.norm(result.position_std))
    assert 0.4 < float(np.sqrt(np.mean(np.square(ratios)))) < 1.6


@pytest.mark.parametrize("mount", TRUTH)
def test_inaccurate_arm_worsens_the_verdict(mount):
    rng = np.random.default_rng(2)
    views = []
    for n, T in enumerate(hands(mount, 14)):
        view = seen(mount, T, n)
        wrong = transform(rpy_to_matrix(*rng.normal(0, 4e-3, 3)), rng.normal(0, 2e-3, 3))
        views.append(View(view.detection, view.T_world_tcp @ wrong))
    result = calibrate_hand_eye(views, CAMERA, mount)
    assert not result.verdict.startswith("good") and result.rms > 1.0


@pytest.mark.parametrize("mount", TRUTH)
def test_view_with_wrong_joints_is_dropped_by_name(mount):
    poses = hands(mount, 10)
    views = [seen(mount, T, n) for n, T in enumerate(poses)]
    views[3] = View(views[3].detection, poses[7])
    result = calibrate_hand_eye(views, CAMERA, mount)
    assert [view.name for view in result.dropped] == ["p3"]
    assert off(result.T_mount_camera, TRUTH[mount][0])[0] < 1e-3


def test_undetermined_problems_are_rejected():
    views = [seen("hand", T, n) for n, T in enumerate(hands("hand", 8))]
    with pytest.raises(CalibrationFailed, match="5 views of the board, 6 are needed"):
        calibrate_hand_eye(views[:5], CAMERA, "hand")
    still = [View(view.detection, views[0].T_world_tcp @ transform(rpy_to_matrix(0, 0, 0.3 * n), (0, 0, 0)))
             for n, view in enumerate(views)]
    with pytest.raises(CalibrationFailed, match="degrees about a second axis, 5 are needed"):
        calibrate_hand_eye(still, CAMERA, "hand")
    with pytest.raises(CalibrationFailed, match=r"are inconsistent.* the camera is beside the arm"):
        calibrate_hand_eye(views, CAMERA, "beside")


@pytest.mark.parametrize("seed", range(4))
def test_gripper_pose_follows_from_the_joints(seed):
    """The whole chain: joints, their forward kinematics, a picture, the camera."""
    rng = np.random.default_rng(seed)
    truth = transform(rpy_to_matrix(*rng.uniform(-0.1, 0.1, 3)), (0.05, 0.0, -0.1))
    views = []
    board = ROBOT.fk(ROBOT.named("home")) @ truth @ facing(BOARD, 0, 0, 0.4)
    for n in range(12):
        T = ROBOT.fk(ROBOT.named("home") + rng.uniform(-0.35, 0.35, 7))
        seen_at = invert(T @ truth) @ board
        pixels = cv2.projectPoints(BOARD.corners, cv2.Rodrigues(seen_at[:3, :3])[0], seen_at[:3, 3], LENS.k,
                                   np.array(LENS.d))[0][:, 0]
        views.append(View(BoardDetection(f"p{n}", (640, 480), BOARD.corners, pixels, 0.5, pixels[:4]), T))
    result = calibrate_hand_eye(views, CAMERA, "hand")
    assert off(result.T_mount_camera, truth)[0] < 1e-4
