"""Between the network and the disk: a bounded queue, and the thread that empties it into a file."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from recording.sample import RecordingError, Sample
from recording.writer import SplitWriter

MOST_BYTES = 256 * 1024 * 1024  # that wait while the disk stalls: ten seconds of the most that cameras send
MOST_SAMPLES = 200_000
MAX_KEYS, OTHERS = 1000, "others"  # of which it is counted what was dropped, and what all others are called
BATCH_SECONDS = 0.1  # between looks into the queue
FLUSH_SECONDS = 0.8  # between chunks: with the batch, a kill costs less than a second


@dataclass(frozen=True)
class RecordingStats:
    """How a recording goes."""

    messages: int
    size: int  # [bytes] on disk
    seconds: float
    dropped: dict[str, int] = field(default_factory=dict)  # by key: the disk was too slow, or the file is full of keys


class Sink:
    """Takes samples from any thread without ever blocking, and writes them in one of its own.

    What does not fit while the disk stalls is dropped and counted by key, and so is what is under one key too many.
    """

    def __init__(
        self, writer: SplitWriter, *, max_bytes: int = MOST_BYTES, on_failure: Callable[[], None] = lambda: None,
    ) -> None:
        """Start writing.

        Args:
            writer: is used by this sink alone from now on.
            max_bytes: payload that may wait [bytes].
            on_failure: called once, on the writing thread, when the disk takes no more; `error` says why.
        """
        self.error: RecordingError | None = None
        self._writer = writer
        self._most = max_bytes
        self._on_failure = on_failure
        self._changed = threading.Condition()
        self._waiting: deque[Sample] = deque()
        self._descriptions: deque[tuple[str, Mapping[str, Any]]] = deque()
        self._bytes = 0
        self._dropped: Counter[str] = Counter()
        self._closing = False
        self._began = time.monotonic()
        self._crash: BaseException | None = None
        self._thread = threading.Thread(target=self._guarded, name="write recording", daemon=True)
        self._thread.start()

    def offer(self, sample: Sample) -> None:
        """Have a sample written, or dropped and counted; from any thread."""
        with self._changed:
            if self._closing or self.error is not None:
                return
            if self._bytes + len(sample.payload) > self._most or len(self._waiting) >= MOST_SAMPLES:
                self._drop(sample.key)
                return
            self._waiting.append(sample)
            self._bytes += len(sample.payload)

    def _drop(self, key: str) -> None:
        self._dropped[key if key in self._dropped or len(self._dropped) < MAX_KEYS else OTHERS] += 1

    def describe(self, name: str, values: Mapping[str, Any]) -> None:
        """Have a metadata record written; from any thread."""
        with self._changed:
            self._descriptions.append((name, values))

    @property
    def figures(self) -> RecordingStats:
        """How it goes."""
        with self._changed:
            dropped = dict(self._dropped)
        return RecordingStats(self._writer.messages, self._writer.size, time.monotonic() - self._began, dropped)

    def close(self, ended: Mapping[str, Any]) -> RecordingStats:
        """Write what waits and how it ended, close the file, and say how it went; may block.

        Raises:
            RecordingError: the disk took no more, now or earlier.
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
        self._writer.close({**ended, "dropped": self.figures.dropped})
        return self.figures

    def _guarded(self) -> None:
        try:
            self._work()
        except RecordingError as error:
            self.error = error
        except BaseException as error:  # a bug: is raised where the sink is closed
            self._crash = error
        else:
            return
        with self._changed:
            self._waiting.clear()
            self.error = self.error or RecordingError("recording stopped")
        self._on_failure()

    def _work(self) -> None:
        flush_at = time.monotonic() + FLUSH_SECONDS
        while True:
            with self._changed:
                # Not for each message: a wake-up costs more than writing a small one.
                self._changed.wait_for(lambda: self._closing, timeout=BATCH_SECONDS)
                samples, self._waiting = self._waiting, deque()
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
            if closing:  # nothing is taken any more since
                return
            if time.monotonic() >= flush_at:
                self._writer.flush()
                flush_at = time.monotonic() + FLUSH_SECONDS
