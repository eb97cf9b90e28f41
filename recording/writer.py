"""Writes samples to MCAP files in chunks that are complete on disk within a second."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgpack
from mcap.writer import CompressionType, Writer

from common.messages import SupervisorStatus
from common.messages.basics import MAX_NAME
from recording.chunk_indexes import ChunkIndexes
from recording.sample import RecordingError, Sample, schema_of, stamp_of

# Limits of a file: any client of the network can invent keys and writers, and readers refuse files with many more.
# Messages of a further writer share one channel if their key is known.
MOST_CHANNELS = 2000
LONGEST_KEY = 500  # characters
CHUNK_BYTES = 512 * 1024  # before compression; an image has a chunk of its own
_OVERHEAD = 40  # [bytes] of a message besides its payload, about: readers refuse chunks of very many tiny messages
PROFILE = "zencell"
ABOUT, RUN, ENDED = "zencell", "run", "ended"  # names of metadata records
TRACES_TOPIC, TRACES_SCHEMA = "recording/traces", "zencell.Traces"
_NEVER = 2**62  # chunk size that the library never reaches: this writer decides where chunks end
_TRACES = {
    "type": "object",
    "description": "Trace ids of the messages of this chunk: [channel id, sequence number, trace id].",
    "properties": {"traces": {"type": "array", "items": {"type": "array"}}},
}
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
MOST_STATES = 500  # newest states that are copied to the start of the next file


def run_of(status: SupervisorStatus) -> dict[str, Any]:
    """Return the description of a run from the supervisor's status."""
    return status.model_dump(include={"speed", "epoch", "seed", "world", "overrides"})


class WriteFailed(RecordingError):
    """The disk fails or is full; what was written before stays."""

    exit_code = 1

    def __init__(self, path: Path, error: OSError) -> None:
        self.why = "the disk is full" if error.errno in FULL else (error.strerror or str(error))
        super().__init__(f"{path}: recording stopped, {self.why}; to use what was written: zencell recover {path}")
        self.path = path
        self.errno = error.errno


class ExportFailed(RecordingError):
    """A file made from a recording does not fit on the disk, and was removed."""

    exit_code = 1

    def __init__(self, path: Path, why: str) -> None:
        super().__init__(f"{path}: cannot be written, {why}; the incomplete file was removed")


class AppendedFile:
    """New file with the stream interface that an MCAP writer needs."""

    def __init__(self, path: Path) -> None:
        """Create the file.

        Raises:
            RecordingError: it exists already, or cannot be created.
        """
        self.path = path
        self._closed = False
        try:
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
        except FileExistsError:
            raise RecordingError(f"{path}: exists already; choose another name") from None
        except OSError as error:
            raise RecordingError(f"{path}: cannot be written: {error.strerror}") from None
        self._size = 0

    def write(self, data: bytes) -> int:
        """Append complete records.

        Raises:
            WriteFailed: the disk failed; the file then contains none of the data.
        """
        view = memoryview(data)
        while view:
            try:
                written = os.write(self._file, view)
            except OSError as error:
                os.ftruncate(self._file, self._size)
                raise WriteFailed(self.path, error) from None
            view = view[written:]
        self._size += len(data)
        return len(data)

    def tell(self) -> int:
        """Return the number of bytes written."""
        return self._size

    def indexes(self) -> ChunkIndexes:
        """Return the index of the chunks that were written."""
        return ChunkIndexes(self._file, self.tell)

    def flush(self) -> None:
        """Do nothing: nothing is buffered."""

    def close(self) -> None:
        """Close the file if it is open: a second close could hit another file with the same number."""
        if not self._closed:
            self._closed = True
            os.close(self._file)


class RecordingWriter:
    """Writes one file. Not thread-safe.

    MCAP messages have no field for trace ids: the last message of a chunk lists those of the chunk, on its own topic.
    """

    def __init__(self, path: Path, about: Mapping[str, Any]) -> None:
        """Create the file and write the description of the recording.

        Raises:
            RecordingError: the file exists already, or cannot be written.
        """
        self.path = path
        self.messages = 0
        self._file = AppendedFile(path)
        self._writer = Writer(self._file, chunk_size=_NEVER, compression=CompressionType.ZSTD)  # type: ignore[arg-type]
        self._file.indexes().install(self._writer)
        self._channels: dict[tuple[tuple[str, str, str], str], int] = {}  # by (key, message, kind) and writer
        self._known: set[tuple[str, str, str]] = set()
        self._schemas: dict[str, int] = {"": 0}
        self._traces: list[tuple[int, int, str]] = []
        self._traces_channel = 0
        self._pending = 0  # bytes in the chunk that is not written yet
        self._newest = 0
        self._writer.start(profile=PROFILE)
        self.describe(ABOUT, about)

    @property
    def size(self) -> int:
        """Bytes on disk."""
        return self._file.tell()

    def describe(self, name: str, values: Mapping[str, Any]) -> None:
        """Write a metadata record; values other than text are written as JSON."""
        texts = {key: value if isinstance(value, str) else json.dumps(value) for key, value in values.items()}
        self._writer.add_metadata(name, texts)

    def add(self, sample: Sample) -> bool:
        """Write a message; return False if the file has too many keys already.

        It is on disk after the next `flush`, or when the chunk is full.

        Raises:
            WriteFailed: the disk failed.
        """
        channel = self._channel_of(sample)
        if channel is None:
            return False
        stamp = sample.publish_time or stamp_of(sample.payload) or sample.log_time
        sequence = sample.sequence & 0xFFFFFFFF
        self._writer.add_message(channel, sample.log_time, sample.payload, stamp, sequence)
        if sample.trace:
            self._traces.append((channel, sequence, sample.trace))
        self.messages += 1
        self._newest = max(self._newest, sample.log_time)
        self._pending += _OVERHEAD + len(sample.payload)
        if self._pending >= CHUNK_BYTES:
            self.flush()
        return True

    def _channel_of(self, sample: Sample) -> int | None:
        """Return the channel of a message; None for a key that is one too many, or too long."""
        writer, about = sample.writer, (sample.key, sample.message, sample.kind)
        if (about, writer) not in self._channels and len(self._channels) >= MOST_CHANNELS:
            if about not in self._known:
                return None
            writer = ""  # the channel that all further writers share
        if len(sample.key) > LONGEST_KEY or len(sample.message) > MAX_NAME:
            return None
        if (about, writer) not in self._channels:
            self._known.add(about)
            encoding, metadata, _ = sample.foreign or ("msgpack", {"kind": sample.kind, "writer": writer}, "")
            self._channels[about, writer] = self._writer.register_channel(
                sample.key, encoding, self._schema_of(sample), metadata)
        return self._channels[about, writer]

    def _schema_of(self, sample: Sample) -> int:
        message = sample.message
        if message not in self._schemas:
            data = sample.schema or schema_of(message)
            encoding = sample.foreign[2] if sample.foreign else "jsonschema" if data else ""
            self._schemas[message] = self._writer.register_schema(message, encoding, data)
        return self._schemas[message]

    def flush(self) -> None:
        """Write everything so far to disk as one chunk.

        Raises:
            WriteFailed: the disk failed.
        """
        self._add_traces()
        self._writer.flush()  # type: ignore[no-untyped-call]
        self._pending = 0

    def _add_traces(self) -> None:
        if not self._traces:
            return
        if not self._traces_channel:
            schema = self._writer.register_schema(TRACES_SCHEMA, "jsonschema", json.dumps(_TRACES).encode())
            self._traces_channel = self._writer.register_channel(TRACES_TOPIC, "msgpack", schema, {"kind": "traces"})
        payload = msgpack.packb({"traces": self._traces})
        self._writer.add_message(self._traces_channel, self._newest, payload, self._newest)
        self._traces = []

    def close(self, ended: Mapping[str, Any] | None = None) -> None:
        """Write the rest, how the recording ended, and the index; close the file.

        Raises:
            WriteFailed: the disk failed.
        """
        try:
            self.flush()
            if ended is not None:
                self.describe(ENDED, ended)
            self._writer.finish()  # type: ignore[no-untyped-call]
        finally:
            self._file.close()

    def abandon(self) -> None:
        """Close the file without an index, after a failure."""
        self._file.close()


class SplitWriter:
    """Writes FILE.mcap, or FILE_0.mcap, FILE_1.mcap, ... of about `max_bytes` each.

    Each further file starts with the newest value of every state and the same descriptions, so that it is usable alone.
    """

    def __init__(self, path: Path, about: Mapping[str, Any], max_bytes: int | None = None) -> None:
        """Create the first file.

        Raises:
            RecordingError: it exists already, or cannot be written.
        """
        self._path = path
        self._most = max_bytes
        self._descriptions: dict[str, Mapping[str, Any]] = {ABOUT: about}
        self._states: dict[tuple[str, str], Sample] = {}
        self._earlier_messages = 0
        self._earlier_bytes = 0
        self.files: list[Path] = []
        self._file = self._open()

    @property
    def messages(self) -> int:
        """Messages in all files; states at the start of a file count again."""
        return self._earlier_messages + self._file.messages

    @property
    def size(self) -> int:
        """Bytes on disk of all files."""
        return self._earlier_bytes + self._file.size

    def _open(self) -> RecordingWriter:
        numbered = self._path.with_name(f"{self._path.stem}_{len(self.files)}{self._path.suffix}")
        path = self._path if self._most is None else numbered
        writer = RecordingWriter(path, self._descriptions[ABOUT])
        self.files.append(path)
        return writer

    def describe(self, name: str, values: Mapping[str, Any]) -> None:
        """Write a metadata record to this file and those that follow."""
        self._descriptions[name] = values
        self._file.describe(name, values)

    def add(self, sample: Sample) -> bool:
        """Write a message; return False if the file has too many keys already.

        Raises:
            RecordingError: the disk failed.
        """
        written = self._file.add(sample)
        if self._most is None or not written:
            return written
        if sample.kind == "state":
            self._states.pop((sample.key, sample.writer), None)
            self._states[sample.key, sample.writer] = sample
            while len(self._states) > MOST_STATES:
                del self._states[next(iter(self._states))]
        if self._file.size >= self._most:
            self._start_next(sample.log_time)
        return written

    def _start_next(self, now: int) -> None:
        full = self._file
        full.close()
        self._earlier_messages += full.messages
        self._earlier_bytes += full.size
        self._file = self._open()
        for name, values in self._descriptions.items():
            if name != ABOUT:
                self._file.describe(name, values)
        for state in self._states.values():
            self._file.add(replace(state, log_time=now))

    def flush(self) -> None:
        """Write everything so far to disk.

        Raises:
            WriteFailed: the disk failed.
        """
        self._file.flush()

    def close(self, ended: Mapping[str, Any] | None = None) -> None:
        """Write the rest and how the recording ended, and close the file.

        Raises:
            WriteFailed: the disk failed.
        """
        self._file.close(ended)

    def abandon(self) -> None:
        """Close the file without an index, after a failure."""
        self._file.abandon()
