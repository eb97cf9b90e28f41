import cv2
import numpy as np
import pytest

from common.config import check
from common.errors import ConfigError
from common.robot.transforms import invert, rpy_to_matrix, transform
from tests.tools.calibration.rendered_boards import BOARD, Lens, facing, render
from tools.calibration.board import Board, BoardDetection, BoardOptions, NoBoard

LENS = Lens()


def found_in(image, board=BOARD):
    found = board.find(image, "an image")
    assert isinstance(found, BoardDetection)
    return found


def errors(found, T_camera_board):
    """Return the distances from the true pixels [px]."""
    return np.linalg.norm(found.pixels - LENS.project(T_camera_board, found.points), axis=1)


@pytest.mark.parametrize(
    "pose", [(0.02, -0.01, 0.5, 0.4, 0.0, 0.1), (-0.08, 0.05, 0.6, -0.3, 0.4, -0.5), (0.05, 0.08, 0.75, 0.1, -0.5, 2.0)]
)
def test_corners_are_accurate_to_a_twentieth_of_a_pixel_also_in_uneven_light(pose):
    T = facing(BOARD, *pose)
    image = render(BOARD, LENS, T)
    off = errors(found_in(image), T)
    assert len(off) == 24 and np.sqrt((off**2).mean()) < 0.03 and off.max() < 0.08
    dim = np.clip(image * np.linspace(1.0, 0.35, 640)[:, None], 0, 255).astype(np.uint8)
    off = errors(found_in(dim), T)
    assert len(off) == 24 and off.max() < 0.08


def test_board_frame_is_lower_left_with_z_out_of_the_paper():
    T_world_board = transform(rpy_to_matrix(0, 0, 0), (0.3, -0.1, 0.0))
    T_world_camera = transform(rpy_to_matrix(np.pi, 0, -np.pi / 2), (0.4, 0.0, 0.6))  # looks down; right is -y
    found = found_in(render(BOARD, Lens(d=()), invert(T_world_camera) @ T_world_board))
    right = found.pixels[np.argmax(found.points[:, 0])] - found.pixels[np.argmin(found.points[:, 0])]
    assert right[1] < -100  # +x of world is up in that image


@pytest.mark.parametrize("options", [
    BoardOptions(), BoardOptions(columns=11, rows=8, square=0.0215, marker=0.016, dictionary="5x5_50")])
def test_page_has_the_stated_size_and_shows_the_board(options):
    board = Board(options)
    page, density = board.page()
    assert 11000 < density < 12000
    height, width = page.shape
    padded = np.pad(page, ((0, -height % 4), (0, -width % 4)), constant_values=255)
    found = found_in(cv2.resize(padded, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA), board)
    assert len(found.points) == (options.columns - 1) * (options.rows - 1)
    margin = (width - options.columns * options.square * density) / 2
    edges = np.array([margin, height - margin]) + found.points[:, :2] * density * (1, -1)
    np.testing.assert_allclose(found.pixels, edges / 4 - 0.5, atol=0.06)


@pytest.mark.parametrize(("printed", "kind", "reason"), [
    (BoardOptions(columns=6, rows=5), "other board", "differs from a board of 7x5 squares"),
    (BoardOptions(columns=10, rows=7, square=0.025, marker=0.019), "other board", "is not on a board of 7x5"),
    (BoardOptions(marker=0.02), "other board", "of a square long, not 0.75 as 27 mm would be"),
    (BoardOptions(dictionary="5x5_50"), "nothing", "no marker is visible"),
    (None, "nothing", "no marker is visible"),
])
def test_other_and_missing_boards_are_recognized(printed, kind, reason):
    image = np.full((480, 640, 3), 120, np.uint8)
    if printed is not None:
        board = Board(printed)
        image = render(board, LENS, facing(board, 0, 0, 0.4, 0.2, 0.2))
    found = BOARD.find(image, "an image")
    assert isinstance(found, NoBoard) and found.kind == kind and reason in found.reason


@pytest.mark.parametrize("rows", [4, 5])
def test_pattern_of_older_opencv_is_detected_drawn_and_suggested(rows):
    new = Board(BoardOptions(rows=rows))
    old = Board(BoardOptions(rows=rows, legacy=True))
    T = facing(new, 0, 0, 0.5, 0.3, 0.2)
    for board, other, advice in ((new, old, "leave out --legacy"), (old, new, "add --legacy")):
        off = errors(found_in(render(board, LENS, T), board), T)
        assert len(off) == 6 * (rows - 1) and off.max() < 0.08
        mismatch = other.find(render(board, LENS, T), "an image")
        assert isinstance(mismatch, BoardDetection) if rows % 2 else advice in mismatch.reason
        assert len(found_in(opencv_page(board), board).points) == 6 * (rows - 1), "the print of OpenCV is the same"


def opencv_page(board):
    o = board.options
    printed = cv2.aruco.CharucoBoard((o.columns, o.rows), o.square, o.marker, cv2.aruco.getPredefinedDictionary(0))
    printed.setLegacyPattern(o.legacy)
    return cv2.GaussianBlur(np.pad(printed.generateImage((o.columns * 60, o.rows * 60)), 40, constant_values=255),
                            (0, 0), 0.7)


@pytest.mark.parametrize(("change", "reason"), [
    (lambda image: cv2.flip(image, 1), "is mirrored"), (lambda image: cv2.flip(image, 0), "is mirrored"),
    (lambda image: 255 - image, "is a negative"), (lambda image: image // 12, "too dark: its brightest part is "),
])
def test_mirrored_negative_and_dark_images_are_named(change, reason):
    image = render(BOARD, LENS, facing(BOARD, 0, 0, 0.5, 0.3, 0.2))
    assert reason in BOARD.find(np.ascontiguousarray(change(image)), "an image").reason


def test_blur_is_measured_and_limited():
    for true in (0.7, 1.0, 1.4):
        found = found_in(render(BOARD, LENS, facing(BOARD, 0, 0, 0.42), blur=true, noise=1))
        assert found.blur == pytest.approx(np.hypot(true, 0.29), rel=0.15)
    blurred = BOARD.find(render(BOARD, LENS, facing(BOARD, 0, 0, 0.5), blur=3.0), "an image")
    assert blurred.kind == "blurred" and "px" in blurred.reason


def test_covered_corners_are_omitted_without_affecting_others():
    T = facing(BOARD, 0, 0, 0.45, 0.2)
    image = render(BOARD, LENS, T)
    center = found_in(image).pixels.mean(axis=0)
    cv2.circle(image, tuple(int(v) for v in center), 45, (90, 120, 180), -1)
    off = errors(found_in(image), T)
    assert 8 <= len(off) < 24 and off.max() < 0.1


@pytest.mark.parametrize(("values", "reason"), [
    ({"marker": 0.036}, "must be 0.4 to 0.95 of square"),
    ({"columns": 20, "rows": 20}, "squares need 200 markers; dictionary has 50"),
    ({"columns": 2}, "columns"), ({"square": float("nan")}, "square"),
])
def test_impossible_board_is_a_one_line_error(values, reason):
    with pytest.raises(ConfigError, match=reason):
        check(BoardOptions, values)
