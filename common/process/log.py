"""Log lines: `LEVEL service: text` or JSON on stderr, and on the topic `log` for everybody."""

from __future__ import annotations

import asyncio
import json
import logging
import sys
import threading
from typing import Any, Literal, cast

from common import topics
from common.messages import LogLine
from common.process.lossy import LossyWriter, told_lost
from common.terminal import printable
from common.transport.bus import Bus
from common.transport.session import call_on_loop

FLUSH_SECONDS = 0.3  # for what was said last when a process ends


class _Human(logging.Formatter):
    def __init__(self, service: str) -> None:
        super().__init__(f"%(levelname)s {service}: %(message)s")

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802, D102
        return printable(super().formatMessage(record).rstrip())

    def formatException(self, ei: Any) -> str:  # noqa: N802, D102
        return printable(super().formatException(ei), keep="\n\t")


class _Json(logging.Formatter):
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


class _Lossy(logging.Handler):
    """Writes lines to stderr as long as somebody reads them, and never waits."""

    def __init__(self, formatter: logging.Formatter) -> None:
        super().__init__()
        self.setFormatter(formatter)
        self._out = LossyWriter(sys.stderr, lambda lines: self.format(logging.LogRecord(
            __name__, logging.WARNING, "", 0, told_lost(lines), None, None)))

    def emit(self, record: logging.LogRecord) -> None:
        try:
            self._out.put(f"{self.format(record)}\n")
        except Exception:  # noqa: BLE001 - as every handler of logging
            self.handleError(record)

    def flush(self) -> None:
        self._out.flush(FLUSH_SECONDS)


def log_to_stderr(service: str, *, as_json: bool) -> None:
    """Write the process's log lines of level info and above to stderr, without ever waiting for who reads them."""
    handler = _Lossy(_Json(service) if as_json else _Human(service))
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(logging.INFO)
    logging.captureWarnings(True)


Level = Literal["debug", "info", "warning", "error", "critical"]


class BusLog(logging.Handler):
    """Puts log lines on the topic `log`, while somebody listens."""

    def __init__(self, bus: Bus) -> None:
        super().__init__(logging.INFO)
        self._bus = bus
        self._writer = bus.writer(topics.LOG)
        self._loop = asyncio.get_running_loop()
        self._thread = threading.get_ident()
        self._putting = threading.local()

    def emit(self, record: logging.LogRecord) -> None:
        """Put one line; what putting it logs is not put."""
        if getattr(self._putting, "now", False):
            return
        message = record.getMessage()
        if record.exc_info and record.exc_info[1] is not None:
            message += f" ({type(record.exc_info[1]).__name__}: {record.exc_info[1]})"
        level = cast(Level, record.levelname.lower())
        if threading.get_ident() == self._thread:
            self._put(level, message)
        else:
            call_on_loop(self._loop, lambda: self._put(level, message))

    def _put(self, level: Level, message: str) -> None:
        self._putting.now = True
        try:
            if self._writer.matched:
                header = self._bus.header()
                self._writer.put(LogLine(header=header, service=self._bus.service, level=level, message=message))
        finally:
            self._putting.now = False
