"""A camera at the hand: views are collected while an arm is brought from pose to pose, and calibrated from."""

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
from tests.cli.conftest import CELL, make_folder
from tests.harness import place_of
from tests.tools.calibration.rendered_boards import BOARD, Lens, facing, render
from tools.calibration.views import HandEyeCollector

LENS = Lens()
ROBOT = RobotModel.load(load_cell("panda").robot)
T_TCP_CAMERA = transform(rpy_to_matrix(0.02, -0.05, 0.1), (0.05, 0.0, -0.1))
HOME = ROBOT.named("home")
T_WORLD_BOARD = ROBOT.fk(HOME) @ T_TCP_CAMERA @ facing(BOARD, 0, 0, 0.45)


def poses(count: int) -> list[np.ndarray]:
    """Joints at which the camera at the hand sees all of the board."""
    rng, found = np.random.default_rng(3), [HOME]
    while len(found) < count:
        q = HOME + rng.uniform(-0.3, 0.3, 7)
        board = invert(ROBOT.fk(q) @ T_TCP_CAMERA) @ T_WORLD_BOARD
        corners = cv2.projectPoints(BOARD.corners, cv2.Rodrigues(board[:3, :3])[0], board[:3, 3], LENS.k,
                                    np.array(LENS.d))[0][:, 0]
        if np.all((corners > 30) & (corners < (610, 450))):
            found.append(q)
    return found


def picture(q: np.ndarray, seed: int = 0) -> np.ndarray:
    return render(BOARD, LENS, invert(ROBOT.fk(q) @ T_TCP_CAMERA) @ T_WORLD_BOARD, seed=seed)


def intrinsics(folder: Path) -> str:
    file = str(folder / "camera.yaml")
    camera = {name: getattr(LENS, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    CameraFile(**camera, d=[*LENS.d]).save(file)
    return file


def rest_at(collector: HandEyeCollector, q: np.ndarray, begin: float) -> None:
    for k in range(60):
        collector.joints(begin + 0.01 * k, q)


def test_pictures_of_a_resting_arm_in_new_poses_count_and_the_folder_can_be_gone_on_with(tmp_path: Path) -> None:
    first, second = poses(2)
    collector = HandEyeCollector(tmp_path / "views", ROBOT, "panda", BOARD)
    assert collector.add_image(1.0, picture(first)) == "no joint state at the time of the image"
    rest_at(collector, first, 1.0)
    assert collector.add_image(1.59, picture(first)) == "" and collector.count == 1
    assert collector.add_image(1.59, picture(first)) == "the gripper was in this pose before"
    rest_at(collector, second, 1.6)
    assert collector.add_image(1.8, picture(second)) == "the arm moves"
    assert collector.add_image(2.19, np.full((480, 640, 3), 90, np.uint8)) == "no marker is visible"
    assert collector.add_image(2.19, picture(second)) == "" and "rotate the gripper further" in collector.hint
    again = HandEyeCollector(tmp_path / "views", ROBOT, "panda", BOARD)
    assert again.count == 2
    kept = yaml.safe_load((tmp_path / "views" / "joints.yaml").read_text())
    assert kept["robot"] == "panda" and np.allclose(kept["pictures"]["view_001.png"], second, atol=1e-8)


def test_camera_on_the_hand_is_found_from_a_folder_and_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str],
) -> None:
    collector = HandEyeCollector(tmp_path / "views", ROBOT, "panda", BOARD)
    for n, q in enumerate(poses(10)):
        rest_at(collector, q, float(n))
        assert collector.add_image(n + 0.59, picture(q, n)) == ""
    file = intrinsics(tmp_path)
    asked = ["calibrate", "hand-eye", str(tmp_path / "views"), "--intrinsics", file]
    code, (told, problem) = app.execute([*asked, "--camera", "hand"]), capsys.readouterr()
    assert (code, problem) == (0, "")
    assert "10 views, residual 0.0" in told and told.splitlines()[-1].startswith("good: accurate to about")
    found = yaml.safe_load(Path(file).read_text())
    assert found["mount"] == "tcp" and f"a cell takes both with --set world.camera={file}" in told
    on_hand = f"world.camera={file}"
    assert load_cell("panda", [on_hand]).world.camera.mount == "tcp"
    CameraFile.load(file).model_copy(update={"mount": None}).save(str(tmp_path / "fixed.yaml"))
    assert load_cell("panda", [on_hand, f"world.camera={tmp_path / 'fixed.yaml'}"]).world.camera.mount == ""
    assert np.allclose(found["position"], T_TCP_CAMERA[:3, 3], atol=5e-4)
    assert np.allclose(rpy_to_matrix(*found["rpy"]), T_TCP_CAMERA[:3, :3], atol=1e-3)
    for more, wanted in (
        (["--camera", "foot"], "unknown --camera 'foot'; choices: beside, hand"),
        (["--camera", "beside"], "the views are inconsistent"),
    ):
        assert app.execute([*asked, *more]) != 0
        assert wanted in capsys.readouterr().err
    (tmp_path / "views" / "view_004.png").unlink()
    assert app.execute([*asked, "--camera", "hand"]) == 2
    assert "view_004.png' is not an image in that folder" in capsys.readouterr().err


ARM = '''"""An arm that somebody brings from pose to pose, and its camera."""
import asyncio, glob
import cv2, yaml
from common import topics
from common.config import Parameters
from common.messages import Image, JointState
from common.perception.image import array_to_image
from common.process.service import main

class Config(Parameters):
    """Nothing."""

async def run(bus, config):
    joints, images = bus.writer(topics.JOINT_STATES), bus.writer(topics.CAMERA_IMAGE)
    shots = yaml.safe_load(open("{folder}/shots.yaml"))
    bus.client(topics.MOTION_STOP)
    bus.reader(topics.GRIPPER_STATE)
    await bus.ready()
    while True:
        for name, q in shots["poses"].items():
            for _ in range(30):
                joints.put(JointState(header=bus.header(), name=shots["names"], position=q, velocity=[0.0] * 7,
                                      effort=[]))
                await asyncio.sleep(0.02)
            images.put(array_to_image(cv2.imread("{folder}/" + name), "bgr8", bus.header("camera")))

if __name__ == "__main__":
    main(run, Config)
'''


def test_views_are_collected_from_a_cell_that_is_up(tmp_path: Path) -> None:
    folder = make_folder(tmp_path)
    shots = {}
    for n, q in enumerate(poses(3)):
        cv2.imwrite(str(folder / f"s{n}.png"), picture(q, n))
        shots[f"s{n}.png"] = q.tolist()
    (folder / "shots.yaml").write_text(yaml.safe_dump({"names": ROBOT.joint_names, "poses": shots}))
    (folder / "fakes" / "arm.py").write_text(ARM.replace("{folder}", str(folder)))
    (folder / "arm.yaml").write_text(CELL.replace("fakes.first", "fakes.arm").replace("cell: tiny", "cell: arm"))
    with place_of(folder, "arm.yaml") as place:
        told = place.say("calibrate", "collect", "views", "--robot", "panda", "--views", "3")
        assert [line for line in told if line.startswith("view ")][-1].startswith("view 3 of 3; ")
        assert told[-1].startswith("views holds 3 views; next: zencell calibrate hand-eye views")
        done = place.ask("calibrate", "collect", "more", "--robot", "panda", "--key", "camera/nothing")
        assert done.returncode == 1 and "no image received for 5 s" in done.stderr
    assert len(yaml.safe_load((folder / "views" / "joints.yaml").read_text())["pictures"]) == 3
