"""`top`: load of a running cell's processes and rates of its topics, in a live table."""

from __future__ import annotations

import asyncio
import json
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated

import typer

from cli import options
from cli.options import RUNNING, CellTarget
from common.terminal import STATE_STYLES, echo, printable

if TYPE_CHECKING:
    from rich.console import Console, Group
    from rich.table import Table
    from rich.text import Text

    from common.client.monitor import ServiceRow, TopicRow, View
    from common.transport.bus import Bus

PERIOD = 1.0  # [s] between tables
FIRST = 2.2  # [s] until the first one: every service has published its counters twice by then
PLAIN_WIDTH = 110  # [characters] without a terminal

Once = Annotated[bool, typer.Option("--once", help="print one table and exit")]


def top(
    once: Once = False,
    count: options.Count = None,
    at: CellTarget = RUNNING,
    as_json: options.Json = False,
) -> None:
    """Show CPU, memory, rates, losses and message ages of a cell's services and topics every second, until Ctrl-C."""
    most = 1 if once else options.whole("--count", count, 1)

    async def visit(bus: Bus) -> None:
        from common.client.joining import cell_clock
        from common.client.monitor import CellMonitor

        async with CellMonitor(bus, await cell_clock(bus)) as monitor:
            await asyncio.sleep(FIRST)
            show, close = _open_display(live=most is None and not as_json, as_json=as_json)
            try:
                shown = 0
                while True:
                    show(monitor.view())
                    shown += 1
                    if shown == most:
                        return
                    await asyncio.sleep(PERIOD)
            finally:
                close()

    at.visit(visit)


def _open_display(*, live: bool, as_json: bool) -> tuple[Callable[[View], None], Callable[[], None]]:
    """Return a function that shows a view, and one that restores the terminal."""
    if as_json:
        return lambda view: echo(json.dumps(view.as_dict())), lambda: None
    from rich.console import Console

    console = Console(width=None if sys.stdout.isatty() else PLAIN_WIDTH)
    if live and console.is_terminal:
        return _live(console)
    return lambda view: console.print(render(view)), lambda: None


def _live(console: Console) -> tuple[Callable[[View], None], Callable[[], None]]:
    from rich.live import Live

    # Drawn once per view and not by a refresh thread: the tool itself must use little CPU.
    table = Live(console=console, auto_refresh=False)
    table.start()
    return lambda view: table.update(render(view), refresh=True), table.stop


def render(view: View) -> Group:
    """Return a heading, notices, and the tables of services and topics."""
    from rich.console import Group
    from rich.text import Text

    lost = "" if view.connected else "; the connection to the router is lost"
    head = f"{view.cell} at speed {view.speed:g}; this tool uses {view.own_cpu:.1f} % CPU{lost}"
    notices = [Text(printable(line), style="red" if urgent else "yellow") for urgent, line in view.notices]
    return Group(Text(printable(head), style="bold" if view.connected else "bold red"), *notices, Text(),
                 services_table(view.services), Text(), topics_table(view.topics))


def services_table(rows: list[ServiceRow]) -> Table:
    """Return a table with a row for each process."""
    from rich.text import Text

    table = _table("service", "state", "pid", "CPU %", "MB", "restarts", "in/s", "dropped", "invalid", "overflow",
                   text=2)
    for row in rows:
        table.add_row(
            Text(printable(row.service)), Text(printable(row.state), style=STATE_STYLES.get(row.state, "")),
            _number(row.pid), _number(row.cpu, 1), _number(row.memory), _alarming(row.restarts, "yellow"),
            _number(row.received, 1), _number(row.dropped), _alarming(row.invalid, "red"),
            _alarming(row.overflow, "red"),
        )
    return table


def topics_table(rows: list[TopicRow]) -> Table:
    """Return a table with a row for each key that carries messages."""
    from rich.text import Text

    table = _table("topic", "Hz", "kB/s", "messages", "age p50 ms", "age p99 ms", text=1)
    for row in rows:
        rate = None if row.bytes_per_second is None else row.bytes_per_second / 1e3
        table.add_row(Text(printable(row.topic)), _number(row.hz, 2), _number(rate, 1), _number(row.messages),
                      _number(row.p50, 1), _number(row.p99, 1))
    return table


def _table(*titles: str, text: int) -> Table:
    from rich.table import Table

    table = Table(box=None, pad_edge=False, header_style="dim")
    for index, title in enumerate(titles):
        table.add_column(title, justify="left" if index < text else "right", no_wrap=True)
    return table


def _number(value: float | None, digits: int = 0) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def _alarming(value: int | None, style: str) -> Text:
    from rich.text import Text

    return Text("" if value is None else str(value), style=style if value else "dim")
