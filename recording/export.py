"""Exports recordings: CSV tables, PNG images, and video."""

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

from common.messages import JointState, Message
from common.perception.image import displayable
from recording.reader import Recording, Wanted
from recording.sample import Decoder, RecordingError
from recording.writer import ExportFailed

NO_TABLE_NAMES = ("Image", "PointCloud2")
MOST_COLUMNS = 5000  # of a table
COLORS = ("bgr8", "rgb8", "mono8")
CODEC = "mp4v"
DEFAULT_RATE = 10.0  # [Hz] of a video of one image
FORMULA = ("=", "+", "-", "@", "\t", "\r")  # beginnings of texts that spreadsheets evaluate
LONGEST = 100  # [characters] of a file name


def export_tables(recording: Recording, folder: Path, wants: Wanted, decoder: Decoder) -> dict[str, int]:
    """Write a CSV file for each wanted topic, with a row for each message; return the rows by file name.

    Joint states have a column for each joint and quantity. Other messages have a column for each value, named by its
    path; a list is written as JSON.

    Raises:
        RecordingError: the recording is damaged.
    """
    folder.mkdir(parents=True, exist_ok=True)
    counts: dict[str, int] = {}
    names = file_names(sorted(filter(wants, recording.topics())))
    for topic, name in names.items():
        # Two passes over the topic: the columns are known only after the last row.
        columns: dict[str, None] = {}
        for row in _rows(recording, topic, decoder):
            columns |= dict.fromkeys(row)
            if len(columns) > MOST_COLUMNS:
                raise RecordingError(f"{recording.path}: {topic} has more than {MOST_COLUMNS:,} columns")
        if not columns:
            continue
        path = folder / f"{name}.csv"
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, list(columns))
            writer.writerow({column: _inert(column) for column in columns})
            counts[path.name] = 0
            for row in _rows(recording, topic, Decoder()):
                writer.writerow({column: _inert(value) for column, value in row.items()})
                counts[path.name] += 1
    return counts


def _rows(recording: Recording, topic: str, decoder: Decoder) -> Iterator[dict[str, Any]]:
    for sample in recording.samples(lambda name: name == topic):
        if sample.message in NO_TABLE_NAMES:
            decoder.unfit[topic] += 1
        elif (message := decoder.message(sample)) is not None:
            yield {"time": _seconds(sample.log_time), "stamp": _seconds(sample.publish_time), **row_of(message)}


def _inert(value: Any) -> Any:
    """Return a cell that no spreadsheet evaluates as a formula: a text that begins like one gets an apostrophe."""
    return f"'{value}" if isinstance(value, str) and value[:1] in FORMULA else value


def _seconds(nanoseconds: int) -> str:
    return f"{nanoseconds // 1_000_000_000}.{nanoseconds % 1_000_000_000:09d}"  # a float is not precise enough


def row_of(message: Message) -> dict[str, Any]:
    """Return the values of a message by column name."""
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


def file_names(topics: Iterable[str]) -> dict[str, str]:
    """Return a unique file name, without extension, for each topic; none leads out of its folder."""
    names: dict[str, str] = {}
    taken: set[str] = set()
    for topic in topics:
        plain = re.sub(r"[^\w.-]|^\.", "_", topic, flags=re.ASCII)[:LONGEST] or "_"
        name = next(each for k in count(1) if (each := plain if k == 1 else f"{plain}_{k}") not in taken)
        taken.add(name)
        names[topic] = name
    return names


# --- images -----------------------------------------------------------------------------------------------------------


def image_topics(recording: Recording, wants: Wanted) -> list[str]:
    """Return the wanted topics of images."""
    return sorted(topic for topic, (name, _) in recording.topics().items() if name == "Image" and wants(topic))


def export_images(recording: Recording, folder: Path, wants: Wanted, decoder: Decoder) -> dict[str, int]:
    """Write images to FOLDER/<topic>/<number>_<stamp in ns>.png; return their number by topic.

    Depth is written as 16 bit millimetres with 0 for no value, as in ROS.

    Raises:
        RecordingError: the recording is damaged, or a file cannot be written.
    """
    topics = set(image_topics(recording, wants))
    names = file_names(sorted(topics))
    counts: Counter[str] = Counter()
    for sample in recording.samples(lambda topic: topic in topics):
        message = decoder.message(sample)
        pixels = displayable(message)
        if pixels is None:
            decoder.unfit[sample.topic] += message is not None
            continue
        subfolder = folder / names[sample.topic]
        subfolder.mkdir(parents=True, exist_ok=True)
        counts[sample.topic] += 1
        path = subfolder / f"{counts[sample.topic]:06d}_{sample.publish_time}.png"
        if not cv2.imwrite(str(path), pixels):
            raise RecordingError(f"{path}: cannot be written")
    return dict(counts)


def export_video(recording: Recording, target: Path, topic: str, decoder: Decoder) -> tuple[int, float]:
    """Write the color images of a topic to an MP4 file; return their number and rate [Hz], the median of the recording.

    Raises:
        RecordingError: the codec is missing, the topic has no color image, the recording is damaged, or the disk is
            full.
    """
    times = [sample.log_time for sample in recording.samples(lambda name: name == topic)]
    gaps = [(later - earlier) * 1e-9 for earlier, later in pairwise(times) if later > earlier]
    rate = round(1 / median(gaps), 2) if gaps else DEFAULT_RATE
    writer: cv2.VideoWriter | None = None
    size = (0, 0)
    written = 0
    try:
        for sample in recording.samples(lambda name: name == topic):
            message = decoder.message(sample)
            pixels = _color_image(message)
            if pixels is None or (writer is not None and pixels.shape[1::-1] != size):
                decoder.unfit[topic] += message is not None
                continue
            if writer is None:
                size = (pixels.shape[1], pixels.shape[0])
                writer = cv2.VideoWriter(str(target), cv2.VideoWriter.fourcc(*CODEC), rate, size)
                if not writer.isOpened():
                    raise RecordingError(f"{target}: this OpenCV cannot write {CODEC} video there; try --images DIR")
            writer.write(pixels)
            written += 1
    finally:
        if writer is not None:
            writer.release()
    if not written:
        raise RecordingError(f"{recording.path}: {topic} has no color image; for depth use --images DIR")
    if _frame_count(target) != written:  # OpenCV does not report write errors
        target.unlink(missing_ok=True)
        raise ExportFailed(target, "the disk is full")
    return written, rate


def _frame_count(video: Path) -> int:
    """Return the number of images in a video file; 0 for a truncated one."""
    reader = cv2.VideoCapture(str(video))
    try:
        return round(reader.get(cv2.CAP_PROP_FRAME_COUNT)) if reader.isOpened() else 0
    finally:
        reader.release()


def _color_image(message: Any) -> npt.NDArray[Any] | None:
    pixels = displayable(message)
    if pixels is None or message.encoding not in COLORS:
        return None
    return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR)) if pixels.ndim == 2 else pixels
