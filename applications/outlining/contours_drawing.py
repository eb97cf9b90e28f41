"""The picture with its contours, each with its label."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from applications.outlining.contours import is_hole
from applications.outlining.messages import Contour

Picture = npt.NDArray[np.uint8]

OBJECT, HOLE, BORDER, CHOSEN = (0, 140, 255), (255, 160, 0), (128, 128, 128), (255, 0, 255)  # bgr


def annotate_contours(picture: Picture, contours: Sequence[Contour], selected: int = -1) -> Picture:
    """A copy of the bgr8 picture with all contours and their labels; the selected one stands out."""
    shown = picture.copy()
    for contour in contours:
        color = HOLE if is_hole(contours, contour.index) else BORDER if contour.touches_border else OBJECT
        if contour.index == selected:
            color = CHOSEN
        points = np.array(contour.pixels)
        fixed = np.rint(points * 16).astype(np.int32)
        cv2.polylines(shown, [fixed], True, color, 3 if contour.index == selected else 2, cv2.LINE_AA, 4)
        _label(shown, contour.label, points, color)
    return shown


def _label(shown: Picture, text: str, points: npt.NDArray[np.float64], color: tuple[int, int, int]) -> None:
    font, scale = cv2.FONT_HERSHEY_SIMPLEX, 0.6
    (width, height), _ = cv2.getTextSize(text, font, scale, 1)
    u, v = points.mean(axis=0)
    x = round(min(max(u - width / 2, 2), shown.shape[1] - width - 2))
    y = round(min(max(v + height / 2, height + 2), shown.shape[0] - 4))
    cv2.putText(shown, text, (x, y), font, scale, (0, 0, 0), 4, cv2.LINE_AA)
    cv2.putText(shown, text, (x, y), font, scale, color, 1, cv2.LINE_AA)
