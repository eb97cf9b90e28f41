"""Guided hand-eye calibration: missing views are named, views are saved, and the camera pose is found."""

import asyncio
from dataclasses import replace
from threading import Event
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import viser
import yaml

from common import topics
from common.config import load_cell
from common.errors import ConfigError
from common.messages import CameraInfo, Header, Image, JointState
from common.perception.camera_file import CameraFile
from common.perception.image import array_to_image
from common.planning.ik import solve_ik
from common.robot.transforms import invert, rpy_to_matrix, transform
from page.console import ActionQueue
from page.hand_eye import HandEyePanel, HandEyeSession, Result, views_folder
from tests.tools.calibration.rendered_boards import BOARD, render
from tests.tools.calibration.test_hand_eye import LENS, ROBOT, TRUTH, hands, off
from tools.calibration.board import Board
from tools.calibration.intrinsics import CalibrationFailed

CONFIG = load_cell("panda").robot
HOME = ROBOT.named("home")
INFO = CameraInfo(header=Header(stamp=1, frame_id="eye"), width=LENS.width, height=LENS.height, d=list(LENS.d),
                  k=[LENS.fx, 0, LENS.cx, 0, LENS.fy, LENS.cy, 0, 0, 1])
LEFT, RIGHT = (replace(topics.CAMERA_IMAGE, key=f"{side}/image_raw") for side in ("left", "right"))


pytestmark = pytest.mark.usefixtures("state_folder")


def start() -> HandEyeSession:
    return HandEyeSession("wrist", CONFIG, BOARD, "hand")


class Arm:
    """Stops in one pose after the other, with an image of the board."""

    def __init__(self) -> None:
        self.session, self.now = start(), 10.0

    def stop_at(self, q: np.ndarray, image: Image | None = None) -> str:
        """Take an image, by default of the board, after half a second at rest; return why it is rejected."""
        for _ in range(12):
            self.now += 0.05
            self.session.add_joints(JointState(header=Header(stamp=round(self.now * 1e9)), name=ROBOT.joint_names,
                                               position=q.tolist()))
        if image is None:
            A, B = TRUTH["hand"]
            T = invert(A) @ invert(ROBOT.fk(q)) @ B
            image = array_to_image(render(BOARD, LENS, T, seed=round(self.now)), "bgr8")
        image.header.stamp = round(self.now * 1e9)
        self.image = image
        return self.session.add_image(image)


@pytest.fixture
def arm() -> Arm:
    return Arm()


def poses(count: int) -> list[np.ndarray]:
    found = [solve_ik(ROBOT, T, HOME, restarts=30) for T in hands("hand", 2 * count)]
    return [q for q in found if q is not None][:count]


@pytest.mark.slow
def test_camera_pose_is_found_from_collected_views(arm: Arm) -> None:
    session = arm.session
    assert session.missing.startswith("15 more views: tilt the ")
    reasons = [arm.stop_at(q) for q in poses(9)]
    assert reasons.count("") == session.count >= 7, reasons
    assert session.missing.startswith(f"{15 - session.count} more views: ")
    assert all(turn > 10 for turn in session.rotations.values())
    result = session.calibrate(INFO)
    camera = CameraFile.load(str(session.folder / "camera.yaml"))
    assert camera.mount == "tcp" and camera.position is not None and camera.rpy is not None
    distance, angle = off(transform(rpy_to_matrix(*camera.rpy), camera.position), TRUTH["hand"][0])
    assert distance < 0.002 and angle < 0.005
    assert result.lines[0].startswith(("good", "fair")) and str(session.folder / "camera.yaml") in result.lines[-1]
    assert len(result.residuals) + len(result.dropped) == session.count


def test_rejected_image_has_a_reason_and_views_are_saved(arm: Arm) -> None:
    assert arm.stop_at(poses(1)[0]) == "" and arm.session.add_image(arm.image) != ""
    assert arm.session.add_image(arm.image.model_copy(update={"header": Header(stamp=1)})) != ""
    with pytest.raises(CalibrationFailed, match="views of the board"):
        arm.session.calibrate(INFO)
    assert start().count == 1


@pytest.mark.parametrize("name", ["", "../up", "a b", "x" * 41])
def test_invalid_name_is_rejected(name: str) -> None:
    with pytest.raises(ConfigError, match="must be letters"):
        views_folder(name)


@pytest.mark.parametrize(("encoding", "data", "reason"), [
    ("mono8", bytes(48 * 64), "too dark"), ("32FC1", bytes(48 * 64 * 4), "'32FC1'"),
    ("16UC1", bytes(48 * 64 * 2), "'16UC1'"), ("bgr8", b"few", "too few for 64x48")])
def test_unusable_image_is_rejected_with_the_reason(arm: Arm, encoding: str, data: bytes, reason: str) -> None:
    image = Image(header=Header(), width=64, height=48, encoding=encoding, data=data)
    assert reason in arm.stop_at(HOME, image)


@pytest.mark.parametrize(("content", "error"), [
    *(({"robot": "panda", "pictures": {"view_000.png": q}}, r"joints.yaml: view_000.png.* must be 7 joints")
      for q in ([], [0.0] * 3, [0.0] * 9)),
    ({"robot": "panda_long"}, "another robot: panda_long"),
    ({"robot": "panda"}, ""), ({"robot": "robots/panda.yaml"}, ""),
])
def test_saved_views_must_be_of_the_same_robot_with_its_joints(content: dict[str, Any], error: str) -> None:
    (start().folder / "joints.yaml").write_text(yaml.safe_dump({"joints": ROBOT.joint_names, **content}))
    if error:
        with pytest.raises(ConfigError, match=error):
            start()
    else:
        assert start().count == 0


def test_deleted_view_leaves_other_views_unchanged(arm: Arm, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Board, "find", lambda *_: SimpleNamespace(blur=0.5))
    rotated = [HOME + 0.3 * np.eye(7)[joint] for joint in range(4)]
    assert [arm.stop_at(q) for q in rotated[:3]] == ["", "", ""]
    file = arm.session.folder / "joints.yaml"
    content = yaml.safe_load(file.read_text())
    del content["pictures"]["view_001.png"]
    file.write_text(yaml.safe_dump(content))
    arm.session = start()
    assert arm.stop_at(rotated[3]) == "" and arm.session.count == 3
    pictures = yaml.safe_load(file.read_text())["pictures"]
    assert [pictures[name] for name in content["pictures"]] == [*content["pictures"].values()] and len(pictures) == 3


def test_view_that_cannot_be_saved_is_not_counted(arm: Arm, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Board, "find", lambda *_: SimpleNamespace(blur=0.5))
    (arm.session.folder / ".joints.yaml.part").mkdir()  # has the effect of a full disk
    with pytest.raises(ConfigError, match="cannot be written"):
        arm.stop_at(HOME)
    assert arm.session.count == 0


# --- panel ---


def panel_of(gui: viser.GuiApi, latest: Any, *cameras: Any) -> tuple[HandEyePanel, list[str]]:
    """Return a panel and the list of its notifications."""
    console, notes = ActionQueue(), list[str]()
    console.notify = lambda line, _kind="bad": notes.append(line)
    panel = HandEyePanel(gui, console, latest, list(cameras), load_cell("ur5").robot, on_topics=lambda: None)
    return panel, notes


async def test_views_are_of_the_camera_selected_at_the_start(gui: viser.GuiApi) -> None:
    requested: list[str] = []
    panel, _ = panel_of(gui, lambda topic: requested.append(topic.key), LEFT, RIGHT)

    def needed() -> list[str]:
        return [topic.key for topic in panel.needed_topics]

    panel._set("name", "wrist")
    await panel._start()
    panel._set("camera", RIGHT.key)
    assert needed() == ["left/image_raw", "left/camera_info"]
    await panel._capture()
    panel.update(1.0)
    assert {key for key in requested if key.endswith("image_raw")} == {LEFT.key}
    await panel._start()
    assert needed() == ["right/image_raw", "right/camera_info"]
    panel._end()
    assert needed() == []


async def test_result_of_a_former_calibration_is_not_shown_for_the_next(gui: viser.GuiApi) -> None:
    """Capturing and calibrating take seconds: another calibration may have started meanwhile."""
    proceed = Event()

    def slow(result: Any) -> Any:
        assert proceed.wait(10)
        return result

    session: Any = SimpleNamespace(count=9, add_image=lambda _image: slow("the arm moves"),
                                   calibrate=lambda _info: slow(Result(True, ["good: former one"])))
    panel, notes = panel_of(gui, lambda topic: topic, LEFT)
    for operation in (panel._capture, panel._calibrate):
        proceed.clear()
        panel._session = session
        running = asyncio.create_task(operation())
        await asyncio.sleep(0)
        panel._set("name", "next")
        await panel._start()
        proceed.set()
        await running
        assert panel._result is None and "the arm moves" not in panel._status()
    assert notes[-1] == "good: former one"
