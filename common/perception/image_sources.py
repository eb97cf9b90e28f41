"""Where real pictures come from: a camera device, a video file or a folder of images. All calls may block."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
import numpy.typing as npt

from common.errors import ConfigError
from common.sources import monotonic

Picture = npt.NDArray[np.uint8]

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")


class Source(Protocol):
    """Something that pictures are read from."""

    live: bool  # a device has its own pace and may vanish; files are read at the pace of the reader
    name: str  # of the picture that was read last

    def read(self) -> Picture | None:
        """The next bgr8 picture (height, width, 3); None when there is none: the end, or the device is gone."""

    def close(self) -> None:
        """Let go of it."""


class Video:
    """A camera device or a video file."""

    def __init__(self, capture: cv2.VideoCapture, *, live: bool, loop: bool) -> None:
        """Take over an open capture; `loop` begins a file again at its end."""
        self.live = live
        self.name = ""
        self._count = 0
        self._capture = capture
        self._loop = loop

    def read(self) -> Picture | None:
        """The next picture; None at the end."""
        good, picture = self._capture.read()
        if not good and self._loop and self._capture.set(cv2.CAP_PROP_POS_FRAMES, 0):
            good, picture = self._capture.read()
            self._count = 0
        self._count += 1
        self.name = f"frame {self._count}"
        return _as_bgr8(picture) if good and picture is not None else None

    def close(self) -> None:
        """Release the device or file."""
        self._capture.release()


class Folder:
    """The images of a folder in the order of their names, numbers within them counted as such."""

    live = False

    def __init__(self, paths: list[Path], *, loop: bool) -> None:
        """Read these, once or over and over."""
        self.name = ""
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
        self.name = path.name
        data = np.frombuffer(path.read_bytes(), np.uint8)
        picture = cv2.imdecode(data, cv2.IMREAD_COLOR) if len(data) else None  # of nothing OpenCV makes an error
        if picture is None:
            raise ConfigError("source", str(path), "is no image that can be read")
        return _as_bgr8(picture)

    def close(self) -> None:
        """Nothing is open between reads."""


def open_source(
    source: str | int, size: tuple[int, int] | None, rate: float | None, *, loop: bool
) -> Source | None:
    """The source that a device number or path, a video file or an image folder stands for; None: device not there.

    Args:
        source: number or path.
        size: width and height that a device is asked for [px]; None: what it gives by itself.
        rate: pictures per second that a device is asked for [Hz]; None: what it gives by itself.
        loop: begin a file or folder again at its end.

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
        width, height = size or (None, None)
        for name, value in (
            (cv2.CAP_PROP_FRAME_WIDTH, width), (cv2.CAP_PROP_FRAME_HEIGHT, height),
            (cv2.CAP_PROP_FPS, rate), (cv2.CAP_PROP_BUFFERSIZE, 1),
        ):
            if value is not None:
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


def pictures(source: str, size: tuple[int, int] | None, seconds: float) -> Iterator[tuple[str, Picture]]:
    """Pictures of a source with their names: all of a file or folder, those of so many seconds of a device.

    Raises:
        ConfigError: it is nothing that pictures can be read from.
    """
    opened = open_source(source, size, None, loop=False)
    if opened is None:
        raise ConfigError("SOURCE", source, "is a device that cannot be opened")
    until = monotonic() + seconds
    try:
        while (picture := opened.read()) is not None and (not opened.live or monotonic() < until):
            yield opened.name, picture
    finally:
        opened.close()
