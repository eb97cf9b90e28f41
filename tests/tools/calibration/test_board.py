import cv2
import numpy as np
import pytest

from common.config import check
from common.errors import ConfigError
from common.robot.transforms import invert, rpy_to_matrix, transform
from tests.tools.calibration.rendered_boards import BOARD, Lens, facing, render
from tools.calibration.board import Board, BoardDetection, BoardOptions, NoBoard

LENS = Lens()


def expected(lens, points, T_camera_board):
    rotation = cv2.Rodrigues(T_camera_board[:3, :3])[0]
    return cv2.projectPoints(points, rotation, T_camera_board[:3, 3], lens.k, np.array(lens.d))[0][:, 0]


@pytest.mark.parametrize(
    "pose", [(0.02, -0.01, 0.5, 0.4, 0.0, 0.1), (-0.08, 0.05, 0.6, -0.3, 0.4, -0.5), (0.05, 0.08, 0.75, 0.1, -0.5, 2.0)]
)
def test_corners_are_accurate_to_a_twentieth_of_a_pixel(pose):
    T = facing(BOARD, *pose)
    found = BOARD.find(render(BOARD, LENS, T), "a picture")
    assert isinstance(found, BoardDetection) and len(found.points) == 24
    errors = np.linalg.norm(found.pixels - expected(LENS, found.points, T), axis=1)
    assert np.sqrt((errors**2).mean()) < 0.03 and errors.max() < 0.08


def test_board_frame_is_lower_left_with_z_out_of_the_paper():
    T_world_board = transform(rpy_to_matrix(0, 0, 0), (0.3, -0.1, 0.0))
    T_world_camera = transform(rpy_to_matrix(np.pi, 0, -np.pi / 2), (0.4, 0.0, 0.6))  # looks down; right is -y
    found = BOARD.find(render(BOARD, Lens(d=()), invert(T_world_camera) @ T_world_board), "a picture")
    assert isinstance(found, BoardDetection)
    right = found.pixels[np.argmax(found.points[:, 0])] - found.pixels[np.argmin(found.points[:, 0])]
    assert right[1] < -100  # +x of world is up in that picture


def test_page_has_the_stated_size_and_shows_the_board():
    for options in (BoardOptions(), BoardOptions(columns=11, rows=8, square=0.0215, marker=0.016, dictionary="5x5_50")):
        board = Board(options)
        page, density = board.page()
        assert 11000 < density < 12000
        height, width = page.shape
        whole = np.pad(page, ((0, -height % 4), (0, -width % 4)), constant_values=255)
        found = board.find(cv2.resize(whole, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA), "the page")
        assert isinstance(found, BoardDetection) and len(found.points) == (options.columns - 1) * (options.rows - 1)
        margin = (width - options.columns * options.square * density) / 2
        edges = np.array([margin, height - margin]) + found.points[:, :2] * density * (1, -1)
        np.testing.assert_allclose(found.pixels, edges / 4 - 0.5, atol=0.06)


@pytest.mark.parametrize(
    ("printed", "kind", "reason"),
    [
        (BoardOptions(columns=6, rows=5), "other board", "differs from a board of 7x5 squares"),
        (BoardOptions(columns=10, rows=7, square=0.025, marker=0.019), "other board", "is not on a board of 7x5"),
        (BoardOptions(marker=0.02), "other board", "of a square long, not 0.75 as 27 mm would be"),
        (BoardOptions(dictionary="5x5_50"), "nothing", "no marker is visible"),
    ],
)
def test_other_boards_are_recognized(printed, kind, reason):
    board = Board(printed)
    found = BOARD.find(render(board, LENS, facing(board, 0, 0, 0.4, 0.2, 0.2)), "a picture")
    assert isinstance(found, NoBoard) and found.kind == kind and reason in found.reason


def test_missing_board_and_blur_are_distinguished():
    empty = np.full((480, 640, 3), 120, np.uint8)
    assert BOARD.find(empty, "x").kind == "nothing"
    blurred = BOARD.find(render(BOARD, LENS, facing(BOARD, 0, 0, 0.5), blur=3.0), "x")
    assert blurred.kind == "blurred" and "px" in blurred.reason


def test_blur_is_measured():
    for true in (0.7, 1.0, 1.4):
        found = BOARD.find(render(BOARD, LENS, facing(BOARD, 0, 0, 0.42), blur=true, noise=1), "x")
        assert found.blur == pytest.approx(np.hypot(true, 0.29), rel=0.15)


def test_covered_corners_are_omitted_without_affecting_others():
    T = facing(BOARD, 0, 0, 0.45, 0.2)
    picture = render(BOARD, LENS, T)
    whole = BOARD.find(picture, "x")
    cv2.circle(picture, tuple(int(v) for v in whole.pixels.mean(axis=0)), 45, (90, 120, 180), -1)
    found = BOARD.find(picture, "x")
    assert isinstance(found, BoardDetection) and 8 <= len(found.points) < len(whole.points)
    assert np.linalg.norm(found.pixels - expected(LENS, found.points, T), axis=1).max() < 0.1


def test_uneven_light_moves_no_corner():
    T = facing(BOARD, 0.02, 0.01, 0.5, 0.3, -0.2)
    dim = render(BOARD, LENS, T) * np.linspace(1.0, 0.35, 640)[:, None]
    found = BOARD.find(np.clip(dim, 0, 255).astype(np.uint8), "x")
    assert isinstance(found, BoardDetection) and len(found.points) == 24
    assert np.linalg.norm(found.pixels - expected(LENS, found.points, T), axis=1).max() < 0.08


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"marker": 0.036}, "must be 0.4 to 0.95 of square"),
        ({"columns": 20, "rows": 20}, "squares need 200 markers; dictionary has 50"),
        ({"columns": 2}, "columns"),
        ({"square": float("nan")}, "square"),
    ],
)
def test_impossible_board_is_a_one_line_error(values, reason):
    with pytest.raises(ConfigError, match=reason):
        check(BoardOptions, values)
