"""Log lines: `LEVEL service: text` or JSON on stderr, and as messages on the topic `log`."""

from __future__ import annotations

import asyncio
import json
import logging
import sys
import threading
from typing import Any, Literal, cast

from common import topics
from common.messages import LogLine
from common.process.dropping_writer import DroppingWriter, lost_lines_text
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
