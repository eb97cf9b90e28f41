"""A hand-eye calibration as the page guides it: views that are kept, what is missing, and what comes of them."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from common.atomic_file import state_folder
from common.config import RobotConfig
from common.errors import ConfigError
from common.messages import CameraInfo, Image, JointState
from common.perception.camera_file import CameraFile
from common.robot.model import RobotModel
from tools.calibration.board import Board
from tools.calibration.hand_eye import MIN_VIEWS, calibrate_hand_eye
from tools.calibration.intrinsics import ViewResidual
from tools.calibration.report import with_hand_eye
from tools.calibration.views import AXES, HandEyeCollector, load_views

Mount = Literal["hand", "beside"]

WANTED = 15  # views
ENOUGH = math.radians(40)  # that the hand should have been turned about each of its axes
_NAME = re.compile(r"[\w-]{1,40}", re.ASCII)


def folder_of(name: str) -> Path:
    """Where the views of a calibration are kept.

    Raises:
        ConfigError: the name is none.
    """
    if not _NAME.fullmatch(name):
        raise ConfigError("Called", name, "must be letters, digits, '_' and '-', at most 40")
    return state_folder() / "hand_eye" / name


@dataclass(frozen=True)
class Result:
    """A calibration, in lines."""

    good: bool
    lines: list[str]
    residuals: list[ViewResidual] = field(default_factory=list)
    dropped: list[ViewResidual] = field(default_factory=list)


class HandEye:
    """Keeps views of one calibration, and calibrates. Used by one thread at a time; makes a robot of its own."""

    def __init__(self, name: str, robot: RobotConfig, board: Board, mount: Mount) -> None:
        """Go on with the views that there are under a name; takes a moment.

        Raises:
            ConfigError: the name is none, or the views are of another robot.
        """
        self.folder, self._board, self.mount = folder_of(name), board, mount
        self._robot = RobotModel.load(robot)
        self._collector = HandEyeCollector(self.folder, self._robot, robot.name, board)

    @property
    def count(self) -> int:
        """Views that are kept."""
        return self._collector.count

    @property
    def missing(self) -> str:
        """What is missing, in words; empty when nothing is."""
        few = WANTED - self.count
        turns = self._collector.rotation_ranges
        if few <= 0 and turns.min() >= ENOUGH:
            return ""
        views = f"{few} more views" if few > 1 else "one more view" if few == 1 else "some more views"
        return f"{views}: {self._collector.hint}"

    @property
    def turned(self) -> dict[str, float]:
        """By how many degrees the hand was turned about each of its axes."""
        return {axis: math.degrees(turn) for axis, turn in zip(AXES, self._collector.rotation_ranges, strict=True)}

    def joints(self, state: JointState) -> None:
        """Take note of where the joints are."""
        at = dict(zip(state.name, state.position, strict=True))
        if all(name in at for name in self._robot.joint_names):
            self._collector.joints(state.header.stamp * 1e-9, np.array([at[n] for n in self._robot.joint_names]))

    def take(self, image: Image) -> str:
        """Keep a picture as a view: empty if it is, else why not."""
        return self._collector.add(image)

    def calibrate(self, info: CameraInfo) -> Result:
        """Where the camera is by all views; writes the file that a cell takes. Takes seconds.

        Raises:
            CalibrationFailed: too few views, or they do not fit together.
            ConfigError: the file cannot be written.
        """
        camera = CameraFile(width=info.width, height=info.height, fx=info.k[0], fy=info.k[4], cx=info.k[2],
                            cy=info.k[5], d=list(info.d), frame=info.header.frame_id or None)
        views, why, said = load_views(self.folder, self._board, camera, self._robot)
        found = calibrate_hand_eye(views, camera, self.mount)
        file = self.folder / "camera.yaml"
        with_hand_eye(camera, found, str(self.folder), said.robot, self.mount).save(str(file))
        place = ", ".join(f"{1e3 * value:.1f}" for value in found.position)
        turn = ", ".join(f"{math.degrees(value):.2f}" for value in found.rpy)
        return Result(
            found.verdict.startswith("good"),
            [found.verdict,
             f"at {place} mm, turned {turn}° in {'the tool' if self.mount == 'hand' else 'world'}",
             f"residual {found.rms:.2f} px, {1e3 * found.rms_at_board:.2f} mm at the board, "
             f"of {len(found.pictures)} views" + (f"; {len(why)} without the board" if why else ""),
             f"a cell takes it with --set world.camera={file}"],
            found.pictures, found.dropped)


def why_not(views: int) -> str:
    """Why so many views cannot be calibrated; empty if they can."""
    return "" if views >= MIN_VIEWS else f"{MIN_VIEWS} views are needed"
