"""A camera at the hand: collect views while an arm is moved from pose to pose, and calibrate from them."""

from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from cli.main import app
from common.config import load_cell
from common.perception.camera_file import CameraFile
from common.robot.model import RobotModel
from common.robot.transforms import invert, rpy_to_matrix, transform
from tests.cli.conftest import make_folder
from tests.harness import place_of
from tests.tools.calibration.rendered_boards import BOARD, Lens, facing, render
from tools.calibration.views import HandEyeCollector

LENS = Lens()
ROBOT = RobotModel.load(load_cell("panda").robot)
T_TCP_CAMERA = transform(rpy_to_matrix(0.02, -0.05, 0.1), (0.05, 0.0, -0.1))
HOME = ROBOT.named("home")
T_WORLD_BOARD = ROBOT.fk(HOME) @ T_TCP_CAMERA @ facing(BOARD, 0, 0, 0.45)


def poses(count: int) -> list[np.ndarray]:
    """Return joint positions from which the camera at the hand sees the complete board."""
    rng, found = np.random.default_rng(3), [HOME]
    while len(found) < count:
        q = HOME + rng.uniform(-0.3, 0.3, 7)
        board = invert(ROBOT.fk(q) @ T_TCP_CAMERA) @ T_WORLD_BOARD
        corners = LENS.project(board, BOARD.corners)
        if np.all((corners > 30) & (corners < (610, 450))):
            found.append(q)
    return found


POSES = poses(8)


@cache
def image(number: int) -> np.ndarray:
    """Return the image from a pose."""
    return render(BOARD, LENS, invert(ROBOT.fk(POSES[number]) @ T_TCP_CAMERA) @ T_WORLD_BOARD, seed=number)


def rest_at(collector: HandEyeCollector, q: np.ndarray, start: float) -> None:
    for k in range(60):
        collector.joints(start + 0.01 * k, q)


def test_images_of_a_resting_arm_in_new_poses_are_collected_and_continued(tmp_path):
    collector = HandEyeCollector(tmp_path / "views", ROBOT, "panda", BOARD)
    assert collector.add_image(1.0, image(0)) == "no joint state at the time of the image"
    rest_at(collector, POSES[0], 1.0)
    assert collector.add_image(1.59, image(0)) == "" and collector.count == 1
    assert collector.add_image(1.59, image(0)) == "the gripper was in this pose before"
    rest_at(collector, POSES[1], 1.6)
    assert collector.add_image(1.8, image(1)) == "the arm moves"
    assert collector.add_image(2.19, np.full((480, 640, 3), 90, np.uint8)) == "no marker is visible"
    assert collector.add_image(2.19, image(1)) == "" and "rotate the gripper further" in collector.hint
    again = HandEyeCollector(tmp_path / "views", ROBOT, "panda", BOARD)
    assert again.count == 2
    saved = yaml.safe_load((tmp_path / "views" / "joints.yaml").read_text())
    assert saved["robot"] == "panda" and np.allclose(saved["pictures"]["view_001.png"], POSES[1], atol=1e-8)


@pytest.mark.slow
def test_camera_at_the_hand_is_calibrated_from_a_folder(tmp_path, capsys, rejection):
    collector = HandEyeCollector(tmp_path / "views", ROBOT, "panda", BOARD)
    for n, q in enumerate(POSES):
        rest_at(collector, q, float(n))
        assert collector.add_image(n + 0.59, image(n)) == ""
    file, fixed = str(tmp_path / "camera.yaml"), str(tmp_path / "fixed.yaml")
    LENS.camera().save(file)
    command = ["calibrate", "hand-eye", str(tmp_path / "views"), "--intrinsics", file]
    code, (output, error) = app.execute([*command, "--camera", "hand"]), capsys.readouterr()
    assert (code, error) == (0, "")
    assert "8 views, residual 0.0" in output and output.splitlines()[-1].startswith("good: accurate to about")
    found = yaml.safe_load(Path(file).read_text())
    assert found["mount"] == "tcp" and f"a cell takes both with --set world.camera={file}" in output
    assert np.allclose(found["position"], T_TCP_CAMERA[:3, 3], atol=5e-4)
    assert np.allclose(rpy_to_matrix(*found["rpy"]), T_TCP_CAMERA[:3, :3], atol=1e-3)
    assert load_cell("panda", [f"world.camera={file}"]).world.camera.mount == "tcp"
    CameraFile.load(file).model_copy(update={"mount": None}).save(fixed)
    assert load_cell("panda", [f"world.camera={file}", f"world.camera={fixed}"]).world.camera.mount == ""
    assert "unknown --camera 'foot'; choices: beside, hand" in rejection(*command, "--camera", "foot")
    assert "the views are inconsistent" in rejection(*command, "--camera", "beside", code=1)
    (tmp_path / "views" / "view_004.png").unlink()
    capsys.readouterr()
    assert app.execute([*command, "--camera", "hand"]) == 0
    output, error = capsys.readouterr()
    assert "7 views, residual 0.0" in output and "view_004.png' is not a file" in error and error.count("\n") == 1
    joints = tmp_path / "views" / "joints.yaml"
    values = yaml.safe_load(joints.read_text())
    degrees = {name: np.degrees(q).tolist() for name, q in values["pictures"].items() if name != "view_004.png"}
    joints.write_text(yaml.safe_dump({**values, "pictures": degrees}))
    line = rejection(*command, "--camera", "hand", code=1)
    assert "the joints are in degrees: converted to rad, the residual is 0.0" in line


@pytest.mark.slow
def test_views_are_collected_from_a_running_cell(tmp_path, monkeypatch):
    shots = {f"s{n}.png": POSES[n].tolist() for n in range(3)}
    for n, name in enumerate(shots):
        cv2.imwrite(str(tmp_path / name), image(n))
    (tmp_path / "shots.yaml").write_text(yaml.safe_dump({"names": ROBOT.joint_names, "poses": shots}))
    with place_of(make_folder(tmp_path, "arm", "arm"), "arm.yaml") as place:
        lines = place.say("calibrate", "collect", "views", "--robot", "panda", "--views", "3")
        assert [line for line in lines if line.startswith("view ")][-1].startswith("view 3 of 3; ")
        assert lines[-1].startswith("views holds 3 views; next: zencell calibrate hand-eye views")
        monkeypatch.setattr("tools.calibration.views.IMAGE_TIMEOUT", 0.3)
        done = place.ask("calibrate", "collect", "more", "--robot", "panda", "--key", "camera/nothing")
        assert done.returncode == 1 and "no image received for 0.3 s" in done.stderr
    assert len(yaml.safe_load((tmp_path / "views" / "joints.yaml").read_text())["pictures"]) == 3
