"""Views for a hand-eye calibration: select images taken at standstill and store them in a folder."""

from __future__ import annotations

import asyncio
import math
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from pathlib import Path

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
from common.perception.image_files import read_image
from common.robot.model import RobotModel
from common.transport.bus import Bus
from common.transport.reader import Reader
from tools.calibration.board import Board, NoBoard
from tools.calibration.camera_pose import detect_boards
from tools.calibration.hand_eye import HandEyeCalibration, Mount, View, calibrate_hand_eye
from tools.calibration.intrinsics import CalibrationFailed

Array = npt.NDArray[np.float64]
Pixels = npt.NDArray[np.uint8]

JOINTS_FILE = "joints.yaml"
REST_TIME = 0.4  # [s] of standstill before an image
STILL = 2e-4  # [rad] joint tolerance of standstill
NEW_TURN, NEW_PLACE = math.radians(8), 0.04  # [rad], [m]: either makes a new pose of the gripper
MAX_BLUR = 2.5  # [px] of edges
AXES = ("x", "y", "z")


class JointsFile(Parameters):
    """Joint positions of each image in the folder."""

    robot: str = Field(description="name of the robot file, or its path")
    joints: list[str] = Field(min_length=1, description="names of the joints, in the order of the positions")
    pictures: dict[str, list[Number]] = Field({}, description="joint positions [rad] by image name")


class HandEyeCollector:
    """Selects useful images from a stream of joints and images, and stores them in a folder."""

    def __init__(self, folder: Path, robot: RobotModel, name: str, board: Board) -> None:
        """Continue with the views in the folder.

        Raises:
            ConfigError: the folder belongs to another robot, or is not writable.
        """
        self._folder, self._robot, self._board = folder, robot, board
        file = folder / JOINTS_FILE
        self._file = JointsFile(robot=name, joints=robot.joint_names)
        if file.exists():
            self._file = _read(folder)
            if self._file.joints != robot.joint_names or _differ(self._file.robot, name):
                raise ConfigError("FOLDER", str(folder), f"contains views of another robot: {self._file.robot}")
            _require_joints(folder, self._file, robot)
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError("FOLDER", str(folder), f"cannot be created: {error.strerror}") from None
        self._poses = [robot.fk(q) for q in self._file.pictures.values()]
        self._recent: deque[tuple[float, Array]] = deque(maxlen=1000)

    @property
    def joint_names(self) -> list[str]:
        """Joint names in the order of positions."""
        return self._robot.joint_names

    @property
    def count(self) -> int:
        """Number of stored views."""
        return len(self._poses)

    def joints(self, stamp: float, q: Array) -> None:
        """Record joint positions (dof,) [rad] at a stamp [s]."""
        self._recent.append((stamp, q))

    def add(self, image: Image) -> str:
        """Store an image message if it is a useful view; return an empty string, or else the reason."""
        try:
            grey = image.encoding == "mono8"
            add_image = np.asarray(image_to_array(image), np.uint8) if grey else decode_color_image(image)
        except (ImageError, FrameError) as error:
            return str(error)
        return self.add_image(image.header.stamp * 1e-9, np.ascontiguousarray(add_image))

    def add_image(self, stamp: float, add_image: Pixels) -> str:
        """Store a bgr8 image of a stamp [s] if it is a useful view; return an empty string, or else the reason."""
        around = [q for at, q in self._recent if stamp - REST_TIME <= at <= stamp]
        if not around or self._recent[0][0] > stamp - REST_TIME:
            return "no joint state at the time of the image"
        if np.ptp(np.array(around), axis=0).max() > STILL:
            return "the arm moves"
        gripper = self._robot.fk(around[-1])
        if any(_near(gripper, other) for other in self._poses):
            return "the gripper was in this pose before"
        detection = self._board.find(add_image, "")
        if isinstance(detection, NoBoard):
            return detection.reason
        if detection.blur > MAX_BLUR:
            return f"edges are blurred over {detection.blur:.1f} px"
        names = (f"view_{number:03d}.png" for number in count(self.count))  # earlier names may be missing
        name = next(name for name in names if name not in self._file.pictures)
        if not cv2.imwrite(str(self._folder / name), add_image):
            raise ConfigError("FOLDER", str(self._folder), "cannot be written")
        q = [round(float(value), 9) for value in around[-1]]
        contents = self._file.model_copy(update={"pictures": {**self._file.pictures, name: q}})
        _write(self._folder, contents)
        self._file = contents
        self._poses.append(gripper)
        return ""

    @property
    def rotation_ranges(self) -> Array:
        """(3,) [rad] rotation range of the gripper about each of its axes over all views."""
        if not self._poses:
            return np.zeros(3)
        first = self._poses[0][:3, :3]
        rotation_ranges = np.array([cv2.Rodrigues(first.T @ gripper[:3, :3])[0].ravel() for gripper in self._poses])
        return np.asarray(np.ptp(rotation_ranges, axis=0))

    @property
    def hint(self) -> str:
        """Advice for the next view."""
        if len(self._poses) < 2:
            return "tilt the gripper in another direction"
        return f"rotate the gripper further about its {AXES[int(np.argmin(self.rotation_ranges))]} axis"


def load_views(
    folder: Path, board: Board, camera: CameraFile, moved: RobotModel | None = None
) -> tuple[list[View], list[str], JointsFile]:
    """Load the views of a folder, the reason for each image without the board, and the joints file.

    Args:
        folder: with the views.
        board: to detect.
        camera: intrinsics.
        moved: robot model; default: the robot that the folder names.

    Raises:
        ConfigError: there are no views, or they do not match the robot.
    """
    contents = _read(folder)
    robot = moved or RobotModel.load(load_robot(contents.robot))
    if contents.joints != robot.joint_names:
        raise ConfigError(f"{folder / JOINTS_FILE}: joints", contents.joints, f"are not those of {contents.robot}")
    _require_joints(folder, contents, robot)
    views, reason = [], []
    for name, q in contents.pictures.items():
        try:
            add_image = read_image(folder / Path(name).name, f"{folder / JOINTS_FILE}: {name}")
        except ConfigError as error:
            reason.append(f"skipped: {error}")
            continue
        found, reasons = detect_boards(board, [(name, add_image)], camera, MAX_BLUR)
        reason += [f"{name}: {reason}" for reason in reasons]
        views += [View(detection, robot.fk(q), np.array(q)) for detection in found]
    return views, reason, contents


def calibrate_views(views: list[View], robot: RobotModel, camera: CameraFile, mount: Mount) -> HandEyeCalibration:
    """Fit the pose of the camera to the views.

    Raises:
        CalibrationFailed: the views do not determine it; names joints that are in degrees.
    """
    try:
        return calibrate_hand_eye(views, camera, mount)
    except CalibrationFailed as failure:
        converted = [replace(view, T_world_tcp=robot.fk(np.radians(view.q))) for view in views]
        try:
            rms = calibrate_hand_eye(converted, camera, mount).rms
        except CalibrationFailed:
            raise failure from None
        raise CalibrationFailed(f"the joints are in degrees: converted to rad, the residual is {rms:.2f} px; "
                                f"write them in rad to {JOINTS_FILE}") from None


def _near(a: Array, b: Array) -> bool:
    turn = float(np.linalg.norm(cv2.Rodrigues(a[:3, :3].T @ b[:3, :3])[0]))
    return turn < NEW_TURN and float(np.linalg.norm(a[:3, 3] - b[:3, 3])) < NEW_PLACE


def _read(folder: Path) -> JointsFile:
    return check(JointsFile, read_yaml(folder / JOINTS_FILE), str(folder / JOINTS_FILE))


def _differ(robot: str, other: str) -> bool:
    """Whether two robot names differ, although their joints may have equal names; paths are not compared."""
    return robot != other and not any(name.endswith((".yaml", ".yml")) for name in (robot, other))


def _require_joints(folder: Path, contents: JointsFile, robot: RobotModel) -> None:
    """Check that each image has as many joint positions as the robot has joints.

    Raises:
        ConfigError: one has not.
    """
    for name, q in contents.pictures.items():
        if len(q) != robot.dof:
            raise ConfigError(f"{folder / JOINTS_FILE}: {name}", q, f"must be {robot.dof} joints")


def _write(folder: Path, contents: JointsFile) -> None:
    """Write the file atomically; without it no image is a view.

    Raises:
        ConfigError: it cannot be written.
    """
    import yaml

    text = yaml.safe_dump(contents.model_dump(), sort_keys=False, default_flow_style=None, width=110)
    part = folder / f".{JOINTS_FILE}.part"
    try:
        part.write_text(text, encoding="utf-8")
        part.replace(folder / JOINTS_FILE)
    except OSError as error:
        raise ConfigError("FOLDER", str(folder), f"cannot be written: {error.strerror}") from None


# Collecting from a running cell, while an operator or a script moves the arm

IMAGE_TIMEOUT = 5.0  # [s] of wall time


class NoImage(ZencellError):
    """The camera publishes no images."""

    exit_code = 1


async def collect_views(
    bus: Bus, key: str, collector: HandEyeCollector, wanted: int, report: Callable[[str], None]
) -> None:
    """Pass joints and images to a collector until it has the wanted number of views.

    Args:
        bus: in the cell.
        key: of the camera's images.
        collector: selects views.
        wanted: number of views.
        report: called with the outcome of an image whenever it changes.

    Raises:
        NoImage: no image arrives.
    """
    pictures, joints = bus.reader(replace(topics.CAMERA_IMAGE, key=key)), bus.reader(topics.JOINT_STATES)

    async def record_joints() -> None:
        async for state in joints:
            q = dict(zip(state.name, state.position, strict=True))
            if all(name in q for name in collector.joint_names):  # else it belongs to another robot
                collector.joints(state.header.stamp * 1e-9, np.array([q[name] for name in collector.joint_names]))

    recording, contents = asyncio.create_task(record_joints()), ""
    try:
        while collector.count < wanted:
            image = await _next_of(pictures, recording)
            reason = await asyncio.to_thread(collector.add, image)
            line = reason or f"view {collector.count} of {wanted}; {collector.hint}"
            if line != contents:
                report(line)
            contents = line
    finally:
        recording.cancel()


async def _next_of(pictures: Reader[Image], recording: asyncio.Task[None]) -> Image:
    """Wait for the next image.

    Raises:
        NoImage: none arrives.
    """
    coming = asyncio.ensure_future(pictures.next())
    done, _ = await asyncio.wait({coming, recording}, timeout=IMAGE_TIMEOUT, return_when=asyncio.FIRST_COMPLETED)
    if coming in done:
        return coming.result()
    coming.cancel()
    if recording in done:
        recording.result()
    raise NoImage(f"no image received for {IMAGE_TIMEOUT:g} s: check that the camera runs, and its key (--key)")
