"""Bounded queue between network and disk, with a thread that writes it to a file."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from recording.sample import RecordingError, Sample
from recording.writer import SplitWriter

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
