"""Guided hand-eye calibration: missing views are named, views are saved, and the camera pose is found."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from threading import Event
from types import SimpleNamespace
from typing import Any, cast

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
INFO = CameraInfo(header=Header(stamp=1, frame_id="eye"), width=LENS.width, height=LENS.height, d=list(LENS.d),
                  k=[LENS.fx, 0, LENS.cx, 0, LENS.fy, LENS.cy, 0, 0, 1])
LEFT, RIGHT = (replace(topics.CAMERA_IMAGE, key=f"{side}/image_raw") for side in ("left", "right"))


@pytest.fixture(autouse=True)
def state(state_folder: Path) -> Iterator[None]:
    yield


def start() -> HandEyeSession:
    return HandEyeSession("wrist", CONFIG, BOARD, "hand")


class Arm:
    """Stops in one pose after the other, with an image of the board."""

    def __init__(self, session: HandEyeSession) -> None:
        self.session, self.now = session, 10.0

    def stop_at(self, q: np.ndarray) -> Image:
        """Return the image after half a second at rest."""
        A, B = TRUTH["hand"]
        for _ in range(12):
            self.now += 0.05
            self.session.add_joints(JointState(header=Header(stamp=round(self.now * 1e9)), name=ROBOT.joint_names,
                                               position=q.tolist()))
        image = array_to_image(render(BOARD, LENS, invert(A) @ invert(ROBOT.fk(q)) @ B, seed=round(self.now)), "bgr8")
        image.header.stamp = round(self.now * 1e9)
        return image


def poses(count: int) -> list[np.ndarray]:
    found = [solve_ik(ROBOT, T, ROBOT.named("home"), restarts=30) for T in hands("hand", 2 * count)]
    return [q for q in found if q is not None][:count]


@pytest.mark.slow
def test_camera_pose_is_found_from_collected_views() -> None:
    session = start()
    arm, reasons = Arm(session), []
    assert session.missing.startswith("15 more views: tilt the ")
    for q in poses(9):
        reasons.append(session.add_image(arm.stop_at(q)))
    assert reasons.count("") == session.count >= 7, reasons
    assert session.missing.startswith(f"{15 - session.count} more views: ")
    assert all(turn > 10 for turn in session.rotations.values())
    result = session.calibrate(INFO)
    camera = CameraFile.load(str(session.folder / "camera.yaml"))
    assert camera.mount == "tcp" and camera.position is not None and camera.rpy is not None
    distance, angle = off(transform(rpy_to_matrix(*camera.rpy), camera.position), TRUTH["hand"][0])
    assert distance < 0.002 and angle < 0.005
    assert result.lines[0].startswith(("good", "fair"))
    assert len(result.residuals) + len(result.dropped) == session.count
    assert str(session.folder / "camera.yaml") in result.lines[-1]


def test_rejected_image_has_a_reason_and_views_are_saved() -> None:
    session = start()
    arm, q = Arm(session), poses(1)[0]
    image = arm.stop_at(q)
    assert session.add_image(image) == "" and session.add_image(image) != ""
    assert session.add_image(image.model_copy(update={"header": Header(stamp=1)})) != ""
    with pytest.raises(CalibrationFailed, match="views of the board"):
        session.calibrate(INFO)
    assert start().count == 1


@pytest.mark.parametrize("name", ["", "../up", "a b", "x" * 41])
def test_invalid_name_is_rejected(name: str) -> None:
    with pytest.raises(ConfigError, match="must be letters"):
        views_folder(name)


@pytest.fixture
def arm() -> Arm:
    arm = Arm(start())
    arm.stop_at(ROBOT.named("home"))
    return arm


@pytest.mark.parametrize(("encoding", "kind", "reason"), [
    ("mono8", np.uint8, "no marker"), ("32FC1", np.float32, "'32FC1'"), ("16UC1", np.uint16, "'16UC1'"),
    ("bgr8", None, "too few for 64x48")])
def test_unusable_image_is_rejected_with_the_reason(arm: Arm, encoding: str, kind: type | None, reason: str) -> None:
    image = (array_to_image(np.zeros((48, 64), kind), encoding) if kind
             else Image(header=Header(), width=64, height=48, encoding=encoding, data=b"few"))
    image.header.stamp = round(arm.now * 1e9)
    assert reason in arm.session.add_image(image)


@pytest.mark.parametrize("q", [[], [0.0] * 3, [0.0] * 9])
def test_view_with_a_wrong_number_of_joints_is_rejected_by_its_name(q: list[float]) -> None:
    file = start().folder / "joints.yaml"
    file.write_text(yaml.safe_dump({"robot": "panda", "joints": ROBOT.joint_names, "pictures": {"view_000.png": q}}))
    with pytest.raises(ConfigError, match=r"joints.yaml: view_000.png.* must be 7 joints"):
        start()


@pytest.mark.parametrize(("robot", "accepted"), [("panda", True), ("robots/panda.yaml", True), ("panda_long", False)])
def test_views_of_another_robot_with_the_same_joint_names_are_rejected(robot: str, accepted: bool) -> None:
    file = start().folder / "joints.yaml"
    file.write_text(yaml.safe_dump({"robot": robot, "joints": ROBOT.joint_names}))
    if accepted:
        assert start().count == 0
        return
    with pytest.raises(ConfigError, match="another robot: panda_long"):
        start()


def test_deleted_view_leaves_other_views_unchanged(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Board, "find", lambda *_: SimpleNamespace(blur=0.5))
    arm, home = Arm(start()), ROBOT.named("home")
    rotated = [home + 0.3 * np.eye(7)[joint] for joint in range(4)]
    for q in rotated[:3]:
        assert arm.session.add_image(arm.stop_at(q)) == ""
    file = arm.session.folder / "joints.yaml"
    content = yaml.safe_load(file.read_text())
    del content["pictures"]["view_001.png"]
    file.write_text(yaml.safe_dump(content))
    arm.session = start()
    assert arm.session.add_image(arm.stop_at(rotated[3])) == "" and arm.session.count == 3
    pictures = yaml.safe_load(file.read_text())["pictures"]
    assert [pictures[name] for name in content["pictures"]] == [*content["pictures"].values()] and len(pictures) == 3


def test_view_that_cannot_be_saved_is_not_counted(arm: Arm, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Board, "find", lambda *_: SimpleNamespace(blur=0.5))
    (arm.session.folder / ".joints.yaml.part").mkdir()  # has the effect of a full disk
    with pytest.raises(ConfigError, match="cannot be written"):
        arm.session.add_image(arm.stop_at(ROBOT.named("home")))
    assert arm.session.count == 0


# --- panel ---


async def test_views_are_of_the_camera_selected_at_the_start(gui: viser.GuiApi) -> None:
    requested: list[str] = []
    panel = HandEyePanel(gui, cast(Any, ActionQueue()), lambda topic: requested.append(topic.key), [LEFT, RIGHT],
                         load_cell("ur5").robot, on_topics=lambda: None)

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
    proceed, notes = Event(), list[str]()

    class SlowSession:
        count = 9

        def add_image(self, _image: Any) -> str:
            assert proceed.wait(10)
            return "the arm moves"

        def calibrate(self, _info: Any) -> Result:
            assert proceed.wait(10)
            return Result(True, ["good: former one"])

    console: Any = ActionQueue()
    console.notify = lambda line, _kind="bad": notes.append(line)
    panel = HandEyePanel(gui, console, lambda topic: topic, [LEFT], load_cell("ur5").robot, on_topics=lambda: None)
    for operation in (panel._capture, panel._calibrate):
        proceed.clear()
        panel._session = cast(Any, SlowSession())
        running = asyncio.create_task(operation())
        await asyncio.sleep(0)
        panel._set("name", "next")
        await panel._start()
        proceed.set()
        await running
        assert panel._result is None and "the arm moves" not in panel._status()
    assert notes[-1] == "good: former one"
