"""Recordings as CSV: a file for each topic, a row for each message."""

from __future__ import annotations

import csv
import json
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from itertools import count, pairwise
from pathlib import Path
from statistics import median
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from common.messages import Image, JointState, Message, PointCloud2
from common.perception.image import displayable
from recording.reader import Recording, Wanted
from recording.sample import Decoder, RecordingError
from recording.writer import ExportFailed

NOT_TABLES = (Image, PointCloud2)
MOST_COLUMNS = 5000  # of a table
OTHER_NAMES = ("Image", "PointCloud2")


def export_tables(recording: Recording, folder: Path, wants: Wanted, decoder: Decoder) -> dict[str, int]:
    """Rows that were written, by name of the file; the folder is made.

    Joint states have a column for each joint and quantity. Of other messages each single value is a column, named by
    its path; a list is written as JSON.

    Raises:
        RecordingError: the recording is damaged.
    """
    folder.mkdir(parents=True, exist_ok=True)
    topics = [topic for topic, (name, _) in recording.topics().items() if name not in OTHER_NAMES and wants(topic)]
    counts: dict[str, int] = {}
    names = file_names(sorted(topics))
    for topic, name in names.items():
        # Twice over the topic: the columns are known only when every row was seen.
        columns: dict[str, None] = {}
        for row in _rows(recording, topic, Decoder()):
            columns |= dict.fromkeys(row)
            if len(columns) > MOST_COLUMNS:
                raise RecordingError(f"{recording.path}: {topic} has more than {MOST_COLUMNS:,} columns")
        if not columns:
            decoder.skipped[topic] += 1
            continue
        path = folder / f"{name}.csv"
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, list(columns))
            writer.writeheader()
            counts[path.name] = 0
            for row in _rows(recording, topic, decoder):
                writer.writerow(row)
                counts[path.name] += 1
    return counts


def _rows(recording: Recording, topic: str, decoder: Decoder) -> Iterator[dict[str, Any]]:
    for sample in recording.samples(lambda name: name == topic):
        message = decoder.message(sample)
        if message is not None and not isinstance(message, NOT_TABLES):
            yield {"time": _seconds(sample.log_time), "stamp": _seconds(sample.publish_time), **row_of(message)}


def _seconds(nanoseconds: int) -> str:
    return f"{nanoseconds // 1_000_000_000}.{nanoseconds % 1_000_000_000:09d}"  # a float cannot hold it


def row_of(message: Message) -> dict[str, Any]:
    """The values of a message by the names of their columns."""
    if isinstance(message, JointState):
        columns = {"position": message.position, "velocity": message.velocity, "effort": message.effort}
        return {
            f"{name}.{quantity}": values[i]
            for quantity, values in columns.items() if values for i, name in enumerate(message.name[: len(values)])
        }
    return _flat("", message.model_dump(mode="json"))


def _flat(path: str, value: Any) -> dict[str, Any]:
    if isinstance(value, dict):
        found: dict[str, Any] = {}
        for name, item in value.items():
            if path or name != "header":
                found |= _flat(f"{path}.{name}" if path else name, item)
        if path or "header" not in value:
            return found
        return {"frame_id": value["header"].get("frame_id", ""), **found}
    return {path: json.dumps(value) if isinstance(value, list) else value}


COLOURS = ("bgr8", "rgb8", "mono8")
CODEC = "mp4v"
DEFAULT_RATE = 10.0  # [Hz] of a video of one picture


def image_topics(recording: Recording, wants: Wanted) -> list[str]:
    """The wanted topics that carry pictures."""
    return sorted(topic for topic, (name, _) in recording.topics().items() if name == "Image" and wants(topic))


def export_images(recording: Recording, folder: Path, wants: Wanted, decoder: Decoder) -> dict[str, int]:
    """Pictures that were written, by topic: FOLDER/<topic>/<number>_<stamp in ns>.png.

    Depth is written as 16 bit millimetres with 0 for none, as in ROS.

    Raises:
        RecordingError: the recording is damaged, or a file cannot be written.
    """
    topics = set(image_topics(recording, wants))
    names = file_names(sorted(topics))
    counts: Counter[str] = Counter()
    for sample in recording.samples(lambda topic: topic in topics):
        pixels = displayable(decoder.message(sample))
        if pixels is None:
            decoder.skipped[sample.topic] += 1
            continue
        place = folder / names[sample.topic]
        place.mkdir(parents=True, exist_ok=True)
        counts[sample.topic] += 1
        path = place / f"{counts[sample.topic]:06d}_{sample.publish_time}.png"
        if not cv2.imwrite(str(path), pixels):
            raise RecordingError(f"{path}: cannot be written")
    return dict(counts)


def export_video(recording: Recording, target: Path, topic: str, decoder: Decoder) -> tuple[int, float]:
    """Number of pictures in a new MP4 file of a topic, and their rate [Hz], which is the median of the recording.

    Raises:
        RecordingError: no codec is there, no picture can be shown, the recording is damaged, or the disk takes no more.
    """
    times = [sample.log_time for sample in recording.samples(lambda name: name == topic)]
    gaps = [(later - earlier) * 1e-9 for earlier, later in pairwise(times) if later > earlier]
    rate = round(1 / median(gaps), 2) if gaps else DEFAULT_RATE
    writer: cv2.VideoWriter | None = None
    size = (0, 0)
    count = 0
    try:
        for sample in recording.samples(lambda name: name == topic):
            pixels = _colour(decoder.message(sample))
            if pixels is None or (writer is not None and pixels.shape[1::-1] != size):
                decoder.skipped[topic] += 1
                continue
            if writer is None:
                size = (pixels.shape[1], pixels.shape[0])
                writer = cv2.VideoWriter(str(target), cv2.VideoWriter.fourcc(*CODEC), rate, size)
                if not writer.isOpened():
                    raise RecordingError(f"{target}: this OpenCV cannot write {CODEC} video there; try --images DIR")
            writer.write(pixels)
            count += 1
    finally:
        if writer is not None:
            writer.release()
    if not count:
        raise RecordingError(f"{recording.path}: {topic} has no colour picture; for depth use --images DIR")
    if _pictures_in(target) != count:  # OpenCV says nothing of what it could not write
        target.unlink(missing_ok=True)
        raise ExportFailed(target, "the disk takes no more")
    return count, rate


def _pictures_in(video: Path) -> int:
    """How many pictures a video file has, as it says itself; 0 for one that is not whole."""
    reader = cv2.VideoCapture(str(video))
    try:
        return round(reader.get(cv2.CAP_PROP_FRAME_COUNT)) if reader.isOpened() else 0
    finally:
        reader.release()


def _colour(message: Any) -> npt.NDArray[Any] | None:
    pixels = displayable(message)
    if pixels is None or message.encoding not in COLOURS:
        return None
    return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR)) if pixels.ndim == 2 else pixels


LONGEST = 100  # [characters]


def file_names(topics: Iterable[str]) -> dict[str, str]:
    """For each topic the name of a file or folder of its own, without an ending: none leads out of its folder."""
    names: dict[str, str] = {}
    taken: set[str] = set()
    for topic in topics:
        plain = re.sub(r"[^\w.-]|^\.", "_", topic, flags=re.ASCII)[:LONGEST] or "_"
        name = next(each for k in count(1) if (each := plain if k == 1 else f"{plain}_{k}") not in taken)
        taken.add(name)
        names[topic] = name
    return names
