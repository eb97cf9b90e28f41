"""A device that comes and goes: it is opened again, after waits that grow."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable
from typing import NamedTuple

from pydantic import Field

from common.config import Parameters, Tunable

MOST_DOUBLINGS = 30  # of a wait, which has long reached its limit then


class Reopening(Parameters):
    """How long is waited for a device."""

    reopen_after: Tunable[float] = Field(
        0.5, gt=0, le=60, description="wait before a device that is gone is opened again, doubled each time [s]"
    )
    reopen_at_most: Tunable[float] = Field(10.0, gt=0, le=600, description="longest of these waits [s]")


class Gone(NamedTuple):
    """A device gives nothing: in words, and how much it gave since it was opened."""

    why: str
    sent: int = 0


async def keep_open(use: Callable[[], Awaitable[Gone | None]], waits: Reopening, log: logging.Logger) -> None:
    """Have a device opened and used until it says nothing of being gone; each time that it is, say so and wait.

    Args:
        use: opens the device, and returns when it gives no more; None at its end.
        waits: may change meanwhile.
        log: is told.
    """
    misses = 0  # in a row
    while (gone := await use()) is not None:
        misses = 0 if gone.sent else misses
        wait = min(waits.reopen_after * 2 ** min(misses, MOST_DOUBLINGS), waits.reopen_at_most)
        log.error("%s; it is opened again in %g s", gone.why, wait)
        await asyncio.sleep(wait)
        misses += 1
