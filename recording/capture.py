"""Capture messages of a cell from the network, queue them, and write them to a file on a thread."""

from __future__ import annotations

import asyncio
import json
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from common import topics
from common.application import all_topics, import_topics
from common.config import Cell
from common.errors import DecodeError
from common.messages import SupervisorStatus
from common.remapping import Remapping
from common.transport.codec import decode, decode_attachment
from common.transport.credentials import secure_folder
from common.transport.ownership import Owner
from common.transport.session import owns_key
from recording.reader import MOST_SPEED, MOST_TEXT
from recording.sample import RecordingError, Sample, Sequences, message_of
from recording.writer import RUN, SplitWriter, run_of

if TYPE_CHECKING:
    from common.transport.bus import Bus
    from common.transport.session import Declaration, RawSample
    from recording.selection import Selection

QUERY_TIMEOUT = 1.0  # [s] for the values of states
SILENCE, MANY = 5.0, 10  # [s] without a message after which a stream of so many messages has ceased


@dataclass(frozen=True)
class CustomTopics:
    """Topics of a cell that do not come with the project, and remapped keys."""

    modules: tuple[str, ...] = ()  # of the user
    renamed: tuple[Mapping[str, str], ...] = ()  # remapping of each service, see common/remapping.py

    @classmethod
    def of(cls, cell: Cell) -> CustomTopics:
        """Return those of a cell."""
        services = cell.services.values()
        modules = dict.fromkeys([cell.application, *(entry.module for entry in services)])
        custom = (name for name in modules if "." in name and not name.startswith("services."))
        return cls(tuple(custom), tuple(cell.tables))

    @classmethod
    def read(cls, text: str) -> CustomTopics:
        """Return the object that `str` wrote."""
        return cls(*(tuple(part) for part in json.loads(text)))

    def __str__(self) -> str:
        return json.dumps([self.modules, self.renamed])

    def topics(self) -> dict[str, Any]:
        """Import the modules, so that their messages can be decoded; return all topics by key before remapping."""
        return {**all_topics(), **import_topics(self.modules)}

    def kinds(self, known: Mapping[str, Any]) -> dict[str, str]:
        """Return the kinds of known topics by key in the cell."""
        kinds = {key: str(topic.kind) for key, topic in known.items()}
        return kinds | {Remapping(table).key(key): kind for table in self.renamed for key, kind in kinds.items()}


class Capture:
    """Passes each selected message once to a sink, and counts gaps."""

    def __init__(self, bus: Bus, selection: Selection, sink: Sink, custom: CustomTopics | None = None) -> None:
        """Prepare without subscribing.

        Args:
            bus: in the cell.
            selection: of the messages.
            sink: receives them.
            custom: topics of the cell that do not come with the project.
        """
        self.sequences = Sequences()
        self._bus = bus
        self._selection = selection
        self._sink = sink
        self._lock = threading.Lock()
        # A step of the system clock must not reorder messages.
        self._wall_offset = time.time_ns() - time.monotonic_ns()
        custom = custom or CustomTopics()
        self._known = custom.topics()
        self._kinds = custom.kinds(self._known)
        self._run_known = False
        self._streams: dict[str, tuple[int, int]] = {}  # count of messages, and log time of the newest one, by key
        self._declared: list[Declaration] = []

    async def start(self) -> None:
        """Subscribe; returns when the current values of all states are recorded."""
        expressions = [f"{self._bus.cell}/{key}" for key in self._selection.expressions]
        # Without the cell's file, liveliness tokens show which services have remapped keys.
        self._declared = [self._bus.raw_watch_tokens(owns_key(self._bus.cell), self._on_owner)]
        status = f"{self._bus.cell}/{topics.SUPERVISOR_STATUS.key}"
        self._declared += [self._bus.raw_subscriber(key, self.on_sample) for key in expressions]
        if f"{self._bus.cell}/**" not in expressions and status not in expressions:
            self._declared.append(self._bus.raw_subscriber(status, self._on_status))
            for sample in await self._bus.raw_get(status, QUERY_TIMEOUT):
                self._on_status(sample)
        queries = (self._bus.raw_get(key, QUERY_TIMEOUT) for key in self._queried(expressions))
        for replies in await asyncio.gather(*queries):
            for sample in replies:
                self.on_sample(sample, kind="state")

    def _queried(self, expressions: list[str]) -> list[str]:
        """Return the keys to query for states; with access rules one by one.

        A client with the right to query every key could call every request, so the rules name the states.
        """
        if secure_folder() is None or f"{self._bus.cell}/**" not in expressions:
            return expressions
        return [f"{self._bus.cell}/{key}" for key, kind in self._kinds.items() if kind == "state"]

    def stop(self) -> None:
        """Unsubscribe."""
        while self._declared:
            self._declared.pop().undeclare()

    def on_sample(self, raw: RawSample, kind: str = "") -> None:
        """Take one message; thread-safe. `kind` is that of an unknown topic."""
        topic = raw.key.partition("/")[2]
        if topic == topics.SUPERVISOR_STATUS.key:
            self._on_status(raw)
        if not self._selection.wants(topic):
            return
        writer, sequence, trace = _origin(raw)
        with self._lock:  # so that times increase in the file
            if writer and not self.sequences.is_new(raw.key, writer, sequence):
                return
            now, kind = self._now_ns(), self._kinds.get(topics.general_key(topic)) or kind or "stream"
            commands = getattr(self._known.get(topics.general_key(topic)), "commands", False)
            if kind == "stream" and not commands and (topic in self._streams or len(self._streams) < MAX_KEYS):
                self._streams[topic] = self._streams.get(topic, (0, 0))[0] + 1, now
            self._sink.offer(Sample(
                raw.key, raw.payload, now, message=message_of(raw.encoding), kind=kind, writer=writer,
                sequence=sequence, trace=trace,
            ))

    def _now_ns(self) -> int:
        return time.monotonic_ns() + self._wall_offset

    def silent(self) -> dict[str, float]:
        """Return the streams that have ceased, such as that of a camera, and since when [s]."""
        with self._lock:
            streams = dict(self._streams)
        since = {topic: (self._now_ns() - at) * 1e-9 for topic, (count, at) in streams.items() if count >= MANY}
        return {topic: seconds for topic, seconds in since.items() if seconds > SILENCE}

    def _on_owner(self, token: str) -> None:
        owner = Owner.of(token)
        if (topic := self._known.get(owner.own)) is not None:
            self._kinds[owner.key] = str(topic.kind)

    def _on_status(self, raw: RawSample) -> None:
        """Describe the run from the first valid status of the supervisor."""
        if self._run_known:
            return
        try:
            status = decode(SupervisorStatus, raw.payload)
        except DecodeError:
            return
        if status.speed > MOST_SPEED or any(len(text) > MOST_TEXT for text in (status.world, *status.overrides)):
            return  # forged: `Recording` would refuse such a description
        self._run_known = True
        self._sink.describe(RUN, run_of(status))


def _origin(raw: RawSample) -> tuple[str, int, str]:
    """Return writer id, sequence number and trace id of a message; empty if it has no attachment."""
    try:
        attachment = decode_attachment(raw.attachment)
    except DecodeError:
        attachment = None
    return (attachment.writer, attachment.sequence, attachment.trace) if attachment else ("", 0, "")


MOST_BYTES = 256 * 1024 * 1024  # of queued payload: ten seconds of the highest camera rates
MOST_SAMPLES = 200_000  # in the queue
MAX_KEYS, OTHERS = 1000, "others"  # keys with a count of dropped messages of their own; name of the rest
BATCH_SECONDS = 0.1  # between two reads of the queue
FLUSH_SECONDS = 0.8  # between chunks: together with a batch, a kill costs less than a second


@dataclass(frozen=True)
class RecordingStats:
    """Progress of a recording."""

    messages: int
    size: int  # [bytes] on disk
    seconds: float
    dropped: dict[str, int] = field(default_factory=dict)  # by key: slow disk, or too many keys


class Sink:
    """Takes samples from any thread without blocking and writes them in a thread of its own.

    While the disk stalls, samples that do not fit into the queue are dropped and counted by key.
    """

    def __init__(
        self, writer: SplitWriter, *, max_bytes: int = MOST_BYTES, on_failure: Callable[[], None] = lambda: None,
    ) -> None:
        """Start the writing thread.

        Args:
            writer: used by this sink only.
            max_bytes: payload in the queue [bytes].
            on_failure: called once in the writing thread when the disk fails; `error` has the reason.
        """
        self.error: RecordingError | None = None
        self._writer = writer
        self._most = max_bytes
        self._on_failure = on_failure
        self._changed = threading.Condition()
        self._queue: deque[Sample] = deque()
        self._descriptions: deque[tuple[str, Mapping[str, Any]]] = deque()
        self._bytes = 0
        self._dropped: Counter[str] = Counter()
        self._closing = False
        self._started_at = time.monotonic()
        self._crash: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="write recording", daemon=True)
        self._thread.start()

    def offer(self, sample: Sample) -> None:
        """Queue a sample, or drop and count it; thread-safe."""
        with self._changed:
            if self._closing or self.error is not None:
                return
            if self._bytes + len(sample.payload) > self._most or len(self._queue) >= MOST_SAMPLES:
                self._drop(sample.key)
                return
            self._queue.append(sample)
            self._bytes += len(sample.payload)

    def _drop(self, key: str) -> None:
        self._dropped[key if key in self._dropped or len(self._dropped) < MAX_KEYS else OTHERS] += 1

    def describe(self, name: str, values: Mapping[str, Any]) -> None:
        """Queue a metadata record; thread-safe."""
        with self._changed:
            self._descriptions.append((name, values))

    @property
    def stats(self) -> RecordingStats:
        """Progress so far."""
        with self._changed:
            dropped = dict(self._dropped)
        return RecordingStats(self._writer.messages, self._writer.size, time.monotonic() - self._started_at, dropped)

    def close(self, ended: Mapping[str, Any]) -> RecordingStats:
        """Write the queue and how the recording ended, and close the file; may block.

        Raises:
            RecordingError: the disk failed, now or earlier.
        """
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join()
        if self._crash is not None:
            raise self._crash
        if self.error is not None:
            self._writer.abandon()
            raise self.error
        self._writer.close({**ended, "dropped": self.stats.dropped})
        return self.stats

    def _run(self) -> None:
        try:
            self._write()
        except RecordingError as error:
            self.error = error
        except BaseException as error:  # a bug: raised in `close`
            self._crash = error
        else:
            return
        with self._changed:
            self._queue.clear()
            self.error = self.error or RecordingError("recording stopped")
        self._on_failure()

    def _write(self) -> None:
        flush_at = time.monotonic() + FLUSH_SECONDS
        while True:
            with self._changed:
                # Not woken for each message: a wake-up costs more than writing a small one.
                self._changed.wait_for(lambda: self._closing, timeout=BATCH_SECONDS)
                samples, self._queue = self._queue, deque()
                descriptions, self._descriptions = self._descriptions, deque()
                closing = self._closing
            for name, values in descriptions:
                self._writer.describe(name, values)
            while samples:
                sample = samples.popleft()
                written = self._writer.add(sample)
                with self._changed:
                    self._bytes -= len(sample.payload)
                    if not written:
                        self._drop(sample.key)
                if time.monotonic() >= flush_at:
                    self._writer.flush()
                    flush_at = time.monotonic() + FLUSH_SECONDS
            if closing:  # nothing was queued since
                return
            if time.monotonic() >= flush_at:
                self._writer.flush()
                flush_at = time.monotonic() + FLUSH_SECONDS
