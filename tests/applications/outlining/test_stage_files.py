"""Files of the stages of an outline: round trips, and rejections that name the file."""

import json

import numpy as np
import pytest

from applications.outlining import stage_files as files
from applications.outlining.stage_files import StageFileError
from tests.applications.outlining.outline_scenes import seen_world


@pytest.fixture(scope="module")
def images():
    return seen_world("w2")[1:]


def test_images_round_trip(tmp_path, images):
    folder = tmp_path / "new" / "folder"
    files.write_pictures(folder, *images)
    for read, written in zip(files.read_pictures(folder), images, strict=True):
        np.testing.assert_array_equal(read, written)
    assert sorted(p.name for p in folder.iterdir()) == [
        "camera_image.png", "depth_camera_image.png", "depth_camera_image_normalized.png", "depth_data.npy"]
    shown = files.read_picture(folder / files.NORMALIZED)[..., 0]
    assert shown[384, 512] == 255 and shown[0, 0] == 0 and 0 < shown[384, 5] < 255


def test_points_round_trip_and_integral_pixels_have_no_decimal_point(tmp_path):
    pixels, points = np.array([[1, 2], [3, 4], [5, 6]]), np.array([[0.1, -0.2, 1.1], [0.123456789, 0, 1], [1, 2, 3]])
    files.write_points(tmp_path / files.PIXELS, pixels)
    files.write_points(tmp_path / files.CLEARED, points)
    np.testing.assert_array_equal(files.read_pixels(tmp_path / files.PIXELS), pixels)
    np.testing.assert_allclose(files.read_coordinates(tmp_path / files.CLEARED), points, atol=1e-9)
    assert "[1, 2]" in (tmp_path / files.PIXELS).read_text()
    assert len(json.loads((tmp_path / files.CLEARED).read_text())) == 3


@pytest.mark.parametrize(("text", "problem"), [
    (b"", "is not valid JSON"), (b"[[1, 2, 3]", "is not valid JSON"), (b"[" * 100_000, "is not valid JSON"),
    (b"\xff\xfe\x00", "is not valid JSON"), (b"{}", r"list of at least 3 points .*, not dict"),
    (b"[]", "not 0 entries"),
    (b"[[1,2,3],[1,2,3],[1,2]]", r"entry 2 must be \[x, y, z\] of finite numbers, not \[1, 2\]"),
    (b"[[1,2,3],[1,2,NaN],[1,2,3]]", "entry 1 "), (b'[[1,2,3],[1,2,"3"],[1,2,3]]', "entry 1 "),
    (b"[[1,2,3],[1,2,true],[1,2,3]]", "entry 1 "), (b"[[1,2,3],7,[1,2,3]]", "entry 1 .*not 7"),
    (b"[[1,2,3],[1,2,1e400],[1,2,3]]", "entry 1 "),
])
def test_malformed_points_are_rejected_with_the_file_name(tmp_path, text, problem):
    path = tmp_path / files.CLEARED
    path.write_bytes(text)
    with pytest.raises(StageFileError, match=problem) as caught:
        files.read_coordinates(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(("read", "name"), [
    (files.read_picture, files.PICTURE), (files.read_depth, files.DEPTH), (files.read_pixels, files.PIXELS)])
def test_missing_file_is_named(tmp_path, read, name):
    with pytest.raises(StageFileError, match=f"{name}: is missing"):
        read(tmp_path / name)


@pytest.mark.parametrize("content", [b"", b"not a picture"])
def test_wrong_binary_files_are_rejected(tmp_path, content):
    for read, name, problem in ((files.read_picture, files.PICTURE, "is not a readable image"),
                                (files.read_depth, files.DEPTH, "is no array that numpy can read")):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(StageFileError, match=problem):
            read(tmp_path / name)


@pytest.mark.parametrize(("array", "problem"), [
    (np.zeros((4, 5, 3), np.float32), "must be an array"), (np.array([["a"]]), "must be an array"),
    (np.full((4, 5), np.nan), "no valid depth at all"), (np.zeros((4, 5)), "no valid depth at all"),
    (np.array([[{}]], dtype=object), "is no array that numpy can read"),  # never unpickled
])
def test_invalid_depth_is_rejected(tmp_path, array, problem):
    np.save(tmp_path / files.DEPTH, array, allow_pickle=True)
    with pytest.raises(StageFileError, match=problem):
        files.read_depth(tmp_path / files.DEPTH)


def test_image_and_depth_of_different_sizes_are_rejected(tmp_path, images):
    files.write_pictures(tmp_path, *images)
    np.save(tmp_path / files.DEPTH, images[1][::2])
    with pytest.raises(StageFileError, match=r"depth_data.npy: is 1024x384, but camera_image.png is 1024x768"):
        files.read_pictures(tmp_path)


def test_unwritable_folder_is_named(tmp_path, images):
    (tmp_path / "file").write_text("")
    with pytest.raises(StageFileError, match="cannot be written"):
        files.write_pictures(tmp_path / "file", *images)
    with pytest.raises(StageFileError, match="cannot be written"):
        files.write_points(tmp_path / "file" / files.PIXELS, np.zeros((3, 2)))
