"""Output of a running cell: lines of text or JSON on stderr, or a live table on a terminal."""

from __future__ import annotations

import io
import json
import logging
import os
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING, Protocol, TextIO, cast

from common.messages import ServiceStatus
from common.process.log import DroppingWriter, lost_lines_text
from common.terminal import STATE_STYLES, printable

if TYPE_CHECKING:
    from rich.console import Console, Group
    from rich.text import Text

REFRESH_RATE = 4  # [Hz]
MOST_LINES = 200  # per refresh: a line takes 0.1 ms to draw, which delays the cell's signals and messages


@dataclass(frozen=True)
class Content:
    """The content of the table."""

    services: list[ServiceStatus]
    rates: dict[str, tuple[str, float]]  # by service: the topic that it writes most often, and its rate [Hz]
    progress: str  # of the task


class LiveScreen:
    """A table of the processes that stays below the lines that they write.

    A thread draws all lines since its last refresh at once, because the table is drawn again below each piece of text.
    """

    def __init__(
        self, console: Console, content: Callable[[], Content], drain: Callable[[], None] = lambda: None
    ) -> None:
        """Take the terminal over.

        Args:
            console: of the terminal.
            content: returns what to show; called on another thread, `REFRESH_RATE` times a second.
            drain: returns when all is written, or soon if the terminal does not accept it.
        """
        from rich.live import Live

        self._drain = drain
        self._waiting: list[tuple[Text, bool]] = []  # each with whether it may be wider than the terminal
        self._lost = 0
        self._lock = threading.Lock()
        self._live = Live(
            console=console, get_renderable=lambda: render(content()), auto_refresh=False,
            redirect_stdout=False, redirect_stderr=False,
        )
        self._live.start(refresh=True)
        self._ends = threading.Event()
        self._drawing = threading.Thread(target=self._draw_until_closed, name="table", daemon=True)
        self._drawing.start()

    def line(self, service: str, text: str) -> None:
        """Show a line of a process above the table; the last of too many lines at once are dropped."""
        from rich.text import Text

        named = printable(text if f" {service}: " in text[:80] else f"{service}: {text}")
        with self._lock:
            if len(self._waiting) < MOST_LINES:
                self._waiting.append((Text(named, style=_style_of(named)), False))
            else:
                self._lost += 1

    def note(self, text: str) -> None:
        """Show a line for the user above the table."""
        from rich.text import Text

        with self._lock:
            self._waiting.append((Text(printable(text, keep="\n")), True))

    def progress(self, text: str) -> None:
        """Do nothing: the table shows the progress of the task."""

    def close(self) -> None:
        """Leave the last table on the terminal and give the terminal back."""
        self._ends.set()
        self._drawing.join()
        self._draw()
        self._live.stop()
        self._drain()

    def _draw_until_closed(self) -> None:
        while not self._ends.wait(1 / REFRESH_RATE):
            self._draw()

    def _draw(self) -> None:
        from rich.text import Text

        with self._lock:
            waiting, self._waiting = self._waiting, []
            lost, self._lost = self._lost, 0
        if lost:
            waiting.append((Text(lost_lines_text(lost, "too many at once"), style="yellow"), False))
        for wide, some in groupby(waiting, key=lambda each: each[1]):
            self._live.console.print(Text("\n").join(text for text, _ in some), soft_wrap=wide)
        self._live.refresh()


def _style_of(line: str) -> str:
    if line.startswith("WARNING "):
        return "yellow"
    return "red" if line.startswith(("ERROR ", "CRITICAL ")) else ""


def render(content: Content) -> Group:
    """Return the table with the progress of the task below it."""
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, pad_edge=False, header_style="dim")
    for title in ("service", "state", "pid", "restarts", "writes", "Hz"):
        table.add_column(title, justify="right" if title in ("pid", "restarts", "Hz") else "left", no_wrap=True)
    for status in content.services:
        key, rate = content.rates.get(status.name, ("", 0.0))
        table.add_row(
            Text(printable(status.name)),
            Text(printable(status.state), style=STATE_STYLES.get(status.state, "")),
            str(status.pid or ""),
            Text(str(status.restarts), style="yellow" if status.restarts else "dim"),
            Text(printable(key), style="dim"),
            f"{rate:.1f}" if key else "",
        )
    return Group(table, Text(printable(content.progress), style="bold"))


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
