"""Read images from a camera device, a video file or an image folder. All calls may block."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
import numpy.typing as npt

from common.errors import ConfigError
from common.perception.image_files import IMAGE_SUFFIXES, MAX_PIXELS, read_image
from common.time_source import monotonic

Pixels = npt.NDArray[np.uint8]


class Source(Protocol):
    """A source of images."""

    live: bool  # a device sets the rate and may vanish; files are read on demand
    name: str  # of the last image

    def read(self) -> Pixels | None:
        """Return the next bgr8 image (height, width, 3); None at the end or when the device is gone."""

    def close(self) -> None:
        """Release the device or file."""


class Video:
    """A camera device or a video file."""

    def __init__(self, capture: cv2.VideoCapture, *, live: bool, loop: bool) -> None:
        """Take over an open capture; `loop` restarts a file at its end."""
        self.live = live
        self.name = ""
        self._count = 0
        self._capture = capture
        self._loop = loop

    def read(self) -> Pixels | None:
        """Return the next image; None at the end."""
        good, image = self._capture.read()
        if not good and self._loop and self._capture.set(cv2.CAP_PROP_POS_FRAMES, 0):
            good, image = self._capture.read()
            self._count = 0
        self._count += 1
        self.name = f"frame {self._count}"
        return _as_bgr8(image) if good and image is not None else None

    def close(self) -> None:
        """Release the device or file."""
        self._capture.release()


class Folder:
    """Images of a folder in natural order of their names (numbers compare as numbers)."""

    live = False

    def __init__(self, paths: list[Path], *, loop: bool, report: Callable[[str], object] | None = None) -> None:
        """Read these paths once, or repeatedly with `loop`; with `report`, skip those that are no images."""
        self.name = ""
        self._paths = paths
        self._loop = loop
        self._report = report
        self._reported: set[str] = set()
        self._good = False  # whether any was readable
        self._next = 0

    def read(self) -> Pixels | None:
        """Return the next image; None at the end.

        Raises:
            ConfigError: a file is no image, or with `report` all are.
        """
        while self._next < len(self._paths) or self._loop:
            self._next %= len(self._paths)
            path = self._paths[self._next]
            self._next += 1
            self.name = path.name
            try:
                image = read_image(path, report=self._report_once)
                self._good = True
                return image
            except ConfigError as error:
                if self._report is None or len(self._paths) == 1:
                    raise
                self._report(f"skipped: {error}")
        if not self._good:
            raise ConfigError("source", str(self._paths[0].parent), "contains no readable image")
        return None

    def _report_once(self, text: str) -> None:
        if self._report and text not in self._reported:
            self._reported.add(text)
            self._report(f"{self.name} {text}")

    def close(self) -> None:
        """Do nothing: no file stays open between reads."""


def open_source(
    source: str | int, size: tuple[int, int] | None, rate: float | None, *, loop: bool,
    report: Callable[[str], object] | None = None,
) -> Source | None:
    """Open the source that a device number or path, a video file or an image folder names; None if no device is there.

    Args:
        source: number or path.
        size: requested width and height of a device [px]; None: the device's default.
        rate: requested images per second of a device [Hz]; None: the device's default.
        loop: restart a file or folder at its end.
        report: gets a line for each file of a folder that is skipped because it is no image; None: that is an error.

    Raises:
        ConfigError: the path is none of these.
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
        images = sorted((p for p in path.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and p.name[0] != "."),
                        key=_natural)
        if not images:
            raise ConfigError("source", str(source), f"contains no image; supported: {', '.join(IMAGE_SUFFIXES)}")
        return Folder(images, loop=loop, report=report)
    if path.suffix.lower() in IMAGE_SUFFIXES:
        return Folder([path], loop=loop)
    if not path.is_file():
        raise ConfigError("source", str(source), "is not a device number, /dev path, video file or image folder")
    capture = cv2.VideoCapture(str(path))
    if not capture.isOpened():
        capture.release()
        raise ConfigError("source", str(source), "is not a readable video")
    width, height = (int(capture.get(each)) for each in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
    if width * height > MAX_PIXELS:
        capture.release()
        raise ConfigError("source", str(source), f"has frames of {width}x{height}; at most "
                                                 f"{MAX_PIXELS:,} pixels are read")
    return Video(capture, live=False, loop=loop)


def _natural(path: Path) -> list[tuple[int, str]]:
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", path.name)]


def _as_bgr8(image: npt.NDArray[Any]) -> Pixels:
    if image.ndim == 2 or image.shape[2] == 1:
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)
    return np.ascontiguousarray(image[..., :3], np.uint8)


def read_images(
    source: str, size: tuple[int, int] | None, seconds: float, report: Callable[[str], object]
) -> Iterator[tuple[str, Pixels]]:
    """Yield images of a source with their names: all of a file or folder, or those within some seconds of a device.

    `report` gets a line for each file that is no image.

    Raises:
        ConfigError: the source cannot be read.
    """
    opened = open_source(source, size, None, loop=False, report=report)
    if opened is None:
        raise ConfigError("SOURCE", source, "cannot be opened: no such device")
    until = monotonic() + seconds
    try:
        while (image := opened.read()) is not None and (not opened.live or monotonic() < until):
            yield opened.name, image
    finally:
        opened.close()
