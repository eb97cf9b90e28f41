"""Convert `Image` messages to arrays, arrays to messages, and messages to PNG files.

Follows sensor_msgs/Image: `step` is the length of a row in bytes and may exceed the pixels; 0 means no padding.
Inconsistent fields are rejected with an error.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from common.errors import ZencellError
from common.messages import Header, Image


class ImageError(ZencellError):
    """An image with inconsistent fields or an unknown encoding. `kind`: encoding, step, truncated, shape or dtype."""

    def __init__(self, kind: str, message: str) -> None:
        super().__init__(message)
        self.kind = kind


@dataclass(frozen=True)
class Encoding:
    """Storage of one pixel."""

    dtype: np.dtype[Any]
    channels: int

    @property
    def pixel_bytes(self) -> int:
        """Bytes of one pixel."""
        return self.dtype.itemsize * self.channels


ENCODINGS = {
    "bgr8": Encoding(np.dtype(np.uint8), 3),
    "rgb8": Encoding(np.dtype(np.uint8), 3),
    "mono8": Encoding(np.dtype(np.uint8), 1),
    "16UC1": Encoding(np.dtype(np.uint16), 1),
    "32FC1": Encoding(np.dtype(np.float32), 1),
}


def _encoding(name: str) -> Encoding:
    if name not in ENCODINGS:
        raise ImageError("encoding", f"encoding {name!r} is not known; choices: {', '.join(ENCODINGS)}")
    return ENCODINGS[name]


def image_to_array(image: Image) -> npt.NDArray[Any]:
    """Writable, contiguous copy of the pixels in native byte order.

    Returns:
        (height, width, 3) for bgr8 and rgb8, in that channel order; (height, width) for the others.

    Raises:
        ImageError: unknown encoding; a step shorter than a row or not a whole number of pixels; too few or many bytes.
    """
    encoding = _encoding(image.encoding)
    row = image.width * encoding.pixel_bytes
    step = image.step or row
    if step < row:
        raise ImageError("step", f"step {step} is shorter than a row of {image.width} {image.encoding} pixels ({row})")
    if step % encoding.pixel_bytes:
        raise ImageError(
            "step", f"step {step} is not a whole number of {image.encoding} pixels of {encoding.pixel_bytes} bytes"
        )
    needed = step * (image.height - 1) + row  # the last row may lack its padding
    if len(image.data) < needed:
        raise ImageError(
            "truncated",
            f"{len(image.data)} bytes are too few for {image.width}x{image.height} {image.encoding} "
            f"with step {step} ({needed})",
        )
    if len(image.data) > step * image.height:
        raise ImageError(
            "shape",
            f"{len(image.data)} bytes are more than {image.width}x{image.height} {image.encoding} "
            f"with step {step} has ({step * image.height})",
        )
    raw = np.frombuffer(image.data, np.uint8)
    rows = np.lib.stride_tricks.as_strided(raw, (image.height, row), (step, 1), writeable=False)
    pixels = np.array(rows, order="C").view(encoding.dtype.newbyteorder(">" if image.is_bigendian else "<"))
    native = pixels.astype(encoding.dtype, copy=False)
    return native.reshape(image.height, image.width, 3) if encoding.channels == 3 else native


def array_to_image(array: npt.NDArray[Any], encoding: str, header: Header | None = None) -> Image:
    """Unpadded little-endian image message of the pixels.

    Args:
        array: (height, width, 3) or (height, width), exactly of the encoding's type; any memory layout.
        encoding: bgr8, rgb8, mono8, 16UC1 or 32FC1.
        header: stamp and frame.

    Raises:
        ImageError: unknown encoding, wrong shape or type: nothing is converted implicitly.
    """
    expected = _encoding(encoding)
    dimensions = 3 if expected.channels == 3 else 2
    if array.ndim != dimensions or (dimensions == 3 and array.shape[2] != 3) or 0 in array.shape:
        form = "(height, width, 3)" if dimensions == 3 else "(height, width)"
        raise ImageError("shape", f"{encoding} needs an array of shape {form}, not {array.shape}")
    if array.dtype.newbyteorder("=") != expected.dtype:
        raise ImageError("dtype", f"{encoding} needs {expected.dtype} values, not {array.dtype}")
    little = np.ascontiguousarray(array, expected.dtype.newbyteorder("<"))
    height, width = array.shape[:2]
    return Image(
        header=header or Header(),
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=False,
        step=width * expected.pixel_bytes,
        data=little.tobytes(),
    )


# PNG files

MILLIMETRES = 1000.0


class ImageFileError(ZencellError):
    """An image message cannot be displayed, or its file cannot be written."""


def save_image(message: Any, path: Path) -> None:
    """Write an image message to a PNG file atomically; depth as uint16 [mm].

    Raises:
        ImageFileError: the message holds no displayable image, or the file cannot be written.
    """
    pixels = displayable(message)
    written, data = cv2.imencode(".png", pixels) if pixels is not None else (False, None)
    if not written or data is None:
        raise ImageFileError(f"{path}: the message holds no displayable image")
    part = path.with_name(f".{path.name}.part")
    try:
        part.write_bytes(data.tobytes())
        part.replace(path)
    except OSError as error:
        raise ImageFileError(f"{path}: cannot be written: {error.strerror}") from None


def displayable(message: Any) -> npt.NDArray[Any] | None:
    """Pixels that OpenCV can write: BGR, grey, or depth as uint16 [mm]; None for anything else."""
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
