"""Recordings for programs: `zencell.open_recording(path).table(topic)` gives arrays."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt

from common.errors import ConfigError, UnknownName
from common.messages import Image
from common.perception.image import ImageError, displayable, image_to_array
from recording.reader import Recording
from recording.sample import Decoder
from recording.tables import Array, Row, Table, batches, rows_of

BATCH = 10_000  # messages of a table while iterating


def open_recording(path: str | Path) -> OpenRecording:
    """Open a recording to read its messages as arrays; they are read when they are asked for.

    Args:
        path: of the MCAP file, which may be damaged or still be written.

    Raises:
        RecordingError: it does not exist, or is no recording.
    """
    return OpenRecording(Recording(Path(path)))


class OpenRecording:
    """An open recording; `close()`, a `with` block or its end of life releases the file."""

    def __init__(self, recording: Recording) -> None:
        """Read nothing yet."""
        self._recording = recording
        self._decoder = Decoder()

    def __enter__(self) -> OpenRecording:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __del__(self) -> None:
        self.close()  # a script of three lines has no `with` block

    def close(self) -> None:
        """Close the file."""
        self._recording.file.close()

    @property
    def cell(self) -> str:
        """Name of the recorded cell."""
        return self._recording.cell

    @property
    def seconds(self) -> float:
        """Duration by the time of arrival [s]."""
        return self._recording.seconds

    @property
    def topics(self) -> dict[str, str]:
        """Name of the message class of each topic; `docs/reference/messages.md` describes them."""
        return {topic: message for topic, (message, _) in self._recording.topics().items()}

    @property
    def unreadable(self) -> Counter[str]:
        """Messages by topic that were left out so far, since this version cannot decode them."""
        return self._decoder.skipped

    def table(self, topic: str, *, images: bool = False) -> Table:
        """Return all messages of a topic as one table.

        Args:
            topic: key without the cell, such as joint_states.
            images: with a column `image` of pixels, all in memory; `images()` reads one at a time.

        Raises:
            UnknownName: the recording has no such topic.
            RecordingError: it is damaged.
        """
        return Table(topic, list(self.rows(topic, images=images)))

    def tables(self, topic: str, *, size: int = BATCH, images: bool = False) -> Iterator[Table]:
        """Yield tables of `size` messages each, in constant memory: one at a time is read.

        Raises:
            ConfigError: the size is less than 1.
            UnknownName: the recording has no such topic.
            RecordingError: it is damaged.
        """
        if size < 1:
            raise ConfigError("size", size, "must be 1 or more")
        return batches(self.rows(topic, images=images), topic, size)

    def rows(self, topic: str, *, images: bool = False) -> Iterator[Row]:
        """Yield each message of a topic in the order of arrival: `row.stamp_ns`, `row.values["width"]`.

        Raises:
            UnknownName: the recording has no such topic.
            RecordingError: it is damaged.
        """
        self._require(topic)
        return rows_of(self._recording, topic, self._decoder, images=images)

    def images(self, topic: str, *, encoded: bool = False) -> Iterator[tuple[int, Array]]:
        """Yield stamp of the exposure [ns] and pixels of each image of a topic, one at a time.

        Colors are (height, width, 3) in the order red, green, blue; depth is (height, width) float32 [m] with NaN for
        no value. With `encoded` the pixels are as recorded.

        Raises:
            UnknownName: the recording has no such topic.
            RecordingError: it is damaged.
        """
        self._require(topic)
        return self._images(topic, encoded)

    def _images(self, topic: str, encoded: bool) -> Iterator[tuple[int, Array]]:
        for sample in self._recording.samples(lambda name: name == topic):
            message = self._decoder.message(sample)
            if message is None:
                continue
            pixels = _pixels(message, encoded) if isinstance(message, Image) else None
            if pixels is None:
                self._decoder.skipped[topic] += 1
            else:
                yield sample.publish_time, pixels

    def _require(self, topic: str) -> None:
        if topic not in self._recording.topics():
            raise UnknownName("topic", topic, self._recording.topics())


def _pixels(image: Image, encoded: bool) -> Array | None:
    try:
        return image_to_array(image) if encoded else pixels_of(image)
    except ImageError:
        return None


def pixels_of(image: Image) -> Array | None:
    """Return colors (height, width, 3) uint8 as RGB, or depth (height, width) float32 [m]; None for other images.

    Raises:
        ImageError: the pixels do not agree with the size.
    """
    if image.encoding == "32FC1":
        return image_to_array(image)
    if image.encoding == "16UC1":
        return _metres(image_to_array(image))
    shown = displayable(image)
    if shown is None:
        return None
    return np.repeat(shown[..., None], 3, axis=2) if shown.ndim == 2 else np.ascontiguousarray(shown[..., ::-1])


def _metres(depth: Array) -> npt.NDArray[np.float32]:
    """Return depth in millimetres, with 0 for no value, as metres with NaN."""
    return np.where(depth == 0, np.nan, depth * np.float32(1e-3)).astype(np.float32)
