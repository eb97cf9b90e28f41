"""What a person sees while a cell is up: lines on stderr, as text or JSON, or a live table on a terminal."""

from __future__ import annotations

import io
import json
import logging
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TextIO, cast

from common.messages import ServiceStatus
from common.process.dropping_writer import DroppingWriter, lost_lines_text
from common.terminal import printable


@dataclass(frozen=True)
class Content:
    """What the live table shows."""

    services: list[ServiceStatus]
    rates: dict[str, tuple[str, float]]  # by service: the topic that it writes most often, and how often [Hz]
    progress: str  # of the task


class Screen(Protocol):
    """Where lines and the state of the cell are shown."""

    def line(self, service: str, text: str) -> None:
        """Show one line that a process wrote."""

    def note(self, text: str) -> None:
        """Show a line of the supervisor's own for the person in front of it."""

    def progress(self, text: str) -> None:
        """Show how far the task is."""

    def close(self) -> None:
        """Leave the terminal as it was."""


class PlainScreen:
    """Lines on stderr, each with the name of who wrote it; no control characters. Notes go to stdout."""

    def __init__(self) -> None:
        """Write to stderr and stdout of now."""
        self._lines, self._notes = DroppingWriter(sys.stderr), DroppingWriter(sys.stdout)

    def line(self, service: str, text: str) -> None:
        """Show one line that a process wrote."""
        self._lines.put(printable(text if f" {service}: " in text[:80] else f"{service}: {text}") + "\n")

    def note(self, text: str) -> None:
        """Show a line for the person in front of it."""
        self._notes.put(printable(text, keep="\n") + "\n")

    def progress(self, text: str) -> None:
        """Show how far the task is."""
        self.line("task", text)

    def close(self) -> None:
        """Write what still waits, if somebody reads."""
        self._lines.flush()
        self._notes.flush()


class JsonScreen:
    """One JSON object a line on stderr: time, service, level, message."""

    def __init__(self) -> None:
        """Write to stderr of now."""
        self._lines = DroppingWriter(
            sys.stderr, lambda lines: _object("supervisor", "warning", lost_lines_text(lines)).rstrip("\n"))

    def line(self, service: str, text: str) -> None:
        """Pass on what is such an object already, wrap what is not."""
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
        """Show a line for the person in front of it."""
        self._lines.put(_object("supervisor", "info", text))

    def progress(self, text: str) -> None:
        """Show how far the task is."""
        self._lines.put(_object("task", "info", text))

    def close(self) -> None:
        """Write what still waits, if somebody reads."""
        self._lines.flush()


def open_screen(content: Callable[[], Content], *, log_json: bool, plain: bool = False) -> Screen:
    """The screen that suits where stderr goes; `plain` keeps the terminal free for a question."""
    if log_json:
        return JsonScreen()
    if not plain and sys.stderr.isatty() and os.environ.get("TERM", "dumb") != "dumb":
        from rich.console import Console

        from cli.session.live_table import LiveScreen

        terminal = _Terminal(sys.stderr)
        return LiveScreen(Console(file=cast(TextIO, terminal)), content, terminal.drain)
    return PlainScreen()


class ScreenHandler(logging.Handler):
    """Shows the supervisor's own log among the lines of its processes."""

    def __init__(self, screen: Screen, *, log_json: bool) -> None:
        """Show on a screen, as JSON objects if asked to."""
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
    said = {"time": round(time.time(), 6), "service": service, "level": level, "message": message}
    return json.dumps(said) + "\n"


class _Terminal(io.TextIOBase):
    """A terminal that nobody waits for who writes to it."""

    def __init__(self, stream: TextIO) -> None:
        self._stream, self._out = stream, DroppingWriter(stream)

    def write(self, text: str) -> int:
        self._out.put(text)
        return len(text)

    def flush(self) -> None:
        """Nothing: it is written soon."""

    def drain(self) -> None:
        """Write what still waits, if somebody reads."""
        self._out.flush()

    def isatty(self) -> bool:
        return self._stream.isatty()

    def fileno(self) -> int:
        return self._stream.fileno()

    @property
    def encoding(self) -> str:  # type: ignore[override]
        return self._stream.encoding
