"""Log lines as text or JSON on stderr and as messages on `log`, and a writer that drops lines instead of blocking.

A reader stalls on Ctrl-S, behind a full pipe or on a full disk.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
import select
import sys
import threading
from collections import deque
from collections.abc import Callable
from typing import Any, Literal, TextIO, cast

from common import topics
from common.messages import LogLine
from common.terminal import printable
from common.transport.bus import Bus
from common.transport.session import call_on_loop

FLUSH_SECONDS = 0.3  # for the last lines when a process ends


class _TextFormatter(logging.Formatter):
    def __init__(self, service: str) -> None:
        super().__init__(f"%(levelname)s {service}: %(message)s")

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802, D102
        return printable(super().formatMessage(record).rstrip())

    def formatException(self, ei: Any) -> str:  # noqa: N802, D102
        return printable(super().formatException(ei), keep="\n\t")


class _JsonFormatter(logging.Formatter):
    def __init__(self, service: str) -> None:
        super().__init__()
        self._service = service

    def format(self, record: logging.LogRecord) -> str:
        line = {
            "time": round(record.created, 6),
            "level": record.levelname.lower(),
            "service": self._service,
            "message": record.getMessage(),
        }
        if record.exc_info:
            line["traceback"] = self.formatException(record.exc_info)
        return json.dumps(line)


class _DroppingHandler(logging.Handler):
    """Writes lines to stderr and never blocks: lines are dropped while the reader is stalled."""

    def __init__(self, formatter: logging.Formatter) -> None:
        super().__init__()
        self.setFormatter(formatter)
        self._out = DroppingWriter(sys.stderr, lambda lines: self.format(logging.LogRecord(
            __name__, logging.WARNING, "", 0, lost_lines_text(lines), None, None)))

    def emit(self, record: logging.LogRecord) -> None:
        try:
            self._out.put(f"{self.format(record)}\n")
        except Exception:  # noqa: BLE001 - as every handler of logging
            self.handleError(record)

    def flush(self) -> None:
        self._out.flush(FLUSH_SECONDS)


def log_to_stderr(service: str, *, as_json: bool) -> None:
    """Write the process's log lines of level info and above to stderr, without blocking."""
    handler = _DroppingHandler(_JsonFormatter(service) if as_json else _TextFormatter(service))
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(logging.INFO)
    logging.captureWarnings(True)


Level = Literal["debug", "info", "warning", "error", "critical"]


class BusLog(logging.Handler):
    """Publishes log lines on the topic `log` while it has subscribers."""

    def __init__(self, bus: Bus) -> None:
        super().__init__(logging.INFO)
        self._bus = bus
        self._writer = bus.writer(topics.LOG)
        self._loop = asyncio.get_running_loop()
        self._thread = threading.get_ident()
        self._publishing = threading.local()

    def emit(self, record: logging.LogRecord) -> None:
        """Publish one line, unless it was logged by publishing another one."""
        if getattr(self._publishing, "now", False):
            return
        message = record.getMessage()
        if record.exc_info and record.exc_info[1] is not None:
            message += f" ({type(record.exc_info[1]).__name__}: {record.exc_info[1]})"
        level = cast(Level, record.levelname.lower())
        if threading.get_ident() == self._thread:
            self._publish(level, message)
        else:
            call_on_loop(self._loop, lambda: self._publish(level, message))

    def _publish(self, level: Level, message: str) -> None:
        self._publishing.now = True
        try:
            if self._writer.matched:
                header = self._bus.header()
                self._writer.put(LogLine(header=header, service=self._bus.service, level=level, message=message))
        finally:
            self._publishing.now = False


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
