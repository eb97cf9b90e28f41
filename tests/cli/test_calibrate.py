"""`zencell calibrate`: intrinsics and pose of a camera from images of a board."""

import re
import shutil
from contextlib import chdir, redirect_stdout
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from cli.main import app
from common.robot.transforms import invert, rpy_to_matrix, transform
from tests.tools.calibration.rendered_boards import BOARD, Lens, many_poses, render

LENS = Lens()
T_WORLD_CAMERA = transform(rpy_to_matrix(np.pi - 0.06, 0.04, -np.pi / 2 + 0.1), (0.42, -0.01, 0.80))
PLACES = {"a": (0.35, -0.15, 0.1), "b": (0.3, 0.15, 1.7)}  # x, y, yaw


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Folders of images: views of the board, the board at two places on the table, the table without it."""
    root = tmp_path_factory.mktemp("images")
    views = [render(BOARD, LENS, T, seed=k) for k, T in enumerate(many_poses(BOARD, 8))]
    images = {"views": views, "few": views[:3], "empty": [np.full((480, 640, 3), 100, np.uint8)] * 2}
    for name, (x, y, yaw) in PLACES.items():
        T = invert(T_WORLD_CAMERA) @ transform(rpy_to_matrix(0, 0, yaw), (x, y, 0))
        images[name] = [render(BOARD, LENS, T, seed=k) for k in range(2)]
    for name, listed in images.items():
        (root / name).mkdir()
        for k, image in enumerate(listed):
            cv2.imwrite(str(root / name / f"p{k}.png"), image)
    (root / "broken").mkdir()
    (root / "broken" / "p0.png").write_bytes(b"no image")
    return root


@pytest.fixture(scope="module")
def calibrated(folder):
    """The file of the camera after both commands, whose output is in output.txt."""
    path = folder / "camera.yaml"
    with chdir(folder), (folder / "output.txt").open("w") as output, redirect_stdout(output):
        assert app.execute(["calibrate", "intrinsics", "views", "-o", str(path)]) == 0
        places = [word for x, y, _ in PLACES.values() for word in ("--board-position", f"{x},{y},0")]
        turns = [word for _, _, yaw in PLACES.values() for word in ("--board-rpy", f"0,0,{yaw}")]
        assert app.execute(["calibrate", "pose", *PLACES, "--intrinsics", str(path), *places, *turns]) == 0
    return path


def test_calibrated_camera_is_written_to_the_file_of_a_cell(calibrated):
    found = yaml.safe_load(calibrated.read_text())
    assert (found["width"], found["height"]) == (640, 480)
    np.testing.assert_allclose([found[n] for n in ("fx", "fy", "cx", "cy")], (LENS.fx, LENS.fy, LENS.cx, LENS.cy),
                               rtol=2e-3)
    np.testing.assert_allclose(found["position"], T_WORLD_CAMERA[:3, 3], atol=0.5e-3)
    np.testing.assert_allclose(rpy_to_matrix(*found["rpy"]), T_WORLD_CAMERA[:3, :3], atol=1e-3)
    intrinsics, pose = found["calibration"]["intrinsics"], found["calibration"]["pose"]
    assert (intrinsics["source"], intrinsics["views"], intrinsics["distortion_model"]) == ("views", 8, "plumb_bob")
    assert 0 < intrinsics["rms_px"] < 0.3 and 0 < intrinsics["std_px"]["fx"] < 1
    assert 0 < pose["rms_px"] < 0.3 and 0 < pose["rms_mm"] < 0.3 and pose["pictures"] == 4
    assert [place["source"] for place in pose["places"]] == ["a", "b"]
    assert all(re.fullmatch(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d", part["date"]) for part in (intrinsics, pose))


def test_output_has_residuals_uncertainty_and_the_next_command(calibrated):
    output = (calibrated.parent / "output.txt").read_text()
    for line in (r"8 views, \d+ corners, \d+ % of the image covered$",
                 r"residual 0\.\d+ px rms; p0\.png 0\.\d+, p1\.png", r"fx\s+53\d\.\d\d \+- 0\.\d\d px$",
                 r"4 images, residual 0\.\d+ px rms, 0\.\d+ mm on the board",
                 r"position 0\.4\d+, -0\.0\d+, 0\.\d+ m \+- 0\.\d+ mm$"):
        assert re.search(f"^{line}", output, re.MULTILINE), line
    assert "calibrate pose" in output and f"--set world.camera={calibrated}" in output


def test_files_that_are_no_images_are_skipped_and_deep_ones_stretched(folder, tmp_path, capsys):
    views = shutil.copytree(folder / "views", tmp_path / "views")
    for name, content in (("._p1.png", b"\0\5"), (".hidden.png", b""), ("Thumbs.db", b"x"), ("empty.png", b""),
                          ("cut.png", (views / "p1.png").read_bytes()[:5000]), ("text.jpg", b"hello")):
        (views / name).write_bytes(content)
    (views / "folder.png").mkdir()
    cv2.imwrite(str(views / "small.png"), cv2.resize(cv2.imread(str(views / "p1.png")), (800, 600)))
    for k in (0, 3):  # 12 bits in 16
        cv2.imwrite(str(views / f"p{k}.png"), cv2.imread(str(views / f"p{k}.png"), 0).astype(np.uint16) * 16)
    output = tmp_path / "camera.yaml"
    assert app.execute(["calibrate", "intrinsics", str(views), "-o", str(output)]) == 0
    assert yaml.safe_load(output.read_text())["fx"] == pytest.approx(LENS.fx, rel=2e-3)
    lines = capsys.readouterr().err.splitlines()
    skipped = [Path(line.split("'")[1]).name for line in lines if line.startswith("skipped: ")]
    assert sorted(skipped) == ["cut.png", "empty.png", "folder.png", "text.jpg"]
    assert [line for line in lines if not line.startswith("skipped")] == [
        "p0.png has 12 bits per value, which are stretched to 8", "left out of 9 images: 1 have another size"]


@pytest.mark.slow
def test_new_intrinsics_remove_the_pose(calibrated, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(calibrated.parent)
    path = shutil.copy(calibrated, tmp_path / "camera.yaml")
    assert app.execute(["calibrate", "intrinsics", "views", "-o", str(path)]) == 0
    assert "had a pose, which is removed because it belongs to other intrinsics" in capsys.readouterr().out
    assert "position" not in yaml.safe_load(Path(path).read_text())


@pytest.mark.slow
def test_video_replaces_images(folder, tmp_path):
    path = str(tmp_path / "views.avi")
    writer = cv2.VideoWriter(path, cv2.VideoWriter.fourcc(*"FFV1"), 10, (640, 480))
    if not writer.isOpened():
        pytest.skip("this OpenCV cannot write a video")
    for k in range(8):
        writer.write(cv2.imread(str(folder / "views" / f"p{k}.png")))
    writer.release()
    output = tmp_path / "camera.yaml"
    assert app.execute(["calibrate", "intrinsics", path, "-o", str(output)]) == 0
    assert yaml.safe_load(output.read_text())["fx"] == pytest.approx(LENS.fx, rel=2e-3)


@pytest.mark.slow
def test_board_is_written_with_its_true_size(tmp_path, capsys):
    png, pdf = tmp_path / "board.png", tmp_path / "board.pdf"
    for path in (png, pdf):
        assert app.execute(["calibrate", "board", "-o", str(path)]) == 0
    assert "7 x 5 squares of 36 mm, markers of 27 mm, 4x4_50; 276.0 x 204.0 mm" in capsys.readouterr().out
    data = png.read_bytes()
    at = data.index(b"pHYs") + 4
    density = int.from_bytes(data[at : at + 4], "big")  # [px/m]
    height, width = cv2.imread(str(png)).shape[:2]
    assert (width / density, height / density) == (pytest.approx(0.276, abs=1e-4), pytest.approx(0.204, abs=1e-4))
    box = re.search(rb"/MediaBox \[ ?0 0 ([\d.]+) ([\d.]+)", pdf.read_bytes())
    points = [float(value) for value in box.groups()]  # of 1/72 inch
    assert points == pytest.approx([276 / 25.4 * 72, 204 / 25.4 * 72], abs=0.3)


@pytest.mark.parametrize(("command", "code", "wanted"), [
    ("intrinsics few", 1, ["3 of 3 images are usable", "8 are needed, 5 more"]),
    ("intrinsics nowhere", 2, ["nowhere", "is not a device number"]),
    ("intrinsics broken", 2, ["p0.png", "is not a readable image"]),
    ("intrinsics /dev/zencell-none", 2, ["/dev/zencell-none", "cannot be opened"]),
    ("intrinsics views -o no/where.yaml", 2, ["--output", "no/where.yaml", "cannot be written"]),
    ("intrinsics views --views x", 2, ["--views", "'x'", "3 or more"]),
    ("intrinsics views --size big", 2, ["--size", "'big'", "as 640x480"]),
    ("intrinsics views --square 0", 2, ["square", "0"]),
    ("intrinsics views --dictionary 4x4_5", 2, ["unknown dictionary '4x4_5'", "4x4_50"]),
    ("intrinsics views --k-coefficients 7", 2, ["k_coefficients", "7", "6"]),
    ("board -o board.jpg", 2, ["board.jpg", ".png or .pdf"]),
    ("pose a --intrinsics none.yaml --board-position 0,0,0", 2, ["none.yaml", "cannot be read"]),
    ("pose a --intrinsics FILE --board-position 0,0", 2, ["--board-position", "'0,0'", "three"]),
    ("pose a b --intrinsics FILE --board-position 0,0,0", 2, ["1 times for 2 sources"]),
    ("pose empty --intrinsics FILE --board-position 0,0,0", 1, ["none of 2", "no marker"]),
    ("pose few --intrinsics FILE --board-position 0,0,0", 1, ["are inconsistent"]),
])
def test_rejected_calibration_is_one_line(command, code, wanted, calibrated, monkeypatch, rejection, tmp_path):
    monkeypatch.chdir(calibrated.parent)
    output = "" if "-o" in command else f" -o {tmp_path / 'out.yaml'}"
    line = rejection("calibrate", *(command.replace("FILE", str(calibrated)) + output).split(), code=code)
    assert all(part in line for part in wanted), line
