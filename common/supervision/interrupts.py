"""What the signals that a person or a system sends mean: stop, and stop now."""

from __future__ import annotations

import asyncio
import signal

STOPPING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Interrupts:
    """Counts signals that ask for the end: the first asks to stop, the second to hurry."""

    def __init__(self) -> None:
        """Hear nothing yet."""
        self.stop = asyncio.Event()
        self.hurry = asyncio.Event()
        self.signal: int | None = None  # the first that came

    def install(self) -> None:
        """Take the signals over from now on; on the running loop."""
        loop = asyncio.get_running_loop()
        for number in STOPPING:
            loop.add_signal_handler(number, self._on_signal, number)

    def _on_signal(self, number: int) -> None:
        if self.stop.is_set():
            self.hurry.set()
        else:
            self.signal = number
            self.stop.set()
