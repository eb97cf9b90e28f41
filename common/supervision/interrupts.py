"""What the signals that a person or a system sends mean: stop, and stop now."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import sys
import threading

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


def end_with_stdin() -> None:
    """Have this process take the end of its standard input for Ctrl-C, also should nobody be left to close it."""

    def watch() -> None:
        with contextlib.suppress(OSError):
            while os.read(sys.stdin.fileno(), 4096):
                pass
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=watch, name="stdin", daemon=True).start()
