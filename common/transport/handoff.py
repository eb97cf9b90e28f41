"""How a network thread tells the loop that something came: one wake-up, however many things came before it."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Callable


class Doorbell:
    """Calls back on the loop once for any number of rings since the last call."""

    def __init__(self, loop: asyncio.AbstractEventLoop, answer: Callable[[], None]) -> None:
        self._loop = loop
        self._answer = answer
        self._lock = threading.Lock()
        self._rung = False

    def ring(self) -> None:
        """Have the callback called soon; from any thread."""
        with self._lock:
            if self._rung:
                return
            self._rung = True
        call_on_loop(self._loop, self._open)

    def _open(self) -> None:
        with self._lock:
            self._rung = False
        self._answer()


def call_on_loop(loop: asyncio.AbstractEventLoop, call: Callable[[], None]) -> None:
    """Have a function called on the loop, from any thread; a loop that has ended hears nothing."""
    with contextlib.suppress(RuntimeError):
        loop.call_soon_threadsafe(call)
