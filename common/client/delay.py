"""How long messages are under way: from the stamp in their header to their arrival here."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator
from typing import TYPE_CHECKING

from common.errors import RequestFailed

if TYPE_CHECKING:
    from common.client.statistics import DelayFigures
    from common.transport.bus import Bus

PERIOD = 1.0  # [s] between figures
ASK_TIMEOUT = 1.0  # [s]


class NoStamp(RequestFailed):
    """The messages do not say when they were made."""

    def __init__(self, key: str) -> None:
        super().__init__(f"{key}: its messages have no header with a stamp, so nothing says how old they are")


async def delays(bus: Bus, key: str, foreign: bool) -> AsyncGenerator[tuple[DelayFigures, str], None]:
    """The figures of a key of the cell, each second, and as a line for people.

    Raises:
        NoStamp: something came that has no stamp.
        SilentKey: nothing came on a foreign key.
    """
    from common.client.foreign import require_messages
    from common.client.joining import cell_clock
    from common.client.statistics import TopicStatistics

    full = f"{bus.cell}/{key}"
    hearing = TopicStatistics(await cell_clock(bus))
    if foreign:
        await require_messages(bus, key)
    for sample in await bus.raw_get(full, ASK_TIMEOUT):
        hearing.know(sample)
    subscribed = bus.raw_subscriber(full, hearing.arrive)
    try:
        while True:
            await asyncio.sleep(PERIOD)
            if hearing.unstamped:
                raise NoStamp(key)
            figures = hearing.delays()
            yield figures, describe(figures)
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
