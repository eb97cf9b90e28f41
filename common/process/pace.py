"""Turns of a loop at a steady rate that may change while it waits."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable

from common.transport.bus import Bus


class Pace:
    """Due times on a fixed grid: a late turn makes neither drift nor a burst, the times it missed are left out.

    The rate is asked for again whenever parameters of the service were changed, also while waiting.

    Attributes:
        due: when the turn of now was due, by the loop's clock [s].
    """

    def __init__(self, bus: Bus, rate: Callable[[], float]) -> None:
        """Begin now; `rate` says how many turns there are each second of wall time [Hz]."""
        self._rate = rate
        self._loop = asyncio.get_running_loop()
        self.due = self._loop.time()
        self._changed = asyncio.Event()
        bus.on_parameters(self._changed.set)

    async def wait(self) -> None:
        """Return when the next turn is due."""
        while True:
            self._changed.clear()
            period = 1 / self._rate()
            following = self.due + period * max(1, math.ceil((self._loop.time() - self.due) / period))
            try:
                async with asyncio.timeout_at(following):
                    await self._changed.wait()
            except TimeoutError:
                self.due = following
                return
