"""Reads recordings: what they are about, and their messages in order; finished or not."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

import msgpack
from mcap.records import Channel, Message, Schema

from common.remapping import is_cell
from recording.mcap_layout import DAMAGE, ChunkPlace, Layout, read_layout, records_of
from recording.sample import RecordingError, Sample
from recording.writer import ABOUT, ENDED, RUN, TRACES_SCHEMA, ExportFailed, RecordingWriter, WriteFailed

Wanted = Callable[[str], bool]  # is given a topic: the key without the cell
MOST_SPEED = 1000.0
LAST = 2**64 - 1  # [ns] no log time is later
MOST_TEXT = 1000  # [characters] of a value, or values of a list


@dataclass(frozen=True)
class Run:
    """What a recording tells of the run that it is of."""

    speed: float  # cell seconds per wall second
    epoch: int  # wall time at which cell time began [ns]; 0 where it is not told
    seed: int | None
    world: str  # that was given for the run; empty for that of the cell
    overrides: tuple[str, ...]


def _all(_topic: str) -> bool:
    return True


class Recording:
    """An open recording; use it in a `with` block."""

    def __init__(self, path: Path) -> None:
        """Open a file and look where what lies.

        Raises:
            RecordingError: there is no such file, it cannot be read, or is no recording of ours.
        """
        self.path = path
        try:
            self.file: BinaryIO = path.open("rb")
        except FileNotFoundError:
            raise RecordingError(f"{path}: there is no such file") from None
        except OSError as error:
            raise RecordingError(f"{path}: cannot be read: {error.strerror}") from None
        try:
            self.layout: Layout = read_layout(self.file, path)
            if self.layout.loose_messages:
                raise RecordingError(f"{path}: has messages outside of chunks, which no recording of zencell has")
        except BaseException:
            self.file.close()
            raise
        self._schemas: dict[int, Schema] = dict(self.layout.schemas)
        self._channels: dict[int, Channel] = dict(self.layout.channels)
        self._described = self.layout.finished  # whether all channels are known; else they stand among the messages

    def __enter__(self) -> Recording:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.file.close()

    # --- what it is about -----------------------------------------------------------------------------------------

    @property
    def finished(self) -> bool:
        """Whether it was closed; if not, `zencell recover` makes it whole."""
        return self.layout.finished

    @property
    def start(self) -> int:
        """Log time of the first message [ns]; 0 without one."""
        return min((place.start for place in self.layout.chunks), default=0)

    @property
    def end(self) -> int:
        """Log time of the last message [ns]; 0 without one."""
        return max((place.end for place in self.layout.chunks), default=0)

    @property
    def seconds(self) -> float:
        """How long it is [s]."""
        return (self.end - self.start) * 1e-9

    def metadata(self, name: str) -> dict[str, Any]:
        """What a metadata record says, the newest of that name; empty without one."""
        for record in reversed(self.layout.metadata):
            if record.name == name:
                return {key: _value(text) for key, text in record.metadata.items()}
        return {}

    @property
    def cell(self) -> str:
        """Name of the cell, empty for a file that does not say.

        Raises:
            RecordingError: it is none.
        """
        # As it was written: a cell may be called 1, or true.
        told = (record.metadata for record in reversed(self.layout.metadata) if record.name == ABOUT)
        found = next(told, {}).get("cell", "")
        if not found or is_cell(found):
            return found
        raise self._wrong("cell", found, "the name of a cell")

    @property
    def run(self) -> Run:
        """What is told of the run.

        Raises:
            RecordingError: it cannot be so.
        """
        told = self.metadata(RUN)
        speed, epoch, seed = told.get("speed") or 1.0, told.get("epoch") or 0, told.get("seed")
        if not isinstance(speed, int | float) or not 0 < speed <= MOST_SPEED:
            raise self._wrong("speed", speed, f"more than 0 and at most {MOST_SPEED:g}")
        if not isinstance(epoch, int) or not 0 <= epoch < 2**63:
            raise self._wrong("epoch", epoch, "a time in ns")
        if seed is not None and not (isinstance(seed, int) and abs(seed) < 2**64):
            raise self._wrong("seed", seed, "a whole number")
        world, overrides = told.get("world") or "", told.get("overrides") or []
        if not isinstance(world, str) or len(world) > MOST_TEXT:
            raise self._wrong("world", world, "the name of a world")
        short = isinstance(overrides, list) and len(overrides) <= MOST_TEXT
        if not short or not all(isinstance(text, str) and len(text) <= MOST_TEXT for text in overrides):
            raise self._wrong("overrides", overrides, "a list of PATH=VALUE")
        return Run(float(speed), epoch, seed, world, tuple(overrides))

    def lost(self, how: str) -> dict[str, int]:
        """Messages that are not in it, by topic: those that the recorder `dropped`, or `missed` on the way to it.

        Raises:
            RecordingError: that is not what it tells.
        """
        told = self.metadata(ENDED).get(how) or {}
        if not isinstance(told, dict) or not all(isinstance(n, int) and 0 <= n < 2**63 for n in told.values()):
            raise self._wrong(how, told, "numbers of messages by key")
        counts: Counter[str] = Counter()
        for key, count in told.items():
            counts[_topic(key)] += count
        return dict(counts)

    def _wrong(self, what: str, value: object, right: str) -> RecordingError:
        return RecordingError(f"{self.path}: tells a {what} of {repr(value)[:60]}, which is not {right}")

    def topics(self) -> dict[str, tuple[str, str]]:
        """Message class and kind of each topic that has messages; reads all of a recording that is not finished.

        Raises:
            RecordingError: a chunk is damaged; names where.
        """
        if not self.finished or not all(place.channels for place in self.layout.chunks):
            return {sample.topic: (sample.message, sample.kind) for sample in self.samples()}
        used = sorted(set().union(*(place.channels for place in self.layout.chunks)))
        if not self._channels.keys() >= set(used):
            raise RecordingError(f"{self.path}: has messages of channels that it does not describe")
        found = [(self._channels[i], self._name(i)) for i in used if self._name(i) != TRACES_SCHEMA]
        return {_topic(channel.topic): (name, channel.metadata.get("kind", "stream")) for channel, name in found}

    # --- what is in it --------------------------------------------------------------------------------------------

    def samples(self, wants: Wanted = _all, since: int = 0, until: int = LAST) -> Iterator[Sample]:
        """The messages of wanted topics from a log time [ns] on, up to another, in the order in which they came.

        Raises:
            RecordingError: a chunk is damaged; names where.
        """
        for place in self.layout.chunks:
            if self._described and (place.end < since or place.start > until):
                continue
            if self.finished and not self._may_have(place, wants):
                continue
            yield from self.samples_of(self._records(place), wants, since, until)
        self._described = True

    def states_before(self, time: int, wants: Wanted = _all) -> list[Sample]:
        """The last value of each wanted state before a log time [ns], oldest first.

        Raises:
            RecordingError: a chunk is damaged; names where.
        """
        def state(channel: Channel) -> bool:
            return channel.metadata.get("kind") == "state" and wants(_topic(channel.topic))

        found: dict[tuple[str, str], Sample] = {}
        for place in self.layout.chunks:
            if place.start >= time:
                break
            known = self.finished and place.channels
            if known and not any(state(self._channels[i]) for i in place.channels if i in self._channels):
                continue
            for sample in self.samples_of(self._records(place), wants, 0):
                if sample.kind == "state" and sample.log_time < time:
                    found[sample.key, sample.writer] = sample
        newest: dict[str, Sample] = {}
        for sample in sorted(found.values(), key=lambda s: s.log_time):
            newest.pop(sample.key, None)
            newest[sample.key] = sample
        return list(newest.values())

    def _may_have(self, place: ChunkPlace, wants: Wanted) -> bool:
        if not place.channels:
            return True
        return any(wants(_topic(self._channels[i].topic)) for i in place.channels if i in self._channels)

    def _records(self, place: ChunkPlace) -> list[Any]:
        try:
            return records_of(self.file, place)
        except DAMAGE:
            where = f"{self.path}: is damaged at byte {place.offset}"
            raise RecordingError(f"{where}; keep the rest with: zencell recover {self.path}") from None

    def samples_of(
        self, records: list[Any], wants: Wanted = _all, since: int = 0, until: int = LAST
    ) -> Iterator[Sample]:
        """The wanted messages among the records of a chunk; its schemas and channels are remembered."""
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
            if since <= message.log_time <= until and wants(_topic(channel.topic)):
                yield Sample(
                    channel.topic, message.data, message.log_time, message.publish_time,
                    self._name(message.channel_id), channel.metadata.get("kind", "stream"),
                    channel.metadata.get("writer", ""), message.sequence,
                    traces.get((message.channel_id, message.sequence), ""), self._schema(message.channel_id),
                )

    def _schema(self, channel: int) -> bytes:
        schema = self._schemas.get(self._channels[channel].schema_id)
        return schema.data if schema else b""

    def _name(self, channel: int) -> str:
        schema = self._schemas.get(self._channels[channel].schema_id)
        return schema.name if schema else ""


def _topic(key: str) -> str:
    return key.partition("/")[2]


def _value(text: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return text


def _traces(data: bytes) -> dict[tuple[int, int], str]:
    try:
        return {(channel, sequence): str(trace) for channel, sequence, trace in msgpack.unpackb(data)["traces"]}
    except (ValueError, TypeError, LookupError, msgpack.UnpackException, RecursionError):
        return {}  # they tell where messages came from, which are there without them


@dataclass(frozen=True)
class Recovered:
    """What was saved, and what was not."""

    messages: int
    seconds: float
    was_finished: bool
    lost_bytes: int  # after the last whole record
    damaged_chunks: int


def recover(source: Path, target: Path) -> Recovered:
    """What was saved of a recording into a new file that is whole and indexed.

    Every chunk that is whole in the source is in the target.

    Raises:
        RecordingError: the source is no recording, or the target is there already or cannot be written.
    """
    if target.exists():
        raise RecordingError(f"{target}: is there already; choose another name")
    beside = target.with_name(target.name + ".part")
    beside.unlink(missing_ok=True)
    try:
        with Recording(source) as recording:
            saved = _copy(recording, beside)
        beside.replace(target)
    except WriteFailed as error:
        raise ExportFailed(target, error.why) from None
    finally:
        beside.unlink(missing_ok=True)
    return saved


def _copy(recording: Recording, target: Path) -> Recovered:
    layout = recording.layout
    writer = RecordingWriter(target, recording.metadata(ABOUT))
    damaged = 0
    try:
        names = dict.fromkeys(record.name for record in layout.metadata if record.name != ABOUT)
        for name in names:
            writer.describe(name, recording.metadata(name))
        for place in layout.chunks:
            try:
                samples = list(recording.samples_of(records_of(recording.file, place)))
            except DAMAGE:
                damaged += 1
                continue
            for sample in samples:
                writer.add(sample)
    except BaseException:
        writer.abandon()
        raise
    lost = layout.size - layout.whole
    ended = {} if recording.finished else {"reason": "cut", "lost_bytes": lost}
    writer.close({**recording.metadata(ENDED), **ended, "recovered": True, "damaged_chunks": damaged})
    return Recovered(writer.messages, recording.seconds, recording.finished, 0 if recording.finished else lost, damaged)
