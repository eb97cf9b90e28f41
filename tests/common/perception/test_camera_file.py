from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from common.config import load_cell
from common.errors import ConfigError
from common.perception.camera_file import CameraFile

FULL = CameraFile(width=800, height=600, fx=701.5, fy=702.25, cx=399.0, cy=301.0, d=[-0.1, 0.02, 0.001, -0.002],
                  position=(0.41, 0.02, 0.83), rpy=(3.1, 0.01, -1.5), calibration={"pose": {"rms_px": 0.04}})


@pytest.fixture
def path(tmp_path):
    file = str(tmp_path / "camera.yaml")
    FULL.save(file)
    return file


def test_saved_camera_file_loads_equal(path):
    assert CameraFile.load(path) == FULL
    assert "world.camera=camera.yaml" in Path(path).read_text()


def test_cell_reads_intrinsics_and_pose_from_the_file(path):
    camera = load_cell("panda", [f"world.camera={path}"]).world.camera
    assert (camera.width, camera.fx, camera.position, camera.rpy) == (800, 701.5, FULL.position, FULL.rpy)
    assert camera.d == FULL.d and camera.frame == "camera_optical_frame"
    assert CameraFile.of(camera).matrix.tolist() == FULL.matrix.tolist()


def test_later_override_and_world_frame_take_precedence(path):
    camera = load_cell("ur5", [f"world.camera={path}", "world.camera.fx=650"]).world.camera
    assert camera.fx == 650 and camera.fy == 702.25 and camera.frame == "depth_camera_optical_frame"


def test_world_file_may_reference_a_camera_file_relative_to_it(path, tmp_path):
    world = tmp_path / "mine.yaml"
    world.write_text("camera: camera.yaml\ncount: 0\n")
    assert load_cell("panda", world=str(world)).world.camera.position == FULL.position
    cell = tmp_path / "cell.yaml"
    cell.write_text("robot: panda\npipeline: lerp\ntask: x\nservices: {}\nworld: {camera: camera.yaml, count: 0}\n")
    assert load_cell(str(cell)).world.camera.position == FULL.position


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"position": None}, "has no position: `zencell calibrate pose` writes it"),
        ({"fx": None}, "has no fx: `zencell calibrate intrinsics` writes it"),
        ({"fx": -3.0}, "world.camera.fx: -3.0"),
        ({"skew": 1.0}, "skew"),
    ],
)
def test_unusable_camera_file_is_a_one_line_error(path, change, told):
    values = yaml.safe_load(Path(path).read_text()) | change
    Path(path).write_text(yaml.safe_dump({key: value for key, value in values.items() if value is not None}))
    with pytest.raises(ConfigError) as caught:
        load_cell("panda", [f"world.camera={path}"])
    assert told in str(caught.value) and "\n" not in str(caught.value)


def test_missing_or_unwritable_camera_file_is_a_one_line_error(tmp_path):
    with pytest.raises(ConfigError, match="cannot be read"):
        load_cell("panda", [f"world.camera={tmp_path / 'none.yaml'}"])
    with pytest.raises(ConfigError, match="cannot be written"):
        FULL.save(str(tmp_path / "no" / "camera.yaml"))


@pytest.mark.parametrize(("d", "length", "model"), [
    ([], 4, "plumb_bob"), ([0.1, 0.2, 0, 0, 0.3], 5, "plumb_bob"), ([0.1] * 8, 8, "rational_polynomial"),
])
def test_distortion_is_padded_and_its_model_named(d, length, model):
    camera = FULL.model_copy(update={"d": d})
    assert len(camera.distortion) == length and camera.distortion_model == model


def test_undistorted_pixels_match_a_pinhole():
    ray = np.array([[0.2, -0.1, 1.0], [-0.3, 0.25, 1.0]])
    seen = cv2.projectPoints(ray, np.zeros(3), np.zeros(3), FULL.matrix, FULL.distortion)[0][:, 0]
    ideal = ray @ FULL.matrix.T
    np.testing.assert_allclose(FULL.undistorted(seen), ideal[:, :2], atol=1e-6)
