"""Views for a hand-eye calibration: which pictures of an arm that rests count, and the folder that keeps them."""

from __future__ import annotations

import asyncio
import math
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import Field

from common import topics
from common.config import Number, Parameters, check, load_robot, read_yaml
from common.errors import ConfigError, ZencellError
from common.messages import Image
from common.perception.camera_file import CameraFile
from common.perception.camera_input import FrameError, decode_color_image
from common.perception.image import ImageError, image_to_array
from common.robot.model import RobotModel
from common.transport.bus import Bus
from common.transport.reader import Reader
from tools.calibration.board import Board, NoBoard
from tools.calibration.camera_pose import detect_boards
from tools.calibration.hand_eye import View

Array = npt.NDArray[np.float64]
Picture = npt.NDArray[np.uint8]

JOINTS_FILE = "joints.yaml"
RESTS = 0.4  # [s] before a picture, in which the arm must not have moved
STILL = 2e-4  # [rad] that joints may differ by then
NEW_TURN, NEW_PLACE = math.radians(8), 0.04  # [rad], [m]: by either of them the hand is in another pose
MOST_BLUR = 2.5  # [px] that edges may be smeared over
AXES = ("x", "y", "z")


class JointsFile(Parameters):
    """Which joints go with which picture of the folder."""

    robot: str = Field(description="name of the robot file, or its path")
    joints: list[str] = Field(min_length=1, description="names of the joints, in the order of the positions")
    pictures: dict[str, list[Number]] = Field({}, description="name of a picture: positions of the joints [rad]")


class HandEyeCollector:
    """Takes joints and pictures as they come, and keeps those that a calibration gains from, in a folder."""

    def __init__(self, folder: Path, robot: RobotModel, name: str, board: Board) -> None:
        """Go on with what the folder has.

        Raises:
            ConfigError: it is of another robot, or cannot be written.
        """
        self._folder, self._robot, self._board = folder, robot, board
        file = folder / JOINTS_FILE
        self._file = JointsFile(robot=name, joints=robot.joint_names)
        if file.exists():
            self._file = _read(folder)
            if self._file.joints != robot.joint_names or _differ(self._file.robot, name):
                raise ConfigError("FOLDER", str(folder), f"has views of another robot: {self._file.robot}")
            _require_joints(folder, self._file, robot)
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError("FOLDER", str(folder), f"cannot be made: {error.strerror}") from None
        self._hands = [robot.fk(q) for q in self._file.pictures.values()]
        self._recent: deque[tuple[float, Array]] = deque(maxlen=1000)

    @property
    def joint_names(self) -> list[str]:
        """Of the robot, in the order in which positions are told."""
        return self._robot.joint_names

    @property
    def count(self) -> int:
        """Views that are kept."""
        return len(self._hands)

    def joints(self, stamp: float, q: Array) -> None:
        """Take note of where the joints were (dof,) [rad] at a stamp [s]."""
        self._recent.append((stamp, q))

    def look(self, image: Image) -> str:
        """Keep a picture as it came: empty if it is, else why not."""
        try:
            grey = image.encoding == "mono8"
            picture = np.asarray(image_to_array(image), np.uint8) if grey else decode_color_image(image)
        except (ImageError, FrameError) as error:
            return str(error)
        return self.picture(image.header.stamp * 1e-9, np.ascontiguousarray(picture))

    def picture(self, stamp: float, picture: Picture) -> str:
        """Keep a bgr8 picture of a stamp [s]: empty if it is, else why not."""
        around = [q for at, q in self._recent if stamp - RESTS <= at <= stamp]
        if not around or self._recent[0][0] > stamp - RESTS:
            return "nobody says where the joints were"
        if np.ptp(np.array(around), axis=0).max() > STILL:
            return "the arm moves"
        hand = self._robot.fk(around[-1])
        if any(_near(hand, other) for other in self._hands):
            return "the hand was in this pose before"
        sighting = self._board.find(picture, "")
        if isinstance(sighting, NoBoard):
            return sighting.reason
        if sighting.blur > MOST_BLUR:
            return f"edges are smeared over {sighting.blur:.1f} px"
        names = (f"view_{number:03d}.png" for number in count(self.count))  # who left one out has others behind it
        name = next(name for name in names if name not in self._file.pictures)
        if not cv2.imwrite(str(self._folder / name), picture):
            raise ConfigError("FOLDER", str(self._folder), "cannot be written")
        q = [round(float(value), 9) for value in around[-1]]
        said = self._file.model_copy(update={"pictures": {**self._file.pictures, name: q}})
        _write(self._folder, said)
        self._file = said
        self._hands.append(hand)
        return ""

    @property
    def turns(self) -> Array:
        """(3,) [rad] by how much the hand was turned about each of its axes, between all views."""
        if not self._hands:
            return np.zeros(3)
        first = self._hands[0][:3, :3]
        turns = np.array([cv2.Rodrigues(first.T @ hand[:3, :3])[0].ravel() for hand in self._hands])
        return np.asarray(np.ptp(turns, axis=0))

    @property
    def hint(self) -> str:
        """What the next view had better be like."""
        if len(self._hands) < 2:
            return "tilt the hand to another side"
        return f"turn the hand further about its {AXES[int(np.argmin(self.turns))]} axis"


def load_views(
    folder: Path, board: Board, camera: CameraFile, moved: RobotModel | None = None
) -> tuple[list[View], list[str], JointsFile]:
    """The views of a folder, for each picture without the board why, and what the folder says.

    Args:
        folder: in which they are kept.
        board: that they show.
        camera: that they were taken with.
        moved: the robot; left out: the one that the folder names.

    Raises:
        ConfigError: it has no views, or they do not fit the robot.
        CalibrationFailed: pictures have another size than the intrinsics are for.
    """
    said = _read(folder)
    robot = moved or RobotModel.load(load_robot(said.robot))
    if said.joints != robot.joint_names:
        raise ConfigError(f"{folder / JOINTS_FILE}: joints", said.joints, f"are not those of {said.robot}")
    _require_joints(folder, said, robot)
    views, why = [], []
    for name, q in said.pictures.items():
        picture: Any = cv2.imread(str(folder / Path(name).name))
        if picture is None:
            raise ConfigError(f"{folder / JOINTS_FILE}: pictures", name, "is no picture in that folder")
        found, reasons = detect_boards(board, [(name, picture)], camera, MOST_BLUR)
        why += [f"{name}: {reason}" for reason in reasons]
        views += [View(sighting, robot.fk(q)) for sighting in found]
    return views, why, said


def _near(a: Array, b: Array) -> bool:
    turn = float(np.linalg.norm(cv2.Rodrigues(a[:3, :3].T @ b[:3, :3])[0]))
    return turn < NEW_TURN and float(np.linalg.norm(a[:3, 3] - b[:3, 3])) < NEW_PLACE


def _read(folder: Path) -> JointsFile:
    return check(JointsFile, read_yaml(folder / JOINTS_FILE), str(folder / JOINTS_FILE))


def _differ(robot: str, other: str) -> bool:
    """Whether two names are those of different robots, whose joints may well be called the same; of paths who knows."""
    return robot != other and not any(name.endswith((".yaml", ".yml")) for name in (robot, other))


def _require_joints(folder: Path, said: JointsFile, robot: RobotModel) -> None:
    """Return when each picture comes with as many joints as the robot has.

    Raises:
        ConfigError: one does not.
    """
    for name, q in said.pictures.items():
        if len(q) != robot.dof:
            raise ConfigError(f"{folder / JOINTS_FILE}: {name}", q, f"must be {robot.dof} joints")


def _write(folder: Path, said: JointsFile) -> None:
    """Write the file, all of it or nothing: without it no picture is a view.

    Raises:
        ConfigError: it cannot be written.
    """
    import yaml

    text = yaml.safe_dump(said.model_dump(), sort_keys=False, default_flow_style=None, width=110)
    part = folder / f".{JOINTS_FILE}.part"
    try:
        part.write_text(text, encoding="utf-8")
        part.replace(folder / JOINTS_FILE)
    except OSError as error:
        raise ConfigError("FOLDER", str(folder), f"cannot be written: {error.strerror}") from None


# Keeps views of a calibration board from a cell that is up, while a person or a script moves the arm.

FIRST_PICTURE = 5.0  # [s] of wall time in which one comes


class NoImage(ZencellError):
    """Nobody sends pictures."""

    exit_code = 1


async def collect_views(
    bus: Bus, key: str, collector: HandEyeCollector, wanted: int, report: Callable[[str], None]
) -> None:
    """Hand joints and pictures to a collector until it has so many views.

    Args:
        bus: in the cell.
        key: of the camera's pictures.
        collector: decides which count.
        wanted: views.
        report: is called with what became of a picture, whenever that is not what it was before.

    Raises:
        NoImage: none comes.
    """
    pictures, joints = bus.reader(replace(topics.CAMERA_IMAGE, key=key)), bus.reader(topics.JOINT_STATES)

    async def take_note() -> None:
        async for state in joints:
            q = dict(zip(state.name, state.position, strict=True))
            if all(name in q for name in collector.joint_names):  # else it is of another robot
                collector.joints(state.header.stamp * 1e-9, np.array([q[name] for name in collector.joint_names]))

    noting, said = asyncio.create_task(take_note()), ""
    try:
        while collector.count < wanted:
            image = await _next_of(pictures, noting)
            why = await asyncio.to_thread(collector.look, image)
            line = why or f"view {collector.count} of {wanted}; {collector.hint}"
            if line != said:
                report(line)
            said = line
    finally:
        noting.cancel()


async def _next_of(pictures: Reader[Image], noting: asyncio.Task[None]) -> Image:
    """The next picture.

    Raises:
        NoImage: none comes.
    """
    coming = asyncio.ensure_future(pictures.next())
    done, _ = await asyncio.wait({coming, noting}, timeout=FIRST_PICTURE, return_when=asyncio.FIRST_COMPLETED)
    if coming in done:
        return coming.result()
    coming.cancel()
    if noting in done:
        noting.result()
    raise NoImage(f"no picture came for {FIRST_PICTURE:g} s: is a camera up, and its key right (--key)?")
