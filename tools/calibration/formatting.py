"""What a calibration found, in lines for people."""

from __future__ import annotations

import math

from tools.calibration.calibration import IntrinsicCalibration, ViewResidual
from tools.calibration.camera_pose import PoseCalibration
from tools.calibration.hand_eye import HandEyeCalibration

_MOST_LISTED = 12  # views of which the residuals are shown


def intrinsics_told(found: IntrinsicCalibration) -> str:
    """Focal lengths, centre and distortion, how well they are known, and where nothing was seen."""
    lines = [
        f"{len(found.views)} views, {found.corners} corners, {100 * found.coverage:.0f} % of the picture covered",
        f"residual {found.rms:.3f} px rms; {_per_view(found.views)}",
        *(f"{name} {value:8.2f} +- {std:.2f} px" for name, value, std in
          zip(("fx", "fy", "cx", "cy"), found.k, found.k_std, strict=True)),
        f"distortion {', '.join(f'{value:.4f}' for value in found.d) or 'none'}",
        *_dropped(found.dropped),
    ]
    if found.unseen:
        lines.append(f"no corner was seen in these parts of the picture: {', '.join(found.unseen)}; "
                     "views with the board there make the distortion better")
    return "\n".join(lines)


def pose_told(result: PoseCalibration) -> str:
    """Where a camera is in world, and how well that is known."""
    return "\n".join([
        f"{len(result.pictures)} pictures, residual {result.rms:.3f} px rms, "
        f"{1e3 * result.rms_on_board:.3f} mm on the board; {_per_view(result.pictures)}",
        *_placed(result, ""),
        f"places on the board's plane +- {1e3 * result.place_std:.2f} mm where it is worst in the picture",
        *_dropped(result.dropped),
    ])


def hand_eye_told(result: HandEyeCalibration) -> str:
    """Where a camera is on the hand, or beside an arm that holds the board."""
    return "\n".join([
        f"{len(result.pictures)} views, residual {result.rms:.3f} px rms, {1e3 * result.rms_at_board:.2f} mm at the "
        f"board; {_per_view(result.pictures)}",
        *_placed(result, f" in {'the tool centre point' if result.mount == 'hand' else 'world'}"),
        *_dropped(result.dropped),
    ])


def _placed(result: PoseCalibration | HandEyeCalibration, frame: str) -> list[str]:
    x, y, z = result.position
    roll, pitch, yaw = result.rpy
    return [f"position {x:.5f}, {y:.5f}, {z:.5f} m{frame} +- {1e3 * max(result.position_std):.2f} mm",
            f"rpy      {roll:.5f}, {pitch:.5f}, {yaw:.5f} rad +- {math.degrees(result.rotation_std):.3f} degrees"]


def _dropped(views: list[ViewResidual]) -> list[str]:
    return [f"dropped, since they do not fit: {_per_view(views)}"] if views else []


def _per_view(views: list[ViewResidual]) -> str:
    """Residuals of views [px], in their order; of many only the worst."""
    if len(views) <= _MOST_LISTED:
        return ", ".join(f"{view.name} {view.rms:.3f}" for view in views)
    worst = sorted(views, key=lambda view: -view.rms)[:_MOST_LISTED]
    return "worst: " + ", ".join(f"{view.name} {view.rms:.3f}" for view in worst)
