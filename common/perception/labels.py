"""Labels in images: readable on any background, and none over another."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import islice

import cv2
import numpy as np
import numpy.typing as npt

WIDTH = 640  # [px] at which an image is usually displayed: labels of a larger one are larger
MAX_LABELS = 50  # of a noisy image
SCALE, MARGIN = 0.45, 3  # of the font and [px] around the text, at this width


def draw_labels(image: npt.NDArray[np.uint8], labels: Iterable[tuple[str, float, float, float]]) -> None:
    """Draw labels into an image, in place; each as near to its object as the labels before it leave space.

    Args:
        image: (height, width, 3) bgr8.
        labels: text, center u, v [px] and half of the height of each object [px].
    """
    height, width = image.shape[:2]
    factor = max(1.0, width / WIDTH)
    scale, margin, weight = SCALE * factor, round(MARGIN * factor), max(1, round(factor))
    used: list[tuple[int, int, int, int]] = []
    for text, u, v, half in islice(labels, MAX_LABELS):
        (w, h), base = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, weight)
        w, h = w + 2 * margin, h + base + 2 * margin
        x = int(np.clip(u - w / 2, 0, max(0, width - w)))
        rows = [sign * (half + h * (row + 0.5)) for row in range(height // h + 1) for sign in (-1, 1)]
        places = [int(v + each - h / 2) for each in rows if 0 <= v + each - h / 2 <= height - h]
        y = next((y for y in places if not any(
            x < right and left < x + w and y < bottom and top < y + h for left, top, right, bottom in used)), None)
        if y is None:
            continue
        used.append((x, y, x + w, y + h))
        cv2.rectangle(image, (x, y), (x + w, y + h), (32, 32, 32), cv2.FILLED)
        cv2.putText(image, text, (x + margin, y + h - base - margin), cv2.FONT_HERSHEY_SIMPLEX, scale, (255, 255, 255),
                    weight, cv2.LINE_AA)
