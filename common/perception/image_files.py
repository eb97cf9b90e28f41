"""Image messages as PNG files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from common.errors import ZencellError
from common.messages import Image
from common.perception.image import ImageError, image_to_array

MILLIMETRES = 1000.0


class ImageFileError(ZencellError):
    """An image message cannot be shown, or its file cannot be written."""


def save_picture(message: Any, path: Path) -> None:
    """Write an image message to a PNG file, atomically; depth as uint16 [mm].

    Raises:
        ImageFileError: the message holds no displayable image, or the file cannot be written.
    """
    pixels = displayable(message)
    written, data = cv2.imencode(".png", pixels) if pixels is not None else (False, None)
    if not written or data is None:
        raise ImageFileError(f"{path}: the message holds no image that can be written")
    part = path.with_name(f".{path.name}.part")
    try:
        part.write_bytes(data.tobytes())
        part.replace(path)
    except OSError as error:
        raise ImageFileError(f"{path}: cannot be written: {error.strerror}") from None


def displayable(message: Any) -> npt.NDArray[Any] | None:
    """Return what OpenCV can write: BGR, grey, or depth as uint16 [mm]; None for anything else."""
    if not isinstance(message, Image):
        return None
    try:
        pixels = image_to_array(message)
    except (ImageError, ValueError, MemoryError):
        return None
    if not pixels.size:
        return None
    if message.encoding == "rgb8":
        return np.ascontiguousarray(pixels[:, :, ::-1])
    if message.encoding == "32FC1":
        return np.clip(np.nan_to_num(pixels * MILLIMETRES), 0, 65535).astype(np.uint16)
    return pixels
