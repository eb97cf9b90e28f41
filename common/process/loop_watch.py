"""Ends a process whose event loop has got stuck, so that whoever keeps it going starts it again.

A thread asks the loop for a turn and counts the time until it comes. What computes in a thread beside the loop leaves
it its turns; what blocks the loop itself does not. Where even that thread cannot run, because foreign code keeps the
interpreter's lock, a timer without an interpreter ends the process after a longer time.
"""

from __future__ import annotations

import asyncio
import faulthandler
import logging
import os
import sys
import threading
import time
from collections.abc import Callable
from typing import NoReturn

from common.time_source import WatchdogClock
from common.transport.session import LoopNotifier

STUCK_EXIT = 70  # exit code of a process that ended itself because its loop was stuck
PERIOD = 0.25  # [s] between two questions
LOCKED_SECONDS = 30.0  # with the interpreter's lock in foreign hands
_TELL_SECONDS = 1.0  # for the last words: whoever reads them may be stuck as well

log = logging.getLogger(__name__)


class Turning:
    """Counts for how long a loop has not turned."""

    def __init__(self) -> None:
        """Begin as if it had just turned."""
        self._awake = WatchdogClock(2 * PERIOD)
        self._turned = True
        self._since = 0.0

    def turned(self) -> None:
        """Take note of a turn."""
        self._turned = True

    def still_for(self, now: float) -> float:
        """For how long it has not turned [s], given what the clock says [s, monotonic]; to be asked each period."""
        awake = self._awake.advance(now)
        if self._turned:
            self._turned, self._since = False, awake
        return awake - self._since


class LoopWatch:
    """Watches a running loop from a thread of its own, until `stop`."""

    def __init__(self, loop: asyncio.AbstractEventLoop, limit: Callable[[], float]) -> None:
        """Begin to watch; `limit()` is how long the loop may stand still now [s], 0 for ever."""
        self._limit = limit
        self._turning = Turning()
        self._doorbell = LoopNotifier(loop, self._turning.turned)
        self._stopped = threading.Event()
        threading.Thread(target=self._watch, name="loop watch", daemon=True).start()

    def stop(self) -> None:
        """Look away."""
        self._stopped.set()
        faulthandler.cancel_dump_traceback_later()

    def _watch(self) -> None:
        armed = 0.0
        while not self._stopped.wait(PERIOD):
            now, limit = time.monotonic(), self._limit()
            self._doorbell.notify()
            still = self._turning.still_for(now)
            if limit and now - armed > 1.0 and not self._stopped.is_set():
                armed = now
                faulthandler.dump_traceback_later(LOCKED_SECONDS + limit, exit=True)
            if limit and still > limit:
                end_stuck(still)


def end_stuck(still: float) -> NoReturn:
    """End the process with `STUCK_EXIT`, once its stacks and one line were written; bounded also where nobody reads."""

    def tell() -> None:
        faulthandler.dump_traceback(sys.__stderr__ or 2, all_threads=True)
        log.critical("the event loop has not turned for %.1f s; where it hangs is above", still)
        for handler in logging.getLogger().handlers:
            handler.flush()

    telling = threading.Thread(target=tell, daemon=True)
    telling.start()
    telling.join(_TELL_SECONDS)
    os._exit(STUCK_EXIT)
