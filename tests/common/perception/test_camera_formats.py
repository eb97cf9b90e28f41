"""Intrinsics of cameras that ROS or OpenCV calibrated are read, and what they cannot express is named."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from cli.main import app
from common.errors import ConfigError
from common.perception.camera_file import CameraFile

K, D = [533.0, 0, 326.5, 0, 529.0, 234.2, 0, 0, 1], [-0.21, 0.09, 0.0012, -0.0008, 0.0]
ROS = f"""image_width: 640
image_height: 480
camera_name: wrist
camera_matrix: {{rows: 3, cols: 3, data: {K}}}
distortion_model: plumb_bob
distortion_coefficients: {{rows: 1, cols: 5, data: {D}}}
rectification_matrix: {{rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}}
projection_matrix: {{rows: 3, cols: 4, data: [500.0, 0, 325, 0, 0, 510, 233, 0, 0, 0, 1, 0]}}
"""
ECHO = f"""header: {{frame_id: wrist}}
height: 480
width: 640
distortion_model: plumb_bob
d: {D}
k: {K}
p: [500.0, 0, 325, 0, 0, 510, 233, 0, 0, 0, 1, 0]
binning_x: 0
roi: {{x_offset: 0, height: 0, width: 0}}
---
"""


def opencv_file(path: Path, fisheye: int = 0) -> Path:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in (("image_width", 640), ("image_height", 480), ("fisheye_model", fisheye),
                        ("camera_matrix", np.reshape(K, (3, 3))), ("distortion_coefficients", np.array(D)[:, None])):
        storage.write(name, value)
    storage.release()
    return path


@pytest.mark.parametrize("source", [
    ROS, ECHO, ECHO.replace("\nd:", "\nD:").replace("\nk:", "\nK:"), "yml", "xml", "json"])
def test_intrinsics_of_ros_and_opencv_are_read_and_not_overwritten(source, tmp_path, capsys):
    path = tmp_path / "camera.yaml"
    if len(source) < 5:
        path = opencv_file(tmp_path / f"camera.{source}")
    else:
        path.write_text(source)
    wanted = CameraFile(width=640, height=480, fx=533, fy=529, cx=326.5, cy=234.2, d=D)
    assert CameraFile.load(str(path)) == wanted
    before = path.read_bytes()
    command = ["calibrate", "pose", str(tmp_path), "--intrinsics", str(path), "--board-position", "0,0,0"]
    assert app.execute(command) == 2 and path.read_bytes() == before
    assert f"--output: is needed: {path} is of another program" in capsys.readouterr().err
    wanted.save(str(path))
    assert CameraFile.load(str(path)) == wanted


@pytest.mark.parametrize(("text", "reason"), [
    (ROS.replace("plumb_bob", "equidistant"), "distortion_model: 'equidistant' is a fisheye model"),
    (ROS.replace("plumb_bob", "magic"), "'magic' is unknown; choices: plumb_bob, rational_polynomial"),
    (ROS.replace("640", "320"), "centre outside of 320x480: intrinsics of another image size"),
    (ROS.replace("image_width: 640\n", ""), "must be the size of the images"),
    (ROS.replace(str(D), "[0, 0, 0, 0, 0]"), "of raw or of rectified images"),
    (ROS.replace("camera_matrix", "matrix"), "projection_matrix is that of rectified images"),
    (ECHO.replace(str(K), str([0] * 9)), "must be 9 numbers of a calibrated camera"),
    (ECHO.replace("binning_x: 0", "binning_x: 2"), "binning"), (ROS.replace("533.0", "wide"), "must be numbers"),
    (ROS.replace("[533.0, 0", "[533.0, 4"), "is a skew"), (ROS.replace("0.0]", "0.0, 0, 0, 0, 1]"), "at most 8"),
    (ROS + "x: [", "does not parse"), ("%YAML:1.0\n- 1\n", "does not parse"), ("<a><b></a>", "does not parse"),
])
def test_unsupported_intrinsics_are_named(text, reason, tmp_path):
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=reason):
        CameraFile.load(str(path))
    with pytest.raises(ConfigError, match="is a fisheye model"):
        CameraFile.load(str(opencv_file(tmp_path / "fisheye.xml", 1)))
