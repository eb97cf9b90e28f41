"""The picture with what was found in it."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from applications.pick_place.detector import Detection

Picture = npt.NDArray[np.uint8]

WHOLE, PARTIAL = (0, 255, 0), (0, 200, 255)


def annotate(picture: Picture, detections: Sequence[Detection]) -> Picture:
    """A copy of the bgr8 picture with the outline, the centre and the place [m] of each detection."""
    shown = picture.copy()
    for d in detections:
        color = PARTIAL if d.partial else WHOLE
        points = np.rint(np.clip(d.outline, -4000, 20000) * 16).astype(np.int32)
        cv2.polylines(shown, [points], True, color, 1, cv2.LINE_AA, 4)
        u, v = (round(value) for value in d.pixel)
        cv2.drawMarker(shown, (u, v), color, cv2.MARKER_CROSS, 9, 1)
        label = f"{d.position[0]:.3f} {d.position[1]:+.3f}{' partial' if d.partial else ''}"
        cv2.putText(shown, label, (u - 40, v - 26), cv2.FONT_HERSHEY_SIMPLEX, 0.35, (0, 0, 0), 1, cv2.LINE_AA)
    return shown
