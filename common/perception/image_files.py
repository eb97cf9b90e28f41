"""Read image and array files of unknown origin: the size that a header claims is checked before anything is decoded."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from common.errors import ConfigError

MAX_PIXELS = 89_478_485  # of an image or array: Pillow's limit, 256 MiB at 3 bytes per pixel
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
_FORMATS = ("PNG", "JPEG", "BMP", "TIFF", "WEBP")
_PIXEL_BYTES = 16  # that a file may have per pixel: RGBA of 32 bit
_METADATA = 2**24  # [bytes] that a file may have in addition


def read_image(
    path: Path, field: str = "source", report: Callable[[str], object] = lambda _: None
) -> npt.NDArray[np.uint8]:
    """Return the bgr8 pixels (height, width, 3) of an image file.

    16 bits, of which often 10 or 12 are used, are stretched to 8; `report` gets a text about it.

    Raises:
        ConfigError: it is no readable image, or larger than `MAX_PIXELS`; names the field and the file.
    """
    from PIL import Image, UnidentifiedImageError  # opens a file without decoding it, which OpenCV cannot

    image = None
    try:
        if not path.is_file():
            raise ConfigError(field, str(path), "is not a file")
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(path, formats=_FORMATS) as header:
                width, height = header.size
        _require_file_size(field, path, width * height)
        data = np.frombuffer(path.read_bytes(), np.uint8)
        level = cv2.utils.logging.setLogLevel(0)  # otherwise OpenCV writes to stderr, too
        try:
            image = cv2.imdecode(data, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
        finally:
            cv2.utils.logging.setLogLevel(level)
        if image is not None and image.dtype == np.uint16:
            image = _stretched(image, report)
    except (Image.DecompressionBombWarning, Image.DecompressionBombError):
        raise ConfigError(field, str(path), f"has too many pixels; at most {MAX_PIXELS:,} are read") from None
    except OSError as error:
        if not isinstance(error, UnidentifiedImageError) and error.strerror:
            raise ConfigError(field, str(path), f"cannot be read: {error.strerror}") from None
    except (cv2.error, ValueError, SyntaxError, EOFError):
        pass
    if image is None or image.dtype != np.uint8:
        raise ConfigError(field, str(path), "is not a readable image")
    return np.asarray(image, np.uint8)


def _stretched(image: npt.NDArray[Any], report: Callable[[str], object]) -> npt.NDArray[np.uint8]:
    bits = max(8, int(image.max(initial=0)).bit_length())
    if bits < 16:
        report(f"has {bits} bits per value, which are stretched to 8")
    return np.asarray(np.rint(image * (255 / (2**bits - 1))), np.uint8)


def read_array(path: Path, field: str = "source") -> Any:
    """Return the array of a .npy file, mapped into memory, or the archive of an .npz file.

    Raises:
        ConfigError: it is no such file, shorter than its header says, or larger than `MAX_PIXELS`.
    """
    try:
        _require_file_size(field, path, MAX_PIXELS)
        with np.errstate(over="raise"):  # numpy multiplies the sides
            return np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError, SyntaxError, ArithmeticError, MemoryError) as error:
        reason = (str(error).splitlines() or ["empty"])[0]
        raise ConfigError(field, str(path), f"is no array that numpy can read: {reason}") from None


def _require_file_size(field: str, path: Path, pixels: int) -> None:
    size, limit = path.stat().st_size, _PIXEL_BYTES * pixels + _METADATA
    if size > limit:
        raise ConfigError(field, str(path), f"has {size:,} bytes; at most {limit:,} are read")
