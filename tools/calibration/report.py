"""Report calibration results: text for people, and records in the camera file."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Any

from common.config.world import TCP
from common.perception.camera_file import CameraFile
from tools.calibration.camera_pose import PoseCalibration
from tools.calibration.hand_eye import HandEyeCalibration
from tools.calibration.intrinsics import IntrinsicCalibration, ViewResidual

_MAX_LISTED = 12  # views with listed residuals


def format_intrinsics(found: IntrinsicCalibration) -> str:
    """Text: intrinsics and distortion with uncertainties, and regions without corners."""
    lines = [
        f"{len(found.views)} views, {found.corners} corners, {100 * found.coverage:.0f} % of the image covered",
        f"residual {found.rms:.3f} px rms; {_per_view(found.views)}",
        *(f"{name} {value:8.2f} +- {std:.2f} px" for name, value, std in
          zip(("fx", "fy", "cx", "cy"), found.k, found.k_std, strict=True)),
        f"distortion {', '.join(f'{value:.4f}' for value in found.d) or 'none'}",
        *_dropped(found.dropped),
    ]
    if found.unseen:
        lines.append(f"no corners in these parts of the image: {', '.join(found.unseen)}; "
                     "add views with the board there to improve the distortion")
    return "\n".join(lines)


def format_pose(result: PoseCalibration) -> str:
    """Text: pose of a camera in world with uncertainties."""
    return "\n".join([
        f"{len(result.pictures)} images, residual {result.rms:.3f} px rms, "
        f"{1e3 * result.rms_on_board:.3f} mm on the board; {_per_view(result.pictures)}",
        *_pose_lines(result, ""),
        f"points on the board's plane +- {1e3 * result.place_std:.2f} mm at the worst point of the image",
        *_dropped(result.dropped),
    ])


def format_hand_eye(result: HandEyeCalibration) -> str:
    """Text: pose of a camera on the gripper, or fixed next to an arm that holds the board."""
    return "\n".join([
        f"{len(result.pictures)} views, residual {result.rms:.3f} px rms, {1e3 * result.rms_at_board:.2f} mm at the "
        f"board; {_per_view(result.pictures)}",
        *_pose_lines(result, f" in {'the tool center point' if result.mount == 'hand' else 'world'}"),
        *_dropped(result.dropped),
    ])


def _pose_lines(result: PoseCalibration | HandEyeCalibration, frame: str) -> list[str]:
    x, y, z = result.position
    roll, pitch, yaw = result.rpy
    return [f"position {x:.5f}, {y:.5f}, {z:.5f} m{frame} +- {1e3 * max(result.position_std):.2f} mm",
            f"rpy      {roll:.5f}, {pitch:.5f}, {yaw:.5f} rad +- {math.degrees(result.rotation_std):.3f} degrees"]


def _dropped(views: list[ViewResidual]) -> list[str]:
    return [f"dropped outliers: {_per_view(views)}"] if views else []


def _per_view(views: list[ViewResidual]) -> str:
    """Residuals of views [px] in order; if there are many, only the worst."""
    if len(views) <= _MAX_LISTED:
        return ", ".join(f"{view.name} {view.rms:.3f}" for view in views)
    worst = sorted(views, key=lambda view: -view.rms)[:_MAX_LISTED]
    return "worst: " + ", ".join(f"{view.name} {view.rms:.3f}" for view in worst)


# Records in the camera file

def camera_from_intrinsics(found: IntrinsicCalibration, source: str, board: str) -> CameraFile:
    """Return a camera with calibrated intrinsics; `source` and `board` describe the images."""
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
    """Return the camera with its pose in world, from boards at positions [m] with rpy [rad]."""
    places = [{"source": source, "board_position": list(position), "board_rpy": list(rpy)}
              for source, position, rpy in zip(sources, positions, angles, strict=True)]
    record = {"date": _today(), "places": places, "pictures": len(found.pictures), "rms_px": found.rms,
              "rms_mm": 1e3 * found.rms_on_board, **_deviations(found), "place_std_mm": 1e3 * found.place_std}
    return camera.model_copy(update={"mount": None, "position": found.position, "rpy": found.rpy,
                                     "calibration": {**camera.calibration, "pose": record}})


def with_hand_eye(camera: CameraFile, found: HandEyeCalibration, source: str, robot: str, mount: str) -> CameraFile:
    """Return the camera with its pose on the gripper, or in world if it is fixed."""
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
