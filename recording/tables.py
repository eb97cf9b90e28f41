"""Tables of the messages of a topic: a column of numpy for each value, named by its path in the message."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from itertools import islice
from typing import Any

import numpy as np
import numpy.typing as npt

from common.errors import UnknownName
from common.messages import Image, JointState, Message, PointCloud2
from common.perception.image import ImageError, image_to_array
from recording.reader import LAST, Recording
from recording.sample import Decoder

Array = npt.NDArray[Any]
IMAGE = "image"  # column of pixels
MOST_COLUMNS = 5000
QUANTITIES = ("position", "velocity", "effort")  # of a joint


@dataclass(frozen=True, slots=True)
class Row:
    """The values of one message by column, with its log time and stamp [ns since the Unix epoch]."""

    log_time_ns: int
    stamp_ns: int
    values: Mapping[str, Any]


class Table:
    """Messages of one topic as arrays: `table["header.frame_id"]`, `table["joint1.position"]`.

    Numbers are float64, int64 or bool; a number that some messages lack is NaN. Lists of n numbers make an array
    (messages, n); other lists, and texts, make arrays of objects.
    """

    def __init__(self, topic: str, rows: Sequence[Row]) -> None:
        """Make the columns of all rows."""
        self.topic = topic
        self.stamp_ns: npt.NDArray[np.int64] = np.array([row.stamp_ns for row in rows], np.int64)
        """Stamp of the header in cell time, for images that of the exposure [ns since the Unix epoch]."""
        self.log_time_ns: npt.NDArray[np.int64] = np.array([row.log_time_ns for row in rows], np.int64)
        """Time at which the message arrived at the recorder, in wall time [ns since the Unix epoch]."""
        names = dict.fromkeys(name for row in rows for name in row.values)
        self._columns = {name: column_of([row.values.get(name) for row in rows]) for name in names}

    def __len__(self) -> int:
        """Return the number of messages."""
        return len(self.stamp_ns)

    def __getitem__(self, name: str) -> Array:
        """Return a column.

        Raises:
            UnknownName: there is none of this name.
        """
        if name not in self._columns:
            raise UnknownName("column", name, self._columns)
        return self._columns[name]

    def __iter__(self) -> Iterator[str]:
        """Return the names of the columns."""
        return iter(self._columns)

    @property
    def names(self) -> list[str]:
        """Names of the columns."""
        return list(self._columns)

    @property
    def time(self) -> npt.NDArray[np.float64]:
        """Stamps since that of the first message [s]."""
        seconds: npt.NDArray[np.float64] = (self.stamp_ns - self.stamp_ns[:1]) * np.float64(1e-9)
        return seconds

    def columns(self) -> dict[str, Array]:
        """Return the columns by name, such as for `pandas.DataFrame` where each has one dimension."""
        return dict(self._columns)

    def matrix(self, pattern: str) -> Array:
        """Return the columns that a pattern such as `*.position` matches, as an array (messages, columns).

        Raises:
            UnknownName: it matches none.
        """
        found = [name for name in self._columns if fnmatchcase(name, pattern)]
        if not found:
            raise UnknownName("column", pattern, self._columns)
        return np.stack([self._columns[name] for name in found], axis=1)


def column_of(values: Sequence[Any]) -> Array:
    """Return values of one column as an array; None is a missing value."""
    missing = any(value is None for value in values)
    kinds = {type(value) for value in values if value is not None}
    if kinds <= {bool, int, float} and kinds:
        if kinds == {bool} and not missing:
            return np.array(values, np.bool_)
        if not missing and kinds == {int}:
            return np.array(values, np.int64)
        return np.array([np.nan if value is None else value for value in values], np.float64)
    first = values[0]
    if isinstance(first, np.ndarray):
        same = all(isinstance(each, np.ndarray) and (each.shape, each.dtype) == (first.shape, first.dtype)
                   for each in values)
        return np.stack(values) if same else _objects(values)
    same_length = kinds == {list} and not missing and first and all(len(each) == len(first) for each in values)
    if same_length and all(type(item) in (int, float) for each in values for item in each):
        return np.array(values, np.float64)
    return _objects(values)


def _objects(values: Sequence[Any]) -> Array:
    found = np.empty(len(values), object)
    for i, value in enumerate(values):  # an assignment of all would look into lists
        found[i] = value
    return found


def values_of(message: Message, *, images: bool = False) -> dict[str, Any]:
    """Return the values of a message by column.

    Joint states have a column for each joint and quantity, such as `joint1.position`. Pixels are a column
    `image` if wanted: (height, width, 3) in the order of their encoding, or (height, width). Bytes are left out.

    Raises:
        ImageError: the wanted pixels do not agree with the size.
    """
    if isinstance(message, JointState):
        lists = ((quantity, getattr(message, quantity)) for quantity in QUANTITIES)
        joints = {f"{name}.{quantity}": value
                  for quantity, values in lists if values for name, value in zip(message.name, values, strict=True)}
        return {"header.frame_id": message.header.frame_id, **joints}
    left_out = {"data"} if isinstance(message, Image | PointCloud2) else None
    values: dict[str, Any] = {}
    _flatten("", message.model_dump(exclude=left_out), values)
    values.pop("header.stamp", None)  # is a column of its own
    if images and isinstance(message, Image):
        values[IMAGE] = image_to_array(message)
    return values


def _flatten(path: str, value: Any, found: dict[str, Any]) -> None:
    if isinstance(value, dict):
        for name, item in value.items():
            _flatten(f"{path}.{name}" if path else str(name), item, found)
    elif isinstance(value, tuple):
        found[path] = list(value)
    elif not isinstance(value, bytes):
        found[path] = value


def rows_of(
    recording: Recording, topic: str, decoder: Decoder, *, images: bool = False, since: int = 0, until: int = LAST,
) -> Iterator[Row]:
    """Yield the messages of a topic in the order of arrival; the decoder counts those that cannot be read.

    Raises:
        RecordingError: the recording is damaged.
    """
    for sample in recording.samples(lambda name: name == topic, since, until):
        message = decoder.message(sample)
        if message is None:
            continue
        try:
            yield Row(sample.log_time, sample.publish_time, values_of(message, images=images))
        except ImageError:
            decoder.skipped[topic] += 1


def batches(rows: Iterable[Row], topic: str, size: int) -> Iterator[Table]:
    """Yield tables of `size` messages, the last of fewer."""
    iterator = iter(rows)
    while chunk := list(islice(iterator, size)):
        yield Table(topic, chunk)
