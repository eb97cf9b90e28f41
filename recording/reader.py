"""Reads recordings, finished or not: their description, and their messages in order. Repairs truncated ones."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

import msgpack
from mcap.records import Channel, Message, Schema

from common.remapping import is_cell
from recording.formatting import format_bytes
from recording.mcap_layout import (
    DAMAGE,
    LEAST_MESSAGE,
    MESSAGES_FREE,
    ChunkPosition,
    Layout,
    read_layout,
    records_of,
)
from recording.sample import BAD_PAYLOAD, RecordingError, Sample, topic_of
from recording.writer import ABOUT, ENDED, RUN, TRACES_SCHEMA, ExportFailed, RecordingWriter, WriteFailed

Wanted = Callable[[str], bool]  # takes a topic: the key without the cell
MOST_SPEED = 1000.0
LAST = 2**64 - 1  # [ns] highest log time
MOST_TEXT = 1000  # [characters] of a value, or values of a list


@dataclass(frozen=True)
class Run:
    """The recorded run."""

    speed: float  # cell seconds per wall second
    epoch: int  # wall time at which cell time started [ns]; 0 if unknown
    seed: int | None
    world: str  # selected for the run; empty for that of the cell
    overrides: tuple[str, ...]


def _all(_topic: str) -> bool:
    return True


class Recording:
    """An open recording; use it in a `with` block."""

    def __init__(self, path: Path, on_progress: Callable[[float], None] = lambda part: None) -> None:
        """Open a file and scan its layout.

        Args:
            path: of the file.
            on_progress: called again and again with the part of the file at which it is read.

        Raises:
            RecordingError: the file does not exist, cannot be read, or is no recording of zencell.
        """
        self.path = path
        if path.exists() and not path.is_file():
            raise RecordingError(f"{path}: is not a regular file")  # opening a pipe would wait for its writer
        try:
            self.file: BinaryIO = path.open("rb")
        except FileNotFoundError:
            raise RecordingError(f"{path}: no such file") from None
        except OSError as error:
            raise RecordingError(f"{path}: cannot be read: {error.strerror}") from None
        try:
            self.layout: Layout = read_layout(self.file, path, on_progress)
        except BaseException:
            self.file.close()
            raise
        self._on_progress = on_progress
        offsets = [*(chunk.offset for chunk in self.layout.chunks), self.layout.size]
        self._unread = {here: after - here for here, after in pairwise(offsets)}  # [bytes] of chunks with their index
        self._count = self._bytes = 0  # of the chunks that were read
        self._schemas: dict[int, Schema] = dict(self.layout.schemas)
        self._channels: dict[int, Channel] = dict(self.layout.channels)
        self._channels_known = self.layout.finished  # otherwise they are described among the messages

    def __enter__(self) -> Recording:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.file.close()

    # --- description --------------------------------------------------------------------------------------------------

    @property
    def finished(self) -> bool:
        """Whether the file was closed and has no hole; if not, `zencell recover` repairs it."""
        return self.layout.finished

    @property
    def flaw(self) -> str:
        """Why the recording is not finished; empty if it is."""
        if holes := self.layout.holes:
            return f"damaged: {format_bytes(sum(holes))} in {len(holes)} place{'s'[len(holes) == 1:]} are no records"
        return "" if self.finished else "not finished: the recorder was killed or is still recording"

    @property
    def start(self) -> int:
        """Log time of the first message [ns]; 0 without one."""
        return min((chunk.start for chunk in self.layout.chunks), default=0)

    @property
    def end(self) -> int:
        """Log time of the last message [ns]; 0 without one."""
        return max((chunk.end for chunk in self.layout.chunks), default=0)

    @property
    def seconds(self) -> float:
        """Duration [s]."""
        return (self.end - self.start) * 1e-9

    def metadata(self, name: str) -> dict[str, Any]:
        """Return the newest metadata record of a name; empty without one."""
        for record in reversed(self.layout.metadata):
            if record.name == name:
                return {key: _value(text) for key, text in record.metadata.items()}
        return {}

    @property
    def cell(self) -> str:
        """Name of the cell; empty if the file has none.

        Raises:
            RecordingError: the name is invalid.
        """
        # Not parsed as JSON: a cell may be called 1 or true.
        records = (record.metadata for record in reversed(self.layout.metadata) if record.name == ABOUT)
        found = next(records, {}).get("cell", "")
        if not found or is_cell(found):
            return found
        raise self._invalid("cell", found, "the name of a cell")

    @property
    def run(self) -> Run:
        """The recorded run.

        Raises:
            RecordingError: its description is invalid.
        """
        values = self.metadata(RUN)
        speed, epoch, seed = values.get("speed") or 1.0, values.get("epoch") or 0, values.get("seed")
        if not isinstance(speed, int | float) or not 0 < speed <= MOST_SPEED:
            raise self._invalid("speed", speed, f"more than 0 and at most {MOST_SPEED:g}")
        if not isinstance(epoch, int) or not 0 <= epoch < 2**63:
            raise self._invalid("epoch", epoch, "a time in ns")
        if seed is not None and not (isinstance(seed, int) and abs(seed) < 2**64):
            raise self._invalid("seed", seed, "a whole number")
        world, overrides = values.get("world") or "", values.get("overrides") or []
        if not isinstance(world, str) or len(world) > MOST_TEXT:
            raise self._invalid("world", world, "the name of a world")
        short = isinstance(overrides, list) and len(overrides) <= MOST_TEXT
        if not short or not all(isinstance(text, str) and len(text) <= MOST_TEXT for text in overrides):
            raise self._invalid("overrides", overrides, "a list of PATH=VALUE")
        return Run(float(speed), epoch, seed, world, tuple(overrides))

    def lost(self, how: str) -> dict[str, int]:
        """Return the number of messages by topic that the recorder `dropped`, or `missed` on the network.

        Raises:
            RecordingError: the description of these is invalid.
        """
        values = self.metadata(ENDED).get(how) or {}
        if not isinstance(values, dict) or not all(isinstance(n, int) and 0 <= n < 2**63 for n in values.values()):
            raise self._invalid(how, values, "numbers of messages by key")
        counts: Counter[str] = Counter()
        for key, count in values.items():
            counts[topic_of(key)] += count
        return dict(counts)

    def _invalid(self, name: str, value: object, valid: str) -> RecordingError:
        return RecordingError(f"{self.path}: has {name} {repr(value)[:60]}, which is not {valid}")

    def topics(self) -> dict[str, tuple[str, str]]:
        """Return message class and kind of each topic with messages; reads all of an unfinished recording.

        Raises:
            RecordingError: a chunk is damaged; names where.
        """
        if not self.finished or not all(chunk.channels for chunk in self.layout.chunks):
            return {sample.topic: (sample.message, sample.kind) for sample in self.samples()}
        used = sorted(set().union(*(chunk.channels for chunk in self.layout.chunks)))
        if not self._channels.keys() >= set(used):
            raise RecordingError(f"{self.path}: has messages of channels that it does not describe")
        found = [(self._channels[i], self._name(i)) for i in used if self._name(i) != TRACES_SCHEMA]
        return {topic_of(channel.topic): (name, channel.metadata.get("kind", "stream")) for channel, name in found}

    # --- messages -----------------------------------------------------------------------------------------------------

    def samples(self, wants: Wanted = _all, since: int = 0, until: int = LAST) -> Iterator[Sample]:
        """Yield the messages of wanted topics between two log times [ns], in the order of arrival.

        Raises:
            RecordingError: a chunk is damaged; names where.
        """
        for chunk in self.layout.chunks:
            if self._channels_known and (chunk.end < since or chunk.start > until):
                continue
            if self.finished and not self._may_have(chunk, wants):
                continue
            yield from self.samples_of(self._records(chunk), wants, since, until)
        self._channels_known = True

    def states_before(self, time: int, wants: Wanted = _all) -> list[Sample]:
        """Return the newest value of each wanted state before a log time [ns], oldest first.

        Raises:
            RecordingError: a chunk is damaged; names where.
        """
        def is_state(channel: Channel) -> bool:
            return channel.metadata.get("kind") == "state" and wants(topic_of(channel.topic))

        found: dict[tuple[str, str], Sample] = {}
        for chunk in self.layout.chunks:
            if chunk.start >= time:
                break
            known = self.finished and chunk.channels
            if known and not any(is_state(self._channels[i]) for i in chunk.channels if i in self._channels):
                continue
            for sample in self.samples_of(self._records(chunk), wants, 0):
                if sample.kind == "state" and sample.log_time < time:
                    found[sample.key, sample.writer] = sample
        newest: dict[str, Sample] = {}
        for sample in sorted(found.values(), key=lambda s: s.log_time):
            newest.pop(sample.key, None)
            newest[sample.key] = sample
        return list(newest.values())

    def _may_have(self, chunk: ChunkPosition, wants: Wanted) -> bool:
        if not chunk.channels:
            return True
        return any(wants(topic_of(self._channels[i].topic)) for i in chunk.channels if i in self._channels)

    def _records(self, chunk: ChunkPosition) -> list[Any]:
        self._on_progress(chunk.offset / self.layout.size)
        try:
            records = records_of(self.file, chunk)
        except DAMAGE:
            where = f"{self.path}: is damaged at byte {chunk.offset}"
            raise RecordingError(f"{where}; to save the rest: zencell recover {self.path}") from None
        return self.counted(chunk, records)

    def counted(self, chunk: ChunkPosition, records: list[Any]) -> list[Any]:
        """Return the records of a chunk.

        Raises:
            RecordingError: with those of other chunks they are more than a real file has in as many bytes.
        """
        if chunk.offset in self._unread:
            self._count += len(records)
            self._bytes += self._unread.pop(chunk.offset)
        if self._count > MESSAGES_FREE + self._bytes / LEAST_MESSAGE:
            raise RecordingError(f"{self.path}: has {self._count:,} messages in {self._bytes:,} B, "
                                 "more than a real recording has")
        return records

    def samples_of(
        self, records: list[Any], wants: Wanted = _all, since: int = 0, until: int = LAST
    ) -> Iterator[Sample]:
        """Yield the wanted messages among the records of a chunk, and remember its schemas and channels."""
        messages: list[Message] = []
        traces: dict[tuple[int, int], str] = {}
        for record in records:
            if isinstance(record, Schema):
                self._schemas[record.id] = record
            elif isinstance(record, Channel):
                self._channels[record.id] = record
            elif isinstance(record, Message) and record.channel_id in self._channels:
                if self._name(record.channel_id) == TRACES_SCHEMA:
                    traces |= _traces(record.data)
                else:
                    messages.append(record)
        for message in messages:
            channel = self._channels[message.channel_id]
            if since <= message.log_time <= until and wants(topic_of(channel.topic)):
                yield Sample(
                    channel.topic, message.data, message.log_time, message.publish_time,
                    self._name(message.channel_id), channel.metadata.get("kind", "stream"),
                    channel.metadata.get("writer", ""), message.sequence,
                    traces.get((message.channel_id, message.sequence), ""), *self._described(channel),
                )

    def _described(self, channel: Channel) -> tuple[bytes, tuple[str, dict[str, str], str] | None]:
        """Return the schema of a channel, and what a copy needs to know about one of another program."""
        schema = self._schemas.get(channel.schema_id)
        data, encoding = (schema.data, schema.encoding) if schema else (b"", "")
        own = channel.message_encoding == "msgpack"
        return data, None if own else (channel.message_encoding, channel.metadata, encoding)

    def unknown(self, records: list[Any]) -> int:
        """Return the number of messages whose channel is not described, so that their topic is unknown."""
        return sum(isinstance(record, Message) and record.channel_id not in self._channels for record in records)

    def _name(self, channel: int) -> str:
        schema = self._schemas.get(self._channels[channel].schema_id)
        return schema.name if schema else ""


def _value(text: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return text


def _traces(data: bytes) -> dict[tuple[int, int], str]:
    try:
        return {(channel, sequence): str(trace) for channel, sequence, trace in msgpack.unpackb(data)["traces"]}
    except (*BAD_PAYLOAD, LookupError):
        return {}  # the messages are usable without


# --- repair -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Recovered:
    """What was saved, and what was lost."""

    messages: int
    seconds: float
    was_finished: bool
    lost_bytes: int  # after the last record
    damaged_chunks: int
    holes: list[int]  # [bytes] of each part between records
    unknown: int  # messages whose topic is lost


def recover(source: Path, target: Path, on_progress: Callable[[float], None] = lambda part: None) -> Recovered:
    """Copy every undamaged chunk of a recording to a new file with an index, also those behind a hole.

    Raises:
        RecordingError: the source is no recording, or the target exists already or cannot be written.
    """
    if target.exists():
        raise RecordingError(f"{target}: exists already; choose another name")
    part = target.with_name(target.name + ".part")
    part.unlink(missing_ok=True)
    try:
        with Recording(source, on_progress) as recording:
            saved = _copy(recording, part)
        part.replace(target)
    except WriteFailed as error:
        raise ExportFailed(target, error.why) from None
    finally:
        part.unlink(missing_ok=True)
    return saved


def _copy(recording: Recording, target: Path) -> Recovered:
    layout = recording.layout
    writer = RecordingWriter(target, recording.metadata(ABOUT))
    damaged = unknown = 0
    try:
        names = dict.fromkeys(record.name for record in layout.metadata if record.name != ABOUT)
        for name in names:
            writer.describe(name, recording.metadata(name))
        for chunk in layout.chunks:
            try:
                records = recording.counted(chunk, records_of(recording.file, chunk))
            except DAMAGE:
                damaged += 1
                continue
            samples = list(recording.samples_of(records))
            unknown += recording.unknown(records)
            for sample in samples:
                writer.add(sample)
    except BaseException:
        writer.abandon()
        raise
    lost = layout.unread
    ended = {} if layout.closed else {"reason": "cut", "lost_bytes": lost}
    writer.close({**recording.metadata(ENDED), **ended, "recovered": True, "damaged_chunks": damaged,
                  "holes": layout.holes})
    return Recovered(writer.messages, recording.seconds, layout.closed, lost, damaged, layout.holes, unknown)
