"""A live table of a cell's processes on a terminal."""

from __future__ import annotations

import threading
from collections.abc import Callable
from itertools import groupby

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from cli.session.screens import Content
from common.process.dropping_writer import lost_lines_text
from common.terminal import STATE_STYLES, printable

REFRESHES = 4  # [1/s]
MOST_LINES = 200  # between two of them: a line takes 0.1 ms to draw, and the cell's signals and news wait meanwhile


class LiveScreen:
    """A table of the processes that stays below the lines that they write.

    A thread draws, all lines since the last time at once: the table is drawn anew below each piece of text.
    """

    def __init__(
        self, console: Console, content: Callable[[], Content], drain: Callable[[], None] = lambda: None
    ) -> None:
        """Take the terminal over.

        Args:
            console: of the terminal.
            content: asked for what to show a few times a second; called on another thread.
            drain: returns soon, when all was written if somebody reads.
        """
        self._drain = drain
        self._waiting: list[tuple[Text, bool]] = []  # and whether it may be wider than the terminal
        self._lost = 0
        self._lock = threading.Lock()
        self._live = Live(
            console=console, get_renderable=lambda: render(content()), auto_refresh=False,
            redirect_stdout=False, redirect_stderr=False,
        )
        self._live.start(refresh=True)
        self._ends = threading.Event()
        self._drawing = threading.Thread(target=self._draw_on, name="table", daemon=True)
        self._drawing.start()

    def line(self, service: str, text: str) -> None:
        """Have one line shown soon that a process wrote, above the table; of too many at once the last are lost."""
        named = printable(text if f" {service}: " in text[:80] else f"{service}: {text}")
        with self._lock:
            if len(self._waiting) < MOST_LINES:
                self._waiting.append((Text(named, style=_style_of(named)), False))
            else:
                self._lost += 1

    def note(self, text: str) -> None:
        """Have a line shown soon for the person in front of it, above the table."""
        with self._lock:
            self._waiting.append((Text(printable(text, keep="\n")), True))

    def progress(self, text: str) -> None:
        """The table shows it anyway."""

    def close(self) -> None:
        """Leave the last table standing and give the terminal back."""
        self._ends.set()
        self._drawing.join()
        self._draw()
        self._live.stop()
        self._drain()

    def _draw_on(self) -> None:
        while not self._ends.wait(1 / REFRESHES):
            self._draw()

    def _draw(self) -> None:
        with self._lock:
            waiting, self._waiting = self._waiting, []
            lost, self._lost = self._lost, 0
        if lost:
            told = lost_lines_text(lost, "there were too many to show")
            waiting.append((Text(told, style="yellow"), False))
        for wide, some in groupby(waiting, key=lambda each: each[1]):
            self._live.console.print(Text("\n").join(text for text, _ in some), soft_wrap=wide)
        self._live.refresh()


def _style_of(line: str) -> str:
    if line.startswith("WARNING "):
        return "yellow"
    return "red" if line.startswith(("ERROR ", "CRITICAL ")) else ""


def render(content: Content) -> Group:
    """The table, and the task's line under it."""
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
