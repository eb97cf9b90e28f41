"""Bad input to the verbs of outlining gets one line that names what is wrong, and no traceback."""

import io
from pathlib import Path

import cv2
import numpy as np
import pytest

from applications.outlining import stage_files
from cli.main import app


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A picture and its depth of the size that the UR5's camera has, with nothing in them."""
    picture = np.zeros((768, 1024, 3), np.uint8)
    stage_files.write_pictures(tmp_path, picture, np.full((768, 1024), 1.75, np.float32))
    return tmp_path


def one_line(capsys: pytest.CaptureFixture[str], code: int, *arguments: str) -> str:
    assert app.execute(arguments) == code
    said = capsys.readouterr().err
    assert said.startswith("zencell: ") and said.count("\n") == 1
    return said


def test_folder_without_a_picture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "camera_image.png: is missing" in one_line(capsys, 2, "outline", str(tmp_path))


def test_depth_that_is_no_array(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / stage_files.DEPTH).write_bytes(b"nothing of that kind")
    assert "depth_data.npy: " in one_line(capsys, 2, "outline", str(folder))


def test_depth_of_another_size_than_the_picture(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.save(folder / stage_files.DEPTH, np.ones((10, 20), np.float32))
    assert "20x10, but camera_image.png is 1024x768" in one_line(capsys, 2, "outline", str(folder))


def test_picture_of_another_size_than_the_camera_has(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stage_files.write_pictures(tmp_path, np.zeros((48, 64, 3), np.uint8), np.ones((48, 64), np.float32))
    assert "'64x48' must be as large as the camera's: 1024x768" in one_line(capsys, 2, "outline", str(tmp_path))


def test_depth_without_any_depth(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.save(folder / stage_files.DEPTH, np.full((768, 1024), np.nan, np.float32))
    assert "no valid depth at all" in one_line(capsys, 2, "outline", str(folder))


def test_picture_without_a_contour(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "no contour" in one_line(capsys, 1, "outline", str(folder))


def test_choice_that_is_none(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "choices: " in one_line(capsys, 2, "outline", str(folder), "--select", "purple")
    assert "chooses nothing" in one_line(capsys, 2, "outline", str(folder), "--select", "none")
    assert "choices: " in one_line(capsys, 2, "task", "select", "purple")


def test_object_at_the_border_only(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = np.zeros((768, 1024, 3), np.uint8)
    picture[300:400, :100] = (0, 255, 255)
    cv2.imwrite(str(folder / stage_files.PICTURE), picture)
    assert "every contour touches the border" in one_line(capsys, 1, "outline", str(folder))


@pytest.mark.parametrize(
    ("text", "said"),
    [("", "is not valid JSON"), ("[[1, 2, 3]]", "at least 3 points"), ("[[0, 0, 1], [0, 1, 1], [1, 1]]", "entry 2")],
)
def test_coordinates_that_can_not_be_used(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, said: str
) -> None:
    (tmp_path / stage_files.CLEARED).write_text(text)
    told = one_line(capsys, 2, "run", "ur5", "--from", str(tmp_path))
    assert f"{stage_files.CLEARED}: " in told and said in told


def test_coordinates_that_are_missing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "is missing" in one_line(capsys, 2, "run", "ur5", "--from", str(tmp_path))


def test_cell_that_outlines_nothing_has_no_object_to_choose(capsys: pytest.CaptureFixture[str]) -> None:
    assert "'panda' needs a cell that outlines objects" in one_line(capsys, 2, "run", "panda", "--ask")
    assert "'panda' needs a cell that outlines objects" in one_line(capsys, 2, "run", "panda", "--from", ".")


def test_nobody_can_be_asked_without_a_terminal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO())
    assert "--ask: needs a terminal" in one_line(capsys, 2, "run", "ur5", "--ask")
