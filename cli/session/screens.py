"""Output of a running cell: lines of text or JSON on stderr, or a live table on a terminal."""

from __future__ import annotations

import io
import json
import logging
import os
import sys
import time
from collections.abc import Callable
from typing import Protocol, TextIO, cast

from cli.session.live_table import Content, LiveScreen
from common.process.dropping_writer import DroppingWriter, lost_lines_text
from common.terminal import printable


class Screen(Protocol):
    """Shows log lines and the state of the cell."""

    def line(self, service: str, text: str) -> None:
        """Show a line that a process wrote."""

    def note(self, text: str) -> None:
        """Show a line for the user."""

    def progress(self, text: str) -> None:
        """Show the progress of the task."""

    def close(self) -> None:
        """Restore the terminal."""


class PlainScreen:
    """Lines on stderr, each with the name of its process, without control characters; notes on stdout."""

    def __init__(self) -> None:
        """Write to the current stderr and stdout."""
        self._lines, self._notes = DroppingWriter(sys.stderr), DroppingWriter(sys.stdout)

    def line(self, service: str, text: str) -> None:
        """Show a line that a process wrote."""
        self._lines.put(printable(text if f" {service}: " in text[:80] else f"{service}: {text}") + "\n")

    def note(self, text: str) -> None:
        """Show a line for the user."""
        self._notes.put(printable(text, keep="\n") + "\n")

    def progress(self, text: str) -> None:
        """Show the progress of the task."""
        self.line("task", text)

    def close(self) -> None:
        """Write the queued lines, unless the reader is stalled."""
        self._lines.flush()
        self._notes.flush()


class JsonScreen:
    """One JSON object a line on stderr: time, service, level, message."""

    def __init__(self) -> None:
        """Write to the current stderr."""
        self._lines = DroppingWriter(
            sys.stderr, lambda lines: _object("supervisor", "warning", lost_lines_text(lines)).rstrip("\n"))

    def line(self, service: str, text: str) -> None:
        """Pass on a line that is such an object already, and wrap any other."""
        if text.startswith("{"):
            try:
                value = json.loads(text)
            except ValueError:
                value = None
            if isinstance(value, dict) and "message" in value:
                self._lines.put(json.dumps({"service": service, **value}) + "\n")
                return
        self._lines.put(_object(service, "info", text))

    def note(self, text: str) -> None:
        """Show a line for the user."""
        self._lines.put(_object("supervisor", "info", text))

    def progress(self, text: str) -> None:
        """Show the progress of the task."""
        self._lines.put(_object("task", "info", text))

    def close(self) -> None:
        """Write the queued lines, unless the reader is stalled."""
        self._lines.flush()


def open_screen(content: Callable[[], Content], *, log_json: bool, plain: bool = False) -> Screen:
    """Return the screen that suits stderr; `plain` leaves the terminal free for a question."""
    if log_json:
        return JsonScreen()
    if not plain and sys.stderr.isatty() and os.environ.get("TERM", "dumb") != "dumb":
        from rich.console import Console

        terminal = _NonBlockingTerminal(sys.stderr)
        return LiveScreen(Console(file=cast(TextIO, terminal)), content, terminal.drain)
    return PlainScreen()


class ScreenHandler(logging.Handler):
    """Shows the supervisor's log lines on a screen, among those of its processes."""

    def __init__(self, screen: Screen, *, log_json: bool) -> None:
        """Show lines on a screen, as text or JSON objects."""
        super().__init__(logging.INFO)
        self._screen = screen
        self._json = log_json

    def emit(self, record: logging.LogRecord) -> None:
        """Show one record."""
        level, message = record.levelname.lower(), record.getMessage()
        if record.exc_info and record.exc_info[1] is not None:
            message += f": {record.exc_info[1]!r}"
        if self._json:
            line = {"time": round(record.created, 6), "service": record.name, "level": level, "message": message}
            text = json.dumps(line)
        else:
            text = f"{record.levelname} {record.name}: {message}"
        self._screen.line(record.name, text)


def _object(service: str, level: str, message: str) -> str:
    line = {"time": round(time.time(), 6), "service": service, "level": level, "message": message}
    return json.dumps(line) + "\n"


class _NonBlockingTerminal(io.TextIOBase):
    """A terminal whose `write` never blocks."""

    def __init__(self, stream: TextIO) -> None:
        self._stream, self._out = stream, DroppingWriter(stream)

    def write(self, text: str) -> int:
        self._out.put(text)
        return len(text)

    def flush(self) -> None:
        """Do nothing: a thread writes the queue."""

    def drain(self) -> None:
        """Write the queue, unless the terminal is stalled."""
        self._out.flush()

    def isatty(self) -> bool:
        return self._stream.isatty()

    def fileno(self) -> int:
        return self._stream.fileno()

    @property
    def encoding(self) -> str:  # type: ignore[override]
        return self._stream.encoding
