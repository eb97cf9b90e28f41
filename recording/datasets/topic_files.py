"""Topics of a recording as Parquet or numpy files: every message as it was recorded, not aligned."""

from __future__ import annotations

import json
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from recording.datasets import optional
from recording.export import file_names
from recording.reader import Recording, Wanted
from recording.sample import Decoder, RecordingError
from recording.tables import IMAGE, MOST_COLUMNS, Array, Row, Table, rows_of

BATCH, BATCH_OF_IMAGES = 10_000, 50  # rows of a row group, which are in memory
TIMES = ("stamp_ns", "log_time_ns")
NUMBERS, TEXT = "numbers", "text"  # kinds of columns besides bool, int and float: lists of numbers; text or JSON


def write_parquet(recording: Recording, folder: Path, wants: Wanted, decoder: Decoder) -> dict[str, int]:
    """Write FOLDER/<topic>.parquet for each wanted topic; return the rows by file name.

    The columns are those of `Table`, with the stamp and the time of arrival [ns]. Pixels are PNG files in the column
    `image`, depth as 16 bit millimetres. Lists of other things than numbers are JSON.

    Raises:
        ConfigError: pyarrow is not installed.
        RecordingError: the recording is damaged.
    """
    pa, pq = optional("pyarrow", "--parquet"), optional("pyarrow.parquet", "--parquet")
    types = {"bool": pa.bool_(), "int": pa.int64(), "float": pa.float64(), TEXT: pa.string(), IMAGE: pa.binary(),
             NUMBERS: pa.list_(pa.float64())}
    folder.mkdir(parents=True, exist_ok=True)
    counts: dict[str, int] = {}
    for topic, name in file_names(sorted(filter(wants, recording.topics()))).items():
        images = recording.topics()[topic][0] == "Image"
        # Two passes over the topic: columns and types are known only after the last row.
        kinds = _kinds(rows_of(recording, topic, decoder, images=images), f"{recording.path}: {topic}")
        if not kinds:
            continue
        schema = pa.schema([*((time, pa.int64()) for time in TIMES),
                            *((column, types[kind]) for column, kind in kinds.items())])
        path = folder / f"{name}.parquet"
        counts[path.name] = 0
        with pq.ParquetWriter(path, schema) as writer:
            rows = rows_of(recording, topic, Decoder(), images=images)
            while batch := list(islice(rows, BATCH_OF_IMAGES if images else BATCH)):
                writer.write_table(pa.Table.from_pylist([_record(row, kinds) for row in batch], schema=schema))
                counts[path.name] += len(batch)
    return counts


def _kinds(rows: Iterator[Row], what: str) -> dict[str, str]:
    """Return the kind of each column; one without any value is text."""
    kinds: dict[str, str] = {}
    for row in rows:
        for name, value in row.values.items():
            kind, before = _kind(value), kinds.get(name, "")
            both = {kind, before} - {""}
            kinds[name] = both.pop() if len(both) == 1 else "" if not both else \
                "float" if both == {"int", "float"} else TEXT
        if len(kinds) > MOST_COLUMNS:
            raise RecordingError(f"{what} has more than {MOST_COLUMNS:,} columns")
    return {name: kind or TEXT for name, kind in kinds.items()}


def _kind(value: Any) -> str:
    match value:
        case None:
            return ""
        case bool() | int() | float():
            return type(value).__name__
        case np.ndarray():
            return IMAGE
        case list() if all(type(item) in (int, float) for item in value):
            return NUMBERS
    return TEXT


def _record(row: Row, kinds: dict[str, str]) -> dict[str, Any]:
    values = {name: _cell(value, kinds[name], row) for name, value in row.values.items()}
    return {"stamp_ns": row.stamp_ns, "log_time_ns": row.log_time_ns, **values}


def _cell(value: Any, kind: str, row: Row) -> Any:
    if value is None or (kind not in (TEXT, IMAGE)):
        return value
    if kind == IMAGE:
        return _png(value, row.values.get("encoding"))
    return value if isinstance(value, str) else json.dumps(value)


def _png(pixels: Array, encoding: Any) -> bytes:
    if encoding == "rgb8":
        pixels = pixels[..., ::-1]
    if pixels.dtype == np.float32:
        pixels = np.clip(np.nan_to_num(pixels * 1000), 0, 65535).astype(np.uint16)
    _, data = cv2.imencode(".png", pixels)
    return data.tobytes()


def write_numpy(recording: Recording, folder: Path, wants: Wanted, decoder: Decoder) -> dict[str, int]:
    """Write FOLDER/<topic>.npz for each wanted topic, with an array for each column; return the rows by file name.

    Pixels are FOLDER/<topic>.npy, (images, height, width, 3) in the order of their encoding, or (images, height,
    width); `numpy.load(file, mmap_mode="r")` reads single ones. Images of another size than the first are left out.
    Lists of changing length are JSON. No file needs pickle.

    Raises:
        RecordingError: the recording is damaged.
    """
    folder.mkdir(parents=True, exist_ok=True)
    counts: dict[str, int] = {}
    for topic, name in file_names(sorted(filter(wants, recording.topics()))).items():
        rows = rows_of(recording, topic, decoder)
        if recording.topics()[topic][0] == "Image":
            rows = iter(_write_pixels(recording, topic, folder / f"{name}.npy", decoder))
        table = Table(topic, list(rows))
        if len(table):
            columns = {column: _without_objects(values) for column, values in table.columns().items()}
            np.savez(folder / f"{name}.npz", allow_pickle=False, stamp_ns=table.stamp_ns,
                     log_time_ns=table.log_time_ns, **columns)
            counts[f"{name}.npz"] = len(table)
    return counts


def _without_objects(values: Array) -> Array:
    if values.dtype != object:
        return values
    return np.array(["" if each is None else each if isinstance(each, str) else json.dumps(each) for each in values])


def _write_pixels(recording: Recording, topic: str, path: Path, decoder: Decoder) -> list[Row]:
    """Write the pixels of a topic to a file; return the rows of its images without them."""
    first: Array | None = None
    used = set[int]()  # positions of the images of the first one's size
    for number, row in enumerate(rows_of(recording, topic, Decoder(), images=True)):
        pixels = row.values[IMAGE]
        first = pixels if first is None else first
        if (pixels.shape, pixels.dtype) == (first.shape, first.dtype):
            used.add(number)
    if first is None:
        return []
    header = {"descr": np.lib.format.dtype_to_descr(first.dtype), "fortran_order": False,
              "shape": (len(used), *first.shape)}
    rows: list[Row] = []
    with path.open("wb") as file:  # a memory map would end the process when the disk is full
        np.lib.format.write_array_header_2_0(file, header)
        for number, row in enumerate(rows_of(recording, topic, decoder, images=True)):
            if number in used:
                file.write(np.ascontiguousarray(row.values[IMAGE]).data)
                values = {name: value for name, value in row.values.items() if name != IMAGE}
                rows.append(Row(row.log_time_ns, row.stamp_ns, values))
            else:
                decoder.unfit[topic] += 1
    return rows
