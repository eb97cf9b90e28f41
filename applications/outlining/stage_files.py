"""Files between the stages, under the names of the original system.

    camera_image.png                             color image
    depth_data.npy                               depth along the optical axis [m], float32, NaN where unknown
    depth_camera_image.png                       the same in millimeters, 16 bit, 0 where unknown: for viewing
    depth_camera_image_normalized.png            the same from black (far) to white (near): for viewing
    relevant_contours_pixels.json                [[u, v], ...] pixels of the selected contour
    relevant_contours_coordinates.json           [[x, y, z], ...] [m] in world
    relevant_contours_cleared_coordinates.json   the same without duplicates: the path to trace
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from common.errors import ConfigError, ZencellError
from common.perception.depth import Depth, is_valid
from common.perception.image_files import read_array, read_image

Array = npt.NDArray[np.float64]
Picture = npt.NDArray[np.uint8]

PICTURE = "camera_image.png"
DEPTH = "depth_data.npy"
DEPTH_PICTURE = "depth_camera_image.png"
NORMALIZED = "depth_camera_image_normalized.png"
PIXELS = "relevant_contours_pixels.json"
COORDINATES = "relevant_contours_coordinates.json"
CLEARED = "relevant_contours_cleared_coordinates.json"
MAX_TEXT = 2**24  # [bytes] of a JSON file: 400,000 points


class StageFileError(ZencellError):
    """A stage file cannot be used; names the file and the problem."""

    def __init__(self, path: Path, message: str) -> None:
        super().__init__(f"{path}: {message}")
        self.path = path


def write_pictures(folder: Path, picture: Picture, depth: Depth) -> None:
    """Write the bgr8 image and the depth image (height, width) [m] into a folder, which is created if missing.

    Raises:
        StageFileError: a file cannot be written.
    """
    known = is_valid(depth)
    metres = np.where(known, depth, 0.0)
    millimetres = np.rint(np.clip(metres * 1000, 0, 65535)).astype(np.uint16)
    near, far = (float(metres[known].min()), float(metres[known].max())) if known.any() else (0.0, 1.0)
    scaled = np.where(known, np.rint(55 + 200 * (far - metres) / max(far - near, 1e-6)), 0.0)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        np.save(folder / DEPTH, depth.astype(np.float32))
        for name, image in ((PICTURE, picture), (DEPTH_PICTURE, millimetres), (NORMALIZED, scaled.astype(np.uint8))):
            coded, data = cv2.imencode(".png", image)
            if not coded:
                raise StageFileError(folder / name, "cannot be coded as PNG")
            (folder / name).write_bytes(data.tobytes())
    except OSError as error:
        raise StageFileError(folder, f"cannot be written: {error.strerror or error}") from None


def write_points(path: Path, points: npt.ArrayLike) -> None:
    """Write pixels (n, 2) or points (n, 3) as a list of lists, one per line; integral pixels without a decimal point.

    Raises:
        StageFileError: the file cannot be written.
    """
    rows = [[int(value) if float(value).is_integer() and path.name == PIXELS else round(float(value), 9)
             for value in row] for row in np.asarray(points, dtype=float)]
    text = "[\n" + ",\n".join(f"  {json.dumps(row)}" for row in rows) + "\n]\n"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise StageFileError(path, f"cannot be written: {error.strerror or error}") from None


def read_pictures(folder: Path) -> tuple[Picture, Depth]:
    """Return the bgr8 image and the depth image [m] of a folder.

    Raises:
        StageFileError: one is missing or malformed, their sizes differ, or the depth image has no valid depth.
    """
    picture, depth = read_picture(folder / PICTURE), read_depth(folder / DEPTH)
    if picture.shape[:2] != depth.shape:
        sizes = [f"{shape[1]}x{shape[0]}" for shape in (depth.shape, picture.shape)]
        raise StageFileError(folder / DEPTH, f"is {sizes[0]}, but {PICTURE} is {sizes[1]}")
    return picture, depth


def read_picture(path: Path) -> Picture:
    """Return a bgr8 image (height, width, 3).

    Raises:
        StageFileError: it is missing or no image.
    """
    if not path.is_file():
        raise StageFileError(path, "is missing")
    try:
        return read_image(path)
    except ConfigError as error:
        raise StageFileError(path, error.expected) from None


def read_depth(path: Path) -> Depth:
    """Return a depth image (height, width) [m], float32.

    Raises:
        StageFileError: it is missing, is no such array of numbers, or has no valid depth.
    """
    if not path.is_file():
        raise StageFileError(path, "is missing")
    try:
        depth = read_array(path)
    except ConfigError as error:
        raise StageFileError(path, error.expected) from None
    if not isinstance(depth, np.ndarray) or depth.ndim != 2 or depth.dtype.kind not in "fiu" or 0 in depth.shape:
        form = f"{depth.dtype} of shape {depth.shape}" if isinstance(depth, np.ndarray) else "an archive"
        raise StageFileError(path, f"must be an array (height, width) of depths in metres, not {form}")
    metres = depth.astype(np.float32)
    if not is_valid(metres).any():
        raise StageFileError(path, "has no valid depth at all: every value is NaN, infinite or not positive")
    return metres


def read_pixels(path: Path) -> Array:
    """Return the pixels (n, 2) of the selected contour.

    Raises:
        StageFileError: the file is missing or malformed.
    """
    return _read_points(path, 2, "[u, v]")


def read_coordinates(path: Path) -> Array:
    """Return the points (n, 3) [m] of an outline.

    Raises:
        StageFileError: the file is missing or malformed; names the entry.
    """
    return _read_points(path, 3, "[x, y, z]")


def _read_points(path: Path, size: int, form: str) -> Array:
    try:
        loaded: Any = json.loads(_bytes(path))
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise StageFileError(path, f"is not valid JSON: {_one_line(error)}") from None
    if not isinstance(loaded, list) or len(loaded) < 3:
        count = f"{len(loaded)} entries" if isinstance(loaded, list) else type(loaded).__name__
        raise StageFileError(path, f"must be a list of at least 3 points {form}, not {count}")
    for number, point in enumerate(loaded):
        good = isinstance(point, list) and len(point) == size and all(_is_number(value) for value in point)
        if not good:
            raise StageFileError(path, f"entry {number} must be {form} of finite numbers, not {_short(point)}")
    return np.array(loaded, dtype=float)


def _bytes(path: Path) -> bytes:
    if not path.is_file():
        raise StageFileError(path, "is missing")
    try:
        if path.stat().st_size > MAX_TEXT:
            raise StageFileError(path, f"has {path.stat().st_size:,} bytes; at most {MAX_TEXT:,} are read")
        return path.read_bytes()
    except OSError as error:
        raise StageFileError(path, f"cannot be read: {error.strerror or error}") from None


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e9 and math.isfinite(value)


def _short(value: object) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _one_line(error: Exception) -> str:
    return (str(error).splitlines() or ["empty"])[0]
