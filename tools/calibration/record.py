"""A camera file with what was found, and with how: so that it can be judged later."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Any

from common.config.world import TCP
from common.perception.camera_file import CameraFile
from tools.calibration.calibration import IntrinsicCalibration
from tools.calibration.camera_pose import PoseCalibration
from tools.calibration.hand_eye import HandEyeCalibration


def camera_of(found: IntrinsicCalibration, source: str, board: str) -> CameraFile:
    """A camera whose intrinsics were found with pictures of a source, of a board that words describe."""
    names = ("fx", "fy", "cx", "cy")
    camera = CameraFile(width=found.size[0], height=found.size[1], d=found.d, **dict(zip(names, found.k, strict=True)))
    record = {"date": _today(), "source": source, "board": board, "distortion_model": camera.distortion_model,
              "views": len(found.views), "corners": found.corners, "rms_px": found.rms,
              "std_px": dict(zip(names, found.k_std, strict=True)), "coverage": found.coverage}
    return camera.model_copy(update={"calibration": {"intrinsics": record}})


def with_pose(
    camera: CameraFile, found: PoseCalibration, sources: Sequence[str], positions: Sequence[Sequence[float]],
    angles: Sequence[Sequence[float]],
) -> CameraFile:
    """The camera with its pose in world, from pictures of boards that lay at positions [m], turned by rpy [rad]."""
    places = [{"source": source, "board_position": list(position), "board_rpy": list(rpy)}
              for source, position, rpy in zip(sources, positions, angles, strict=True)]
    record = {"date": _today(), "places": places, "pictures": len(found.pictures), "rms_px": found.rms,
              "rms_mm": 1e3 * found.rms_on_board, **_deviations(found), "place_std_mm": 1e3 * found.place_std}
    return camera.model_copy(update={"mount": None, "position": found.position, "rpy": found.rpy,
                                     "calibration": {**camera.calibration, "pose": record}})


def with_hand_eye(camera: CameraFile, found: HandEyeCalibration, source: str, robot: str, mount: str) -> CameraFile:
    """The camera with where it sits on the hand, or with its pose in world, beside the arm."""
    record: dict[str, Any] = {
        "date": _today(), "source": source, "robot": robot, "camera": mount, "views": len(found.pictures),
        "rms_px": found.rms, "rms_mm": 1e3 * found.rms_at_board, "verdict": found.verdict, **_deviations(found)}
    place = {"mount": TCP if mount == "hand" else None, "position": found.position, "rpy": found.rpy}
    return camera.model_copy(update={**place, "calibration": {**camera.calibration, "hand_eye": record}})


def _deviations(found: PoseCalibration | HandEyeCalibration) -> dict[str, Any]:
    return {"position_std_mm": [1e3 * value for value in found.position_std],
            "rotation_std_deg": math.degrees(found.rotation_std)}


def _today() -> str:
    return time.strftime("%Y-%m-%d %H:%M:%S")
