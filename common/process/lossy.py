"""Text for whoever reads stderr or stdout, who may stop reading (Ctrl-S, a pipe, a disk that is full): nobody waits."""

from __future__ import annotations

import os
import select
import threading
from collections import deque
from collections.abc import Callable
from typing import TextIO

MOST_BYTES = 1_000_000  # that wait; what comes when there are so many is lost


def told_lost(lines: int, why: str = "nobody read them") -> str:
    """What is said of lines that were lost."""
    return f"{lines} line{'s were' if lines > 1 else ' was'} lost: {why}"


class LossyWriter:
    """Writes to a stream from a thread of its own, in order; `put` never waits.

    A stream that is no file of the system, such as a text in memory, is written to at once.
    """

    def __init__(self, stream: TextIO, lost: Callable[[int], str] = told_lost, most: int = MOST_BYTES) -> None:
        """Write to a stream.

        Args:
            stream: stderr, for example.
            lost: what is written, as a line, of so many texts that were lost, once somebody reads again.
            most: bytes that may wait.
        """
        self._stream, self._told, self._most = stream, lost, most
        try:
            self._file: int | None = stream.fileno()
        except (OSError, ValueError, AttributeError):
            self._file = None
        self._waiting: deque[bytes] = deque()
        self._bytes = 0  # that wait, also those being written
        self._lost = 0
        self._dead = False  # nobody will ever read
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None

    def put(self, text: str) -> None:
        """Have it written soon, or count it as lost."""
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
        """Return when all is written, or after so long [s]."""
        with self._changed:
            self._changed.wait_for(lambda: self._dead or not (self._bytes or self._lost), seconds)

    def _write(self, file: int) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._lost)
                if self._waiting:
                    data = self._waiting.popleft()
                else:
                    data = f"{self._told(self._lost)}\n".encode()
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
        except BlockingIOError:  # whoever gave us the file wants no waiting
            select.select([], [file], [])
