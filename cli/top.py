"""What a cell costs and carries while it runs: processes and topics in a live table."""

from __future__ import annotations

import asyncio
import json
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated

import typer

from cli import options
from cli.place import UP, Place
from common.terminal import echo

if TYPE_CHECKING:
    from rich.console import Console

    from common.client.watching import View
    from common.transport.bus import Bus

PERIOD = 1.0  # [s] between tables
FIRST = 2.2  # [s] until the first: every service has counted twice by then
PLAIN_WIDTH = 110  # [characters] where there is no terminal

Once = Annotated[bool, typer.Option("--once", help="one table, then end")]


def top(
    once: Once = False,
    count: options.Count = None,
    at: Place = UP,
    as_json: options.Json = False,
) -> None:
    """Show CPU, memory, rates, losses and ages of a cell's services and topics each second, until Ctrl-C."""
    most = 1 if once else options.whole("--count", count, 1)

    async def visit(bus: Bus) -> None:
        from common.client.joining import cell_clock
        from common.client.watching import Watch

        async with Watch(bus, await cell_clock(bus)) as watch:
            await asyncio.sleep(FIRST)
            show, close = _opened(live=most is None and not as_json, as_json=as_json)
            try:
                shown = 0
                while True:
                    show(watch.view())
                    shown += 1
                    if shown == most:
                        return
                    await asyncio.sleep(PERIOD)
            finally:
                close()

    at.visit(visit)


def _opened(*, live: bool, as_json: bool) -> tuple[Callable[[View], None], Callable[[], None]]:
    """What shows a view, and what leaves the terminal as it was."""
    if as_json:
        return lambda view: echo(json.dumps(view.as_dict())), lambda: None
    from rich.console import Console

    console = Console(width=None if sys.stdout.isatty() else PLAIN_WIDTH)
    if live and console.is_terminal:
        return _live(console)
    from common.client.tables import render

    return lambda view: console.print(render(view)), lambda: None


def _live(console: Console) -> tuple[Callable[[View], None], Callable[[], None]]:
    from rich.live import Live

    from common.client.tables import render

    # Drawn when there is something new and not by a thread in between: the tool must cost little itself.
    table = Live(console=console, auto_refresh=False)
    table.start()
    return lambda view: table.update(render(view), refresh=True), table.stop
