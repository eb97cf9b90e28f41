"""Turns of a loop at a steady rate that may change while it waits; and who comes after all others."""

from __future__ import annotations

import asyncio
import contextlib
import math
import os
import sys
import threading
from collections.abc import Callable

from common.transport.bus import Bus

NICENESS = 5  # of a thread that computes for long


def come_last() -> None:
    """Have this thread, beside the main one, compute while no other has anything to do: pictures do not wait for it."""
    if sys.platform == "linux" and threading.current_thread() is not threading.main_thread():
        with contextlib.suppress(OSError):  # elsewhere, only whole processes have a priority
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICENESS)


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
