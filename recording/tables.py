"""Recordings as CSV: a file for each topic, a row for each message."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from common.messages import Image, JointState, Message, PointCloud2
from recording.decoding import Decoder
from recording.names import file_names
from recording.reading import Recording, Wanted
from recording.sample import RecordingError

NOT_TABLES = (Image, PointCloud2)
MOST_COLUMNS = 5000  # of a table
OTHER_NAMES = ("Image", "PointCloud2")


def export(recording: Recording, folder: Path, wants: Wanted, decoder: Decoder) -> dict[str, int]:
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
