"""How long messages are under way: from the stamp in their header to their arrival here."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import aclosing
from typing import TYPE_CHECKING

import typer

from cli import options
from common.errors import RequestFailed

if TYPE_CHECKING:
    from cli.measuring import DelayFigures
    from common.clock import Clock
    from common.transport.bus import Bus

PERIOD = 1.0  # [s] between figures
ASK_TIMEOUT = 1.0  # [s]


class NoStamp(RequestFailed):
    """The messages do not say when they were made."""

    def __init__(self, key: str) -> None:
        super().__init__(f"{key}: its messages have no header with a stamp, so nothing says how old they are")


def delay(
    key: options.PublishedKey,
    cell: options.CellName = None,
    count: options.Count = None,
    as_json: options.Json = False,
    domain: options.Domain = None,
    connect: options.Connect = None,
) -> None:
    """Show how old messages are when they come, until Ctrl-C or N lines: wall time since the stamp in the header."""
    from cli.inspection import cell_clock
    from cli.topic import published_or_foreign, visit_topic

    most = options.whole("--count", count, 1)
    topic = published_or_foreign(key)

    async def visit(bus: Bus) -> None:
        clock = await cell_clock(bus)
        shown = 0
        async for figures in windows(bus, key, clock, foreign=topic is None):
            typer.echo(json.dumps({"key": key, **figures}) if as_json else describe(figures))
            shown += 1
            if shown == most:
                return

    visit_topic(visit, topic, key, cell, domain, connect)


async def windows(bus: Bus, key: str, clock: Clock, *, foreign: bool = False) -> AsyncIterator[DelayFigures]:
    """The figures of a key of the cell, each second.

    Raises:
        NoStamp: something came that has no stamp.
        SilentKey: nothing came on a foreign key.
    """
    from cli.foreign import samples
    from cli.measuring import Hearing

    full = f"{bus.cell}/{key}"
    if foreign:
        async with aclosing(samples(bus, key)) as coming:
            await anext(coming)  # somebody writes it
    hearing = Hearing(clock)
    for sample in await bus.raw_get(full, ASK_TIMEOUT):
        hearing.know(sample)
    subscribed = bus.raw_subscriber(full, hearing.arrive)
    try:
        while True:
            await asyncio.sleep(PERIOD)
            if hearing.unstamped:
                raise NoStamp(key)
            yield hearing.delays()
    finally:
        subscribed.undeclare()


def describe(figures: DelayFigures) -> str:
    """The figures in one line for people."""
    if not figures["messages"]:
        return "nothing new came yet"
    if figures["mean"] is None:
        return f"nothing new came lately, {figures['messages']} messages"
    return (
        f"mean {figures['mean']:.2f} ms, min {figures['min']:.2f}, max {figures['max']:.2f}, "
        f"p99 {figures['p99']:.2f} ms, {figures['messages']} messages"
    )
