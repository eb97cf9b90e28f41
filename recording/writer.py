"""Writes samples to one MCAP file, in chunks that are whole on disk a second later at most."""

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
from recording.sample import RecordingError, Sample, schema_of, stamp_of

# Of a file; whoever is on the network can make any number up, and readers take no file of many more. One of another
# writer is found room for where its key is known.
MOST_CHANNELS = 2000
LONGEST_KEY = 500  # characters
CHUNK_BYTES = 512 * 1024  # before compression; a picture has a chunk of its own
_BESIDE = 40  # [bytes] about, that a message takes beside its payload: readers take no chunk of very many tiny ones
PROFILE = "zencell"
ABOUT, RUN, ENDED = "zencell", "run", "ended"  # names of metadata records
TRACES_TOPIC, TRACES_SCHEMA = "recording/traces", "zencell.Traces"
_OURS_ALONE = 2**62  # chunk size that the library never reaches: where chunks end is decided here
_TRACES = {
    "type": "object",
    "description": "Trace ids of the messages of this chunk: [channel id, sequence number, trace id].",
    "properties": {"traces": {"type": "array", "items": {"type": "array"}}},
}
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)  # the disk takes no more


def run_of(status: SupervisorStatus) -> dict[str, Any]:
    """What a recording says of the run, from what the supervisor says."""
    return status.model_dump(include={"speed", "epoch", "seed", "world", "overrides"})


class WriteFailed(RecordingError):
    """The disk takes no more; what was written before is kept."""

    exit_code = 1

    def __init__(self, path: Path, error: OSError) -> None:
        self.why = "the disk is full" if error.errno in FULL else (error.strerror or str(error))
        super().__init__(f"{path}: recording stopped, {self.why}; what was written is kept: zencell recover {path}")
        self.path = path
        self.errno = error.errno


class ExportFailed(RecordingError):
    """A file that is made of a recording does not fit on the disk; nothing of it is kept."""

    exit_code = 1

    def __init__(self, path: Path, why: str) -> None:
        super().__init__(f"{path}: cannot be written, {why}; nothing of it is kept")


class AppendedFile:
    """What an MCAP writer needs of a stream."""

    def __init__(self, path: Path) -> None:
        """Create the file.

        Raises:
            RecordingError: it is there already, or cannot be made.
        """
        self.path = path
        self._closed = False
        try:
            self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
        except FileExistsError:
            raise RecordingError(f"{path}: is there already; choose another name") from None
        except OSError as error:
            raise RecordingError(f"{path}: cannot be written: {error.strerror}") from None
        self._size = 0

    def write(self, data: bytes) -> int:
        """Append all of the data, which are whole records.

        Raises:
            WriteFailed: the disk takes no more; none of the data are in the file then.
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
        """Bytes written so far."""
        return self._size

    def flush(self) -> None:
        """Nothing is held back."""

    def close(self) -> None:
        """Close the file, once: its number may be another's by then."""
        if not self._closed:
            self._closed = True
            os.close(self._file)


class RecordingWriter:
    """One file. Not thread-safe.

    Trace ids have no place in an MCAP message: those of a chunk are its last message, on a topic of their own.
    """

    def __init__(self, path: Path, about: Mapping[str, Any]) -> None:
        """Create the file and write what the recording is about.

        Raises:
            RecordingError: it is there already, or cannot be written.
        """
        self.path = path
        self.messages = 0
        self._file = AppendedFile(path)
        self._writer = Writer(self._file, chunk_size=_OURS_ALONE, compression=CompressionType.ZSTD)  # type: ignore[arg-type]
        self._channels: dict[tuple[tuple[str, str, str], str], int] = {}  # by key, message and kind, and writer
        self._about: set[tuple[str, str, str]] = set()
        self._schemas: dict[str, int] = {"": 0}
        self._traces: list[tuple[int, int, str]] = []
        self._traces_channel = 0
        self._waiting = 0  # bytes in the chunk that is not written yet
        self._newest = 0
        self._writer.start(profile=PROFILE)
        self.describe(ABOUT, about)

    @property
    def size(self) -> int:
        """Bytes on disk."""
        return self._file.tell()

    def describe(self, name: str, values: Mapping[str, Any]) -> None:
        """Write a metadata record; what is not text is written as JSON."""
        texts = {key: value if isinstance(value, str) else json.dumps(value) for key, value in values.items()}
        self._writer.add_metadata(name, texts)

    def add(self, sample: Sample) -> bool:
        """Write a message, unless too many keys are in the file for one more; whether it was.

        It is on disk after the next `flush`, or when the chunk is full.

        Raises:
            WriteFailed: the disk takes no more.
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
        self._waiting += _BESIDE + len(sample.payload)
        if self._waiting >= CHUNK_BYTES:
            self.flush()
        return True

    def _channel_of(self, sample: Sample) -> int | None:
        """The channel of a message; of too many writers one for all others, of a key too many or too long none."""
        writer, about = sample.writer, (sample.key, sample.message, sample.kind)
        if (about, writer) not in self._channels and len(self._channels) >= MOST_CHANNELS:
            if about not in self._about:
                return None
            writer = ""
        if len(sample.key) > LONGEST_KEY or len(sample.message) > MAX_NAME:
            return None
        if (about, writer) not in self._channels:
            self._about.add(about)
            self._channels[about, writer] = self._writer.register_channel(
                sample.key, "msgpack", self._schema_of(sample), {"kind": sample.kind, "writer": writer}
            )
        return self._channels[about, writer]

    def _schema_of(self, sample: Sample) -> int:
        message = sample.message
        if message not in self._schemas:
            data = sample.schema or schema_of(message)
            self._schemas[message] = self._writer.register_schema(message, "jsonschema" if data else "", data)
        return self._schemas[message]

    def flush(self) -> None:
        """Put everything on disk that was written so far, as one chunk.

        Raises:
            WriteFailed: the disk takes no more.
        """
        self._add_traces()
        self._writer.flush()  # type: ignore[no-untyped-call]
        self._waiting = 0

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
        """Write the rest, how it ended and the index, and close the file.

        Raises:
            WriteFailed: the disk takes no more.
        """
        try:
            self.flush()
            if ended is not None:
                self.describe(ENDED, ended)
            self._writer.finish()  # type: ignore[no-untyped-call]
        finally:
            self._file.close()

    def abandon(self) -> None:
        """Close the file as it is, after a failure."""
        self._file.close()


MOST_STATES = 500  # with which a file begins: those that were said last


class SplitWriter:
    """Writes FILE.mcap, or FILE_0.mcap, FILE_1.mcap, ... of about `max_bytes` each.

    A file after the first begins with the last value of every state and with the same descriptions, so that each can
    be used alone.
    """

    def __init__(self, path: Path, about: Mapping[str, Any], max_bytes: int | None = None) -> None:
        """Create the first file.

        Raises:
            RecordingError: it is there already, or cannot be written.
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
        """Messages in all files; a state that opens a file counts again."""
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
        """Write a metadata record, also into the files that follow."""
        self._descriptions[name] = values
        self._file.describe(name, values)

    def add(self, sample: Sample) -> bool:
        """Write a message; whether there was room for its key.

        Raises:
            RecordingError: the disk takes no more.
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
            self._next(sample.log_time)
        return written

    def _next(self, now: int) -> None:
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
        """Put everything on disk.

        Raises:
            WriteFailed: the disk takes no more.
        """
        self._file.flush()

    def close(self, ended: Mapping[str, Any] | None = None) -> None:
        """Write the rest and how it ended, and close.

        Raises:
            WriteFailed: the disk takes no more.
        """
        self._file.close(ended)

    def abandon(self) -> None:
        """Close as it is, after a failure."""
        self._file.abandon()
