"""Guided hand-eye calibration in the Cameras tab: collects views, reports which are missing, and calibrates."""

from __future__ import annotations

import asyncio
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import viser

from common import topics
from common.atomic_file import state_folder
from common.config import RobotConfig, check
from common.errors import ConfigError
from common.messages import CameraInfo, Image, JointState
from common.topics import Topic
from page.console import Console
from page.feeds import Latest
from page.markup import Html, block, buttons, fields, line, press, row, span, table

if TYPE_CHECKING:
    from tools.calibration.board import Board
    from tools.calibration.intrinsics import ViewResidual

Mount = Literal["hand", "beside"]

REQUIRED_VIEWS = 15
REQUIRED_ROTATION = math.radians(40)  # of the gripper about each of its axes
MOUNTS: dict[str, Mount] = {"on the gripper": "hand", "fixed, with the board on the gripper": "beside"}
IMAGE_PERIOD = 0.5  # [s] between two images that are checked
_NAME = re.compile(r"[\w-]{1,40}", re.ASCII)


def views_folder(name: str) -> Path:
    """Return the folder of the views of a calibration.

    Raises:
        ConfigError: the name is invalid.
    """
    if not _NAME.fullmatch(name):
        raise ConfigError("Calibration name", name, "must be letters, digits, '_' and '-', at most 40")
    return state_folder() / "hand_eye" / name


@dataclass(frozen=True)
class Result:
    """Result of a calibration: lines for the operator, and the residual of each view."""

    good: bool
    lines: list[str]
    residuals: list[ViewResidual] = field(default_factory=list)
    dropped: list[ViewResidual] = field(default_factory=list)


class HandEyeSession:
    """Collects views of one calibration, and calibrates. Used by one thread at a time; has its own robot model."""

    def __init__(self, name: str, robot: RobotConfig, board: Board, mount: Mount) -> None:
        """Continue with the existing views of that name; takes a moment.

        Raises:
            ConfigError: the name is invalid, or the views are of another robot.
        """
        from common.robot.model import RobotModel
        from tools.calibration.views import HandEyeCollector

        self.folder, self._board, self.mount = views_folder(name), board, mount
        self._robot = RobotModel.load(robot)
        self._collector = HandEyeCollector(self.folder, self._robot, robot.name, board)

    @property
    def count(self) -> int:
        """Number of views."""
        return self._collector.count

    @property
    def missing(self) -> str:
        """Text of what is missing; empty if nothing is."""
        missing = REQUIRED_VIEWS - self.count
        if missing <= 0 and self._collector.rotation_ranges.min() >= REQUIRED_ROTATION:
            return ""
        views = f"{missing} more views" if missing > 1 else "one more view" if missing == 1 else "some more views"
        return f"{views}: {self._collector.hint}"

    @property
    def rotations(self) -> dict[str, float]:
        """Range of rotation of the gripper about each of its axes [degrees]."""
        from tools.calibration.views import AXES

        return {axis: math.degrees(turn) for axis, turn in zip(AXES, self._collector.rotation_ranges, strict=True)}

    def add_joints(self, state: JointState) -> None:
        """Add joint states."""
        at = dict(zip(state.name, state.position, strict=True))
        if all(name in at for name in self._robot.joint_names):
            self._collector.joints(state.header.stamp * 1e-9, np.array([at[n] for n in self._robot.joint_names]))

    def add_image(self, image: Image) -> str:
        """Add an image as a view; return why it is rejected, or an empty text."""
        return self._collector.add(image)

    def calibrate(self, info: CameraInfo) -> Result:
        """Calibrate with all views and write the camera file for a cell. Takes seconds.

        Raises:
            CalibrationFailed: too few or inconsistent views.
            ConfigError: the file cannot be written.
        """
        from common.perception.camera_file import CameraFile
        from tools.calibration.report import with_hand_eye
        from tools.calibration.views import calibrate_views, load_views

        camera = CameraFile(width=info.width, height=info.height, fx=info.k[0], fy=info.k[4], cx=info.k[2],
                            cy=info.k[5], d=list(info.d), frame=info.header.frame_id or None)
        views, skipped, joints = load_views(self.folder, self._board, camera, self._robot)
        found = calibrate_views(views, self._robot, camera, self.mount)
        file = self.folder / "camera.yaml"
        with_hand_eye(camera, found, str(self.folder), joints.robot, self.mount).save(str(file))
        position = ", ".join(f"{1e3 * value:.1f}" for value in found.position)
        rotation = ", ".join(f"{math.degrees(value):.2f}" for value in found.rpy)
        return Result(
            found.verdict.startswith("good"),
            [found.verdict,
             f"position {position} mm, rotation {rotation}° in the "
             f"{'tool' if self.mount == 'hand' else 'world'} frame",
             f"residual {found.rms:.2f} px, {1e3 * found.rms_at_board:.2f} mm at the board, "
             f"from {len(found.pictures)} views" + (f"; {len(skipped)} without the board" if skipped else ""),
             f"use it in a cell with --set world.camera={file}"],
            found.pictures, found.dropped)

    @property
    def too_few(self) -> str:
        """Why a calibration is not possible yet; empty if it is."""
        from tools.calibration.hand_eye import MIN_VIEWS

        return "" if self.count >= MIN_VIEWS else f"{MIN_VIEWS} views are needed"


class HandEyePanel:
    """Fields for camera and board, progress, and buttons. It moves nothing: the operator jogs the arm to the views."""

    def __init__(
        self, gui: viser.GuiApi, console: Console, latest: Latest, images: Sequence[Topic[Image]], robot: RobotConfig,
        *, on_topics: Callable[[], None],
    ) -> None:
        """Build the panel.

        Args:
            gui: of the server.
            console: runs the buttons.
            latest: source of the newest message of a topic.
            images: of the cameras.
            robot: that carries camera or board.
            on_topics: called when `needed_topics` has changed.
        """
        self._console, self._latest, self._robot, self._on_topics = console, latest, robot, on_topics
        self._images = {topic.key: topic for topic in images}
        self._values: dict[str, Any] = {
            "name": "", "camera": next(iter(self._images), ""), "mount": next(iter(MOUNTS)), "columns": 7, "rows": 5,
            "square": 36.0, "legacy": False, "auto": True}
        self._session: HandEyeSession | None = None
        self._camera = next(iter(self._images))  # of the current session
        self._busy, self._note, self._next_image = False, "", 0.0
        self._seen: tuple[Image | None, JointState | None] = (None, None)
        self._result: Result | None = None
        inputs: list[tuple[str, Any]] = [
            ("name", gui.add_text("Calibration name", "", hint="folder name of the views")),
            ("camera", gui.add_dropdown("Camera", list(self._images) or [""])),
            ("mount", gui.add_dropdown("Camera mount", list(MOUNTS))),
            ("columns", gui.add_number("Board squares along x", 7, min=3, max=50, step=1)),
            ("rows", gui.add_number("Board squares along y", 5, min=3, max=50, step=1)),
            ("square", gui.add_number("Square size [mm]", 36.0, min=1.0, max=1000.0, step=0.1,
                                      hint="measured on the print of `zencell calibrate board`")),
            ("legacy", gui.add_checkbox("Board pattern before OpenCV 4.6", False)),
            ("auto", gui.add_checkbox("Capture automatically", True, hint="whenever the arm is at rest in a new pose")),
        ]
        for name, handle in inputs:
            console.on_change(handle, partial(self._set, name))
        for name, action, label in (
            ("begin", self._start, "Start calibration"), ("take", self._capture, "Capture view"),
            ("calibrate", self._calibrate, "Calibrate"), ("end", self._end, "End calibration"),
        ):
            console.on_press(f"eye:{name}", action, label)
        self._buttons, self._html = Html(gui), Html(gui)

    @property
    def needed_topics(self) -> list[Topic[Any]]:
        """Topics to read now."""
        topic = self._images[self._camera]
        return [topic, self._info(topic)] if self._session is not None else []

    @staticmethod
    def _info(topic: Topic[Any]) -> Topic[CameraInfo]:
        return replace(topics.CAMERA_INFO, key=f"{topic.key.rpartition('/')[0]}/camera_info")

    def update(self, now: float) -> None:
        """Process new joint states, and capture a new image if enabled, at a wall time [s], monotonic."""
        session = self._session
        if session is None or self._busy:
            return
        state = self._latest(topics.JOINT_STATES)
        if state is not None and state is not self._seen[1]:
            self._seen = (self._seen[0], state)
            session.add_joints(state)
        if self._values["auto"] and now >= self._next_image:
            self._next_image = now + IMAGE_PERIOD
            image = self._latest(self._images[self._camera])
            if image is not None and image is not self._seen[0]:
                self._seen = (image, self._seen[1])
                self._console.put(self._capture)

    def show(self) -> None:
        """Update the panel."""
        session = self._session
        inactive = "" if session is not None else "start a calibration first"
        self._buttons.set(block(buttons(
            press("Start calibration" if session is None else "Start another", "eye:begin",
                  "" if self._values["name"] else "enter a name first"),
            press("Capture view", "eye:take", inactive or ("an image is being processed" if self._busy else "")),
            press("Calibrate", "eye:calibrate", inactive or (session.too_few if session is not None else "")),
            press("End calibration", "eye:end", inactive)), "hand-eye orders"))
        self._html.set(self._status())

    def _status(self) -> str:
        """Return progress, the result for the last image, and the result of the calibration as HTML."""
        session = self._session
        if session is None:
            return block(span(
                "Fix a board in view of the camera, enter a name and press Start calibration. Then jog the arm, and "
                "tilt the gripper to all sides between views.", "dim"), "hand-eye", views=0)
        rotations = {f"rotation {axis}": f"{degrees:.0f}°" for axis, degrees in session.rotations.items()}
        missing = session.missing
        todo = line(f"Missing: {missing}", "busy") if missing else line("Complete: press Calibrate", "good")
        lines = [fields({"views": session.count, "camera": self._camera, **rotations}), todo, line(self._note, "dim")]
        if (result := self._result) is not None:
            kinds = ["good" if result.good else "bad", *["" for _ in result.lines[1:]]]
            lines += [line(each, kind) for each, kind in zip(result.lines, kinds, strict=True)]
            rows = [row(span(each.name, ""), f"{each.rms:.2f} px", span(remark, "busy" if remark else ""))
                    for each, remark in [*((each, "") for each in result.residuals),
                                         *((each, "dropped: outlier") for each in result.dropped)]]
            lines.append(table(("View", "Residual ", ""), rows, "small"))
        return block("".join(lines), "hand-eye", views=session.count, missing=missing,
                     good=bool(result and result.good))

    # --- operations ---

    def _set(self, name: str, value: Any) -> None:
        self._values[name] = value.strip() if isinstance(value, str) else value

    async def _start(self) -> None:
        from tools.calibration.board import Board, BoardOptions

        square = 1e-3 * self._values["square"]
        board = Board(check(BoardOptions, {"columns": round(self._values["columns"]), "square": square,
                                           "rows": round(self._values["rows"]), "marker": round(0.75 * square, 6),
                                           "legacy": self._values["legacy"]},
                            "board"))
        camera = self._values["camera"]
        self._session = await asyncio.to_thread(
            HandEyeSession, self._values["name"], self._robot, board, MOUNTS[self._values["mount"]])
        self._camera, self._note, self._result = camera, "", None
        self._on_topics()
        self._console.notify(f"Views are saved in {self._session.folder}", "good")

    def _end(self) -> None:
        self._session = None
        self._on_topics()

    async def _capture(self) -> None:
        session, image = self._session, self._latest(self._images[self._camera])
        if session is None or self._busy:
            return
        if image is None:
            self._note = "no image received from this camera"
            return
        self._busy = True
        try:
            reason = await asyncio.to_thread(session.add_image, image)
        finally:
            self._busy = False
        if session is self._session:  # no other calibration was started meanwhile
            self._note = f"image rejected: {reason}" if reason else f"view {session.count} captured"

    async def _calibrate(self) -> None:
        session, info = self._session, self._latest(self._info(self._images[self._camera]))
        if session is None or self._busy:
            return
        if info is None:
            raise ConfigError("Camera", self._camera, "has not published its camera info")
        self._busy = True
        try:
            result = await asyncio.to_thread(session.calibrate, info)
        finally:
            self._busy = False
        if session is self._session:
            self._result = result
        self._console.notify(result.lines[0], "good" if result.good else "bad")
