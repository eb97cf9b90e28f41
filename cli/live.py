"""A live table of a cell's processes on a terminal."""

from __future__ import annotations

from collections.abc import Callable

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from cli.screens import Content
from common.terminal import printable

STATE_STYLES = {"ready": "green", "starting": "cyan", "waiting": "dim", "restarting": "yellow", "failed": "bold red"}
REFRESHES = 4  # [1/s]


class LiveScreen:
    """A table of the processes that stays below the lines that they write."""

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
        self._content = content
        self._live = Live(
            console=console, get_renderable=lambda: render(self._content()), refresh_per_second=REFRESHES,
            redirect_stdout=False, redirect_stderr=False,
        )
        self._live.start()

    def line(self, service: str, text: str) -> None:
        """Show one line that a process wrote, above the table."""
        named = printable(text if f" {service}: " in text[:80] else f"{service}: {text}")
        self._live.console.print(Text(named, style=_style_of(named)))

    def note(self, text: str) -> None:
        """Show a line for the person in front of it, above the table."""
        self._live.console.print(Text(printable(text, keep="\n")), soft_wrap=True)

    def progress(self, text: str) -> None:
        """The table shows it anyway."""

    def close(self) -> None:
        """Leave the last table standing and give the terminal back."""
        self._live.stop()
        self._drain()


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
