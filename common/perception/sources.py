"""Where real pictures come from: a camera device, a video file or a folder of images. All calls may block."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import Field

from common.config import CameraConfig, Number, Parameters, check, read_yaml
from common.errors import ConfigError

Picture = npt.NDArray[np.uint8]

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")


class Intrinsics(Parameters):
    """Calibration of a camera, as a YAML file holds it."""

    width: int = Field(ge=16, le=16384, description="[px]")
    height: int = Field(ge=16, le=16384, description="[px]")
    fx: float = Field(gt=1, le=1e5, description="focal length [px]")
    fy: float = Field(gt=1, le=1e5, description="focal length [px]")
    cx: float = Field(ge=0, le=16384, description="principal point [px]")
    cy: float = Field(ge=0, le=16384, description="principal point [px]")
    d: list[Number] = Field([], max_length=8, description="distortion k1, k2, p1, p2, k3, ... as OpenCV's plumb bob")

    @classmethod
    def load(cls, path: str, camera: CameraConfig) -> Intrinsics:
        """Those of a file, or those of the world's camera when there is no path.

        Raises:
            ConfigError: the file can not be read, or names the field that does not fit.
        """
        if not path:
            return cls(**camera.model_dump(include={"width", "height", "fx", "fy", "cx", "cy"}))
        return check(cls, read_yaml(Path(path).expanduser()), path)


class Rectifier:
    """Takes the distortion of the lens out of pictures, so that everybody after it can compute with a pinhole."""

    def __init__(self, intrinsics: Intrinsics) -> None:
        """Compute the maps once."""
        i = intrinsics
        self._intrinsics = i
        self._maps: tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]] | None = None
        if any(i.d):
            k = np.array([[i.fx, 0, i.cx], [0, i.fy, i.cy], [0, 0, 1.0]])
            d = np.array(i.d + [0.0] * ((4 if len(i.d) <= 4 else 5 if len(i.d) == 5 else 8) - len(i.d)))
            first, second = cv2.initUndistortRectifyMap(k, d, np.eye(3), k, (i.width, i.height), cv2.CV_32FC1)
            self._maps = np.asarray(first, np.float32), np.asarray(second, np.float32)

    def __call__(self, picture: Picture, source: str) -> Picture:
        """The bgr8 picture without distortion.

        Raises:
            ConfigError: it has another size than the intrinsics are for.
        """
        i = self._intrinsics
        height, width = picture.shape[:2]
        if (width, height) != (i.width, i.height):
            raise ConfigError(
                "intrinsics", f"{i.width}x{i.height}", f"do not fit {source}, whose pictures are {width}x{height}"
            )
        if self._maps is None:
            return picture
        return np.asarray(cv2.remap(picture, *self._maps, cv2.INTER_LINEAR), np.uint8)


class Source(Protocol):
    """Something that pictures are read from."""

    live: bool  # a device has its own pace and may vanish; files are read at the pace of the reader

    def read(self) -> Picture | None:
        """The next bgr8 picture (height, width, 3); None when there is none: the end, or the device is gone."""

    def close(self) -> None:
        """Let go of it."""


class Video:
    """A camera device or a video file."""

    def __init__(self, capture: cv2.VideoCapture, *, live: bool, loop: bool) -> None:
        """Take over an open capture; `loop` begins a file again at its end."""
        self.live = live
        self._capture = capture
        self._loop = loop

    def read(self) -> Picture | None:
        """The next picture; None at the end."""
        good, picture = self._capture.read()
        if not good and self._loop and self._capture.set(cv2.CAP_PROP_POS_FRAMES, 0):
            good, picture = self._capture.read()
        return _as_bgr8(picture) if good and picture is not None else None

    def close(self) -> None:
        """Release the device or file."""
        self._capture.release()


class Folder:
    """The images of a folder in the order of their names, numbers within them counted as such."""

    live = False

    def __init__(self, paths: list[Path], *, loop: bool) -> None:
        """Read these, once or over and over."""
        self._paths = paths
        self._loop = loop
        self._next = 0

    def read(self) -> Picture | None:
        """The next picture; None at the end.

        Raises:
            ConfigError: a file is no image.
        """
        if self._next >= len(self._paths):
            if not self._loop:
                return None
            self._next = 0
        path = self._paths[self._next]
        self._next += 1
        picture = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_COLOR)
        if picture is None:
            raise ConfigError("source", str(path), "is no image that can be read")
        return _as_bgr8(picture)

    def close(self) -> None:
        """Nothing is open between reads."""


def open_source(source: str | int, intrinsics: Intrinsics, rate: float, *, loop: bool) -> Source | None:
    """The source that a device number or path, a video file or an image folder stands for; None: device not there.

    Raises:
        ConfigError: a path that is nothing of these.
    """
    number = int(source) if str(source).isdigit() else None
    device = number is not None or str(source).startswith("/dev/")
    if device:
        capture = cv2.VideoCapture(number) if number is not None else cv2.VideoCapture(str(source))
        if not capture.isOpened():
            capture.release()
            return None
        for name, value in (
            (cv2.CAP_PROP_FRAME_WIDTH, intrinsics.width), (cv2.CAP_PROP_FRAME_HEIGHT, intrinsics.height),
            (cv2.CAP_PROP_FPS, rate), (cv2.CAP_PROP_BUFFERSIZE, 1),
        ):
            capture.set(name, value)
        return Video(capture, live=True, loop=False)
    path = Path(str(source)).expanduser()
    if path.is_dir():
        images = sorted((p for p in path.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES), key=_natural)
        if not images:
            raise ConfigError("source", str(source), f"holds no image; looked for {', '.join(IMAGE_SUFFIXES)}")
        return Folder(images, loop=loop)
    if not path.is_file():
        raise ConfigError("source", str(source), "is no device number, /dev path, video file or image folder")
    capture = cv2.VideoCapture(str(path))
    if not capture.isOpened():
        capture.release()
        raise ConfigError("source", str(source), "is no video that can be read")
    return Video(capture, live=False, loop=loop)


def _natural(path: Path) -> list[tuple[int, str]]:
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", path.name)]


def _as_bgr8(picture: npt.NDArray[Any]) -> Picture:
    if picture.ndim == 2 or picture.shape[2] == 1:
        return np.asarray(cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR), np.uint8)
    return np.ascontiguousarray(picture[..., :3], np.uint8)
