"""A hand-eye calibration as the page guides it: it says what is missing, keeps views, and finds the camera."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from common.config import load_cell
from common.errors import ConfigError
from common.messages import CameraInfo, Header, Image, JointState
from common.perception.camera_file import CameraFile
from common.perception.image import array_to_image
from common.planning.ik import solve_ik
from common.robot.transforms import invert, rpy_to_matrix, transform
from page.hand_eye import HandEye, folder_of
from tests.tools.calibration.rendered_boards import BOARD, render
from tests.tools.calibration.test_hand_eye import LENS, ROBOT, TRUTH, hands, off
from tools.calibration.board import Board
from tools.calibration.intrinsics import CalibrationFailed

CONFIG = load_cell("panda").robot
INFO = CameraInfo(header=Header(stamp=1, frame_id="eye"), width=LENS.width, height=LENS.height, d=list(LENS.d),
                  k=[LENS.fx, 0, LENS.cx, 0, LENS.fy, LENS.cy, 0, 0, 1])


@pytest.fixture(autouse=True)
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ZENCELL_STATE", str(tmp_path))


class Arm:
    """Rests in one pose after the other, and is seen there."""

    def __init__(self, views: HandEye) -> None:
        self.views, self.now = views, 10.0

    def rest(self, q: np.ndarray) -> Image:
        """The picture after half a second of rest."""
        A, B = TRUTH["hand"]
        for _ in range(12):
            self.now += 0.05
            self.views.joints(JointState(header=Header(stamp=round(self.now * 1e9)), name=ROBOT.joint_names,
                                         position=q.tolist()))
        picture = render(BOARD, LENS, invert(A) @ invert(ROBOT.fk(q)) @ B, seed=round(self.now))
        image = array_to_image(picture, "bgr8")
        image.header.stamp = round(self.now * 1e9)
        return image


def poses(count: int) -> list[np.ndarray]:
    found = [solve_ik(ROBOT, T, ROBOT.named("home"), restarts=30) for T in hands("hand", 2 * count)]
    return [q for q in found if q is not None][:count]


def test_camera_is_found_from_views_that_the_page_kept() -> None:
    views = HandEye("wrist", CONFIG, BOARD, "hand")
    arm, said = Arm(views), []
    assert views.missing == "15 more views: tilt the gripper in another direction"
    for q in poses(9):
        said.append(views.take(arm.rest(q)))
    assert said.count("") == views.count >= 7, said
    assert f"{15 - views.count} more views: rotate the gripper further about its" in views.missing
    assert all(turn > 10 for turn in views.turned.values())
    result = views.calibrate(INFO)
    camera = CameraFile.load(str(views.folder / "camera.yaml"))
    assert camera.mount == "tcp" and camera.position is not None and camera.rpy is not None
    away, turned = off(transform(rpy_to_matrix(*camera.rpy), camera.position), TRUTH["hand"][0])
    assert away < 0.002 and turned < 0.005
    assert result.lines[0].startswith(("good", "fair")) and len(result.residuals) + len(result.dropped) == views.count
    assert str(views.folder / "camera.yaml") in result.lines[-1]


def test_picture_that_is_no_view_says_why_and_views_are_there_the_next_time() -> None:
    views = HandEye("wrist", CONFIG, BOARD, "hand")
    arm, q = Arm(views), poses(1)[0]
    image = arm.rest(q)
    assert views.take(image) == "" and views.take(image) == "the gripper was in this pose before"
    long_ago = image.model_copy(update={"header": Header(stamp=1)})
    assert views.take(long_ago) == "no joint state at the time of the image"
    with pytest.raises(CalibrationFailed, match="views of the board"):
        views.calibrate(INFO)
    assert HandEye("wrist", CONFIG, BOARD, "hand").count == 1


@pytest.mark.parametrize("name", ["", "../up", "a b", "x" * 41])
def test_views_are_kept_nowhere_else(name: str) -> None:
    with pytest.raises(ConfigError, match="must be letters"):
        folder_of(name)


def resting() -> Arm:
    arm = Arm(HandEye("wrist", CONFIG, BOARD, "hand"))
    arm.rest(ROBOT.named("home"))
    return arm


@pytest.mark.parametrize(("encoding", "kind", "why"), [
    ("mono8", np.uint8, "no marker is visible"), ("32FC1", np.float32, "'32FC1' is no color image"),
    ("16UC1", np.uint16, "'16UC1' is no color image"), ("bgr8", None, "too few for 64x48")])
def test_picture_of_another_kind_is_no_view_and_says_why(encoding: str, kind: type | None, why: str) -> None:
    arm = resting()
    image = (array_to_image(np.zeros((48, 64), kind), encoding) if kind
             else Image(header=Header(), width=64, height=48, encoding=encoding, data=b"few"))
    image.header.stamp = round(arm.now * 1e9)
    assert why in arm.views.take(image)


@pytest.mark.parametrize("q", [[], [0.0] * 3, [0.0] * 9])
def test_views_with_other_numbers_of_joints_are_refused_by_their_name(q: list[float]) -> None:
    file = HandEye("wrist", CONFIG, BOARD, "hand").folder / "joints.yaml"
    file.write_text(yaml.safe_dump({"robot": "panda", "joints": ROBOT.joint_names, "pictures": {"view_000.png": q}}))
    with pytest.raises(ConfigError, match=r"joints.yaml: view_000.png.* must be 7 joints"):
        HandEye("wrist", CONFIG, BOARD, "hand")


@pytest.mark.parametrize(("robot", "fits"), [("panda", True), ("robots/panda.yaml", True), ("panda_long", False)])
def test_views_of_another_robot_with_joints_of_the_same_names_are_refused(robot: str, fits: bool) -> None:
    file = HandEye("wrist", CONFIG, BOARD, "hand").folder / "joints.yaml"
    file.write_text(yaml.safe_dump({"robot": robot, "joints": ROBOT.joint_names}))
    if fits:
        assert HandEye("wrist", CONFIG, BOARD, "hand").count == 0
        return
    with pytest.raises(ConfigError, match="contains views of another robot: panda_long"):
        HandEye("wrist", CONFIG, BOARD, "hand")


def test_view_that_somebody_left_out_has_no_other_written_over(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Board, "find", lambda *_: SimpleNamespace(blur=0.5))
    views = HandEye("wrist", CONFIG, BOARD, "hand")
    arm, home = Arm(views), ROBOT.named("home")
    turned = [home + 0.3 * np.eye(7)[joint] for joint in range(4)]
    for q in turned[:3]:
        assert views.take(arm.rest(q)) == ""
    file = views.folder / "joints.yaml"
    said = yaml.safe_load(file.read_text())
    del said["pictures"]["view_001.png"]
    file.write_text(yaml.safe_dump(said))
    arm.views = HandEye("wrist", CONFIG, BOARD, "hand")
    assert arm.views.take(arm.rest(turned[3])) == "" and arm.views.count == 3
    pictures = yaml.safe_load(file.read_text())["pictures"]
    assert [pictures[name] for name in said["pictures"]] == [*said["pictures"].values()] and len(pictures) == 3


def test_view_that_cannot_be_kept_is_told_and_not_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Board, "find", lambda *_: SimpleNamespace(blur=0.5))
    arm = resting()
    (arm.views.folder / ".joints.yaml.part").mkdir()  # as a full disk would have it
    with pytest.raises(ConfigError, match="cannot be written"):
        arm.views.take(arm.rest(ROBOT.named("home")))
    assert arm.views.count == 0
