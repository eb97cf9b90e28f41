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
    FULL.save(str(tmp_path / "camera.yaml"))
    return tmp_path / "camera.yaml"


def test_saved_camera_file_loads_equal_and_a_cell_uses_it(path):
    assert CameraFile.load(str(path)) == FULL and "world.camera=camera.yaml" in path.read_text()
    camera = load_cell("panda", [f"world.camera={path}"]).world.camera
    assert (camera.width, camera.fx, camera.position, camera.rpy) == (800, 701.5, FULL.position, FULL.rpy)
    assert camera.d == FULL.d and camera.frame == "camera_optical_frame"
    assert CameraFile.of(camera).matrix.tolist() == FULL.matrix.tolist()


def test_later_override_and_world_frame_take_precedence(path):
    camera = load_cell("ur5", [f"world.camera={path}", "world.camera.fx=650"]).world.camera
    assert camera.fx == 650 and camera.fy == 702.25 and camera.frame == "depth_camera_optical_frame"


def test_world_file_may_reference_a_camera_file_relative_to_it(path, tmp_path):
    world, cell = tmp_path / "mine.yaml", tmp_path / "cell.yaml"
    world.write_text("camera: camera.yaml\ncount: 0\n")
    cell.write_text("robot: panda\npipeline: lerp\ntask: x\nservices: {}\nworld: {camera: camera.yaml, count: 0}\n")
    for loaded in (load_cell("panda", world=str(world)), load_cell(str(cell))):
        assert loaded.world.camera.position == FULL.position


@pytest.mark.parametrize(("change", "text"), [
    ({"position": None}, "has no position: `zencell calibrate pose` writes it"),
    ({"fx": None}, "has no fx: `zencell calibrate intrinsics` writes it"),
    ({"fx": -3.0}, "world.camera.fx: -3.0"),
    ({"skew": 1.0}, "skew"),
])
def test_unusable_camera_file_is_a_one_line_error(path, change, text):
    values = yaml.safe_load(path.read_text()) | change
    path.write_text(yaml.safe_dump({key: value for key, value in values.items() if value is not None}))
    with pytest.raises(ConfigError) as caught:
        load_cell("panda", [f"world.camera={path}"])
    assert text in str(caught.value) and "\n" not in str(caught.value)


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
    np.testing.assert_allclose(FULL.undistorted(seen), (ray @ FULL.matrix.T)[:, :2], atol=1e-6)
