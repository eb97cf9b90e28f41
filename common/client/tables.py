"""What a cell costs and carries while it runs, as tables for a terminal."""

from __future__ import annotations

from rich.console import Group
from rich.table import Table
from rich.text import Text

from common.client.watching import ServiceRow, TopicRow, View
from common.terminal import STATE_STYLES, printable


def render(view: View) -> Group:
    """The two tables, and a line above them."""
    lost = "" if view.connected else "; the router is lost"
    head = f"{view.cell} at speed {view.speed:g}; this tool takes {view.own_cpu:.1f} %{lost}"
    notices = [Text(printable(line), style="red" if urgent else "yellow") for urgent, line in view.notices]
    return Group(Text(printable(head), style="bold" if view.connected else "bold red"), *notices, Text(),
                 services_table(view.services), Text(), topics_table(view.topics))


def services_table(rows: list[ServiceRow]) -> Table:
    """A row for each process."""
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
    """A row for each key that carries something."""
    table = _table("topic", "Hz", "kB/s", "messages", "age p50 ms", "age p99 ms", text=1)
    for row in rows:
        rate = None if row.bytes_per_second is None else row.bytes_per_second / 1e3
        table.add_row(Text(printable(row.topic)), _number(row.hz, 2), _number(rate, 1), _number(row.messages),
                      _number(row.p50, 1), _number(row.p99, 1))
    return table


def _table(*titles: str, text: int) -> Table:
    table = Table(box=None, pad_edge=False, header_style="dim")
    for index, title in enumerate(titles):
        table.add_column(title, justify="left" if index < text else "right", no_wrap=True)
    return table


def _number(value: float | None, digits: int = 0) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def _alarming(value: int | None, style: str) -> Text:
    return Text("" if value is None else str(value), style=style if value else "dim")
