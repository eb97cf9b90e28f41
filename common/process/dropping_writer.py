"""A writer for stderr and stdout that never blocks: lines are dropped while the reader is stalled.

A reader stalls on Ctrl-S, behind a full pipe or on a full disk.
"""

from __future__ import annotations

import os
import select
import threading
from collections import deque
from collections.abc import Callable
from typing import TextIO

MOST_BYTES = 1_000_000  # queued; further text is dropped


def lost_lines_text(lines: int, why: str = "the reader was too slow") -> str:
    """Return the message about dropped lines."""
    return f"{lines} line{'s were' if lines > 1 else ' was'} dropped: {why}"


class DroppingWriter:
    """Writes to a stream from a thread, in order; `put` never blocks.

    A stream without a file descriptor, such as io.StringIO, is written to directly.
    """

    def __init__(self, stream: TextIO, lost: Callable[[int], str] = lost_lines_text, most: int = MOST_BYTES) -> None:
        """Write to a stream.

        Args:
            stream: stderr, for example.
            lost: makes the line that reports the number of dropped texts, once the reader continues.
            most: size of the queue [bytes].
        """
        self._stream, self._lost_line, self._most = stream, lost, most
        try:
            self._file: int | None = stream.fileno()
        except (OSError, ValueError, AttributeError):
            self._file = None
        self._waiting: deque[bytes] = deque()
        self._bytes = 0  # queued or being written
        self._lost = 0
        self._dead = False  # the reader has closed its end
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None

    def put(self, text: str) -> None:
        """Queue a text, or drop it if the queue is full."""
        if self._file is None:
            self._stream.write(text)
            self._stream.flush()
            return
        data = text.encode("utf-8", "backslashreplace")
        with self._changed:
            if self._dead:
                return
            if self._lost or self._bytes + len(data) > self._most:
                self._lost += 1
                return
            self._waiting.append(data)
            self._bytes += len(data)
            if self._thread is None:
                self._thread = threading.Thread(target=self._write, args=(self._file,), name="lines", daemon=True)
                self._thread.start()
            self._changed.notify_all()

    def flush(self, seconds: float = 0.5) -> None:
        """Return when the queue is written, at the latest after `seconds` [s]."""
        with self._changed:
            self._changed.wait_for(lambda: self._dead or not (self._bytes or self._lost), seconds)

    def _write(self, file: int) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._lost)
                if self._waiting:
                    data = self._waiting.popleft()
                else:
                    data = f"{self._lost_line(self._lost)}\n".encode()
                    self._lost = 0
                    self._bytes += len(data)
            try:
                _write_all(file, data)
            except OSError:
                with self._changed:
                    self._dead = True
                    self._waiting.clear()
                    self._changed.notify_all()
                return
            with self._changed:
                self._bytes -= len(data)
                self._changed.notify_all()


def _write_all(file: int, data: bytes) -> None:
    rest = memoryview(data)
    while rest:
        try:
            rest = rest[os.write(file, rest) :]
        except BlockingIOError:  # the file was opened as non-blocking
            select.select([], [file], [])
