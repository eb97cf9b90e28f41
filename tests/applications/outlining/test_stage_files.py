import json

import numpy as np
import pytest

from applications.outlining import stage_files as files
from applications.outlining.stage_files import StageFileError
from tests.applications.outlining.outline_scenes import seen_world


def test_images_round_trip(tmp_path):
    _, picture, depth = seen_world("w2")
    files.write_pictures(tmp_path / "new" / "folder", picture, depth)
    again, metres = files.read_pictures(tmp_path / "new" / "folder")
    np.testing.assert_array_equal(again, picture)
    np.testing.assert_array_equal(metres, depth)
    assert sorted(p.name for p in (tmp_path / "new" / "folder").iterdir()) == [
        "camera_image.png", "depth_camera_image.png", "depth_camera_image_normalized.png", "depth_data.npy"]
    shown = files.read_picture(tmp_path / "new" / "folder" / files.NORMALIZED)[..., 0]
    assert shown[384, 512] == 255 and shown[0, 0] == 0 and 0 < shown[384, 5] < 255


def test_points_round_trip_and_integral_pixels_have_no_decimal_point(tmp_path):
    pixels, points = np.array([[1, 2], [3, 4], [5, 6]]), np.array([[0.1, -0.2, 1.1], [0.123456789, 0, 1], [1, 2, 3]])
    files.write_points(tmp_path / files.PIXELS, pixels)
    files.write_points(tmp_path / files.CLEARED, points)
    np.testing.assert_array_equal(files.read_pixels(tmp_path / files.PIXELS), pixels)
    np.testing.assert_allclose(files.read_coordinates(tmp_path / files.CLEARED), points, atol=1e-9)
    assert "[1, 2]" in (tmp_path / files.PIXELS).read_text()
    assert len(json.loads((tmp_path / files.CLEARED).read_text())) == 3


@pytest.mark.parametrize("text, said", [
    ("", "is not valid JSON"), ("[[1, 2, 3]", "is not valid JSON"), ("{}", r"list of at least 3 points .*, not dict"),
    ("[]", "not 0 entries"),
    ("[[1,2,3],[1,2,3],[1,2]]", r"entry 2 must be \[x, y, z\] of finite numbers, not \[1, 2\]"),
    ("[[1,2,3],[1,2,NaN],[1,2,3]]", "entry 1 "), ('[[1,2,3],[1,2,"3"],[1,2,3]]', "entry 1 "),
    ("[[1,2,3],[1,2,true],[1,2,3]]", "entry 1 "), ("[[1,2,3],7,[1,2,3]]", "entry 1 .*not 7"),
    ("[[1,2,3],[1,2,1e400],[1,2,3]]", "entry 1 "), ("[" * 100_000, "is not valid JSON"),
])
def test_malformed_points_are_rejected_with_the_file_name(tmp_path, text, said):
    path = tmp_path / files.CLEARED
    path.write_text(text)
    with pytest.raises(StageFileError, match=said) as caught:
        files.read_coordinates(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_missing_files_are_named(tmp_path):
    for read, name in ((files.read_pictures, files.PICTURE), (files.read_depth, files.DEPTH),
                       (files.read_pixels, files.PIXELS)):
        path = tmp_path if read is files.read_pictures else tmp_path / name
        with pytest.raises(StageFileError, match=f"{name}: is missing"):
            read(path)


def test_wrong_binary_files_are_rejected(tmp_path):
    picture, depth = tmp_path / files.PICTURE, tmp_path / files.DEPTH
    for content in (b"", b"not a picture"):
        picture.write_bytes(content)
        with pytest.raises(StageFileError, match="is no picture"):
            files.read_picture(picture)
        depth.write_bytes(content)
        with pytest.raises(StageFileError, match="is no array that numpy can read"):
            files.read_depth(depth)
    (tmp_path / files.PIXELS).write_bytes(b"\xff\xfe\x00")
    with pytest.raises(StageFileError, match="is not valid JSON"):
        files.read_pixels(tmp_path / files.PIXELS)


@pytest.mark.parametrize("array, said", [
    (np.zeros((4, 5, 3), np.float32), "must be an array"), (np.array([["a"]]), "must be an array"),
    (np.full((4, 5), np.nan), "no valid depth at all"), (np.zeros((4, 5)), "no valid depth at all"),
])
def test_invalid_depth_is_rejected(tmp_path, array, said):
    np.save(tmp_path / files.DEPTH, array)
    with pytest.raises(StageFileError, match=said):
        files.read_depth(tmp_path / files.DEPTH)


def test_objects_in_an_array_file_are_never_unpickled(tmp_path):
    np.save(tmp_path / files.DEPTH, np.array([[{}]], dtype=object), allow_pickle=True)
    with pytest.raises(StageFileError, match="is no array that numpy can read"):
        files.read_depth(tmp_path / files.DEPTH)


def test_image_and_depth_of_different_sizes_are_rejected(tmp_path):
    _, picture, depth = seen_world("w2")
    files.write_pictures(tmp_path, picture, depth)
    np.save(tmp_path / files.DEPTH, depth[::2])
    with pytest.raises(StageFileError, match=r"depth_data.npy: is 1024x384, but camera_image.png is 1024x768"):
        files.read_pictures(tmp_path)


def test_unwritable_folder_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    _, picture, depth = seen_world("w2")
    with pytest.raises(StageFileError, match="cannot be written"):
        files.write_pictures(tmp_path / "file", picture, depth)
    with pytest.raises(StageFileError, match="cannot be written"):
        files.write_points(tmp_path / "file" / files.PIXELS, np.zeros((3, 2)))
