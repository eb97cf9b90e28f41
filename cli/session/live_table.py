"""A live table of a cell's processes on a terminal."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING

from common.messages import ServiceStatus
from common.process.dropping_writer import lost_lines_text
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
