"""A hand-eye calibration as the page guides it: it says what is missing, keeps views, and finds the camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from common.config import load_cell
from common.errors import ConfigError
from common.messages import CameraInfo, Header, Image, JointState
from common.perception.calibration import CalibrationFailed
from common.perception.calibration_file import CameraFile
from common.perception.image import array_to_image
from common.planning.ik import solve_ik
from common.robot.transforms import invert, rpy_to_matrix, transform
from common.viewer.hand_eye import HandEye, folder_of
from tests.common.perception.rendered_boards import BOARD, render
from tests.common.perception.test_calibration_hand_eye import LENS, ROBOT, TRUTH, hands, off

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
    assert views.missing == "15 more views: tilt the hand to another side"
    for q in poses(9):
        said.append(views.take(arm.rest(q)))
    assert said.count("") == views.count >= 7, said
    assert f"{15 - views.count} more views: turn the hand further about its" in views.missing
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
    assert views.take(image) == "" and views.take(image) == "the hand was in this pose before"
    long_ago = image.model_copy(update={"header": Header(stamp=1)})
    assert views.take(long_ago) == "nobody says where the joints were"
    with pytest.raises(CalibrationFailed, match="views of the board"):
        views.calibrate(INFO)
    assert HandEye("wrist", CONFIG, BOARD, "hand").count == 1


@pytest.mark.parametrize("name", ["", "../up", "a b", "x" * 41])
def test_views_are_kept_nowhere_else(name: str) -> None:
    with pytest.raises(ConfigError, match="must be letters"):
        folder_of(name)
