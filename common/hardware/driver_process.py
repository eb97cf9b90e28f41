"""A vendor's library in a process of its own, which is restarted after a growing pause whenever it ends."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

FIRST_PAUSE, LONGEST_PAUSE = 0.5, 8.0  # [s] before a failed process is restarted
END_TIMEOUT = 2.0  # [s] for the process to end on request


class DriverProcess:
    """The parent's end of the pipe to a driver process; `keep_running` starts and restarts the process.

    Attributes:
        problem: why the device cannot be used; empty once the process has reported a state.
    """

    def __init__(
        self, name: str, target: Callable[..., None], args: tuple[object, ...], on_message: Callable[[Any], None],
        on_end: Callable[[], None],
    ) -> None:
        """Describe a process that runs `target(*args, pipe)`, whose body is `run_driver`; `name` is for messages.

        A listener thread passes the messages of the process to `on_message`. After its end, the thread that finds out
        calls `on_end`.
        """
        self.name, self.problem = name, f"connecting to {name}"
        context = multiprocessing.get_context("spawn")
        self._create: Callable[[Connection], multiprocessing.process.BaseProcess] = lambda child_end: context.Process(
            target=target, args=(*args, child_end), name=f"driver of {name}", daemon=True)
        self.on_message, self._on_end = on_message, on_end
        self._process: multiprocessing.process.BaseProcess | None = None
        self._pipe: Connection | None = None
        self._listener = threading.Thread()
        self._pause, self._not_before = FIRST_PAUSE, 0.0

    @property
    def failure(self) -> str:
        """Why nothing can be sent to the device."""
        return self.problem or f"{self.name}: its driver has ended"

    def keep_running(self) -> None:
        """Start the process where there is none, or it has ended."""
        now = time.monotonic()
        if self._process is None:
            if now < self._not_before:
                return
            self._pipe, child_end = multiprocessing.Pipe()
            self._process = self._create(child_end)
            self._process.start()
            child_end.close()
            self._listener = threading.Thread(target=self._listen, args=(self._pipe,), daemon=True)
            self._listener.start()
        elif not self._listener.is_alive():
            self._reap()
            self.problem = self.problem or f"{self.name}: its driver ended without a message"
            self._not_before, self._pause = now + self._pause, min(2 * self._pause, LONGEST_PAUSE)

    def send(self, message: tuple[object, ...]) -> bool:
        """Return whether the message was sent: False when there is no process."""
        try:
            if self._pipe is None:
                return False
            self._pipe.send(message)
        except OSError:
            return False  # the process has ended; the next read finds out
        return True

    def set_working(self) -> None:
        """Record that the device can be used."""
        self.problem, self._pause = "", FIRST_PAUSE

    def close(self) -> None:
        """Have the process release the device and end."""
        if self._process is None:
            return
        self.send(("end",))
        self._process.join(END_TIMEOUT)
        self._reap()

    def _listen(self, pipe: Connection) -> None:
        """Receive messages until the process has ended, even if no caller reads meanwhile."""
        with contextlib.suppress(EOFError, OSError):
            while True:
                message = pipe.recv()
                if isinstance(message, tuple) and message[0] == "failed":
                    self.problem = f"{self.name}: {message[1]}"
                else:
                    self.on_message(message)

    def _reap(self) -> None:
        assert self._process is not None and self._pipe is not None
        self._process.join(0.1)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._listener.join(END_TIMEOUT)
        self._pipe.close()
        self._process, self._pipe = None, None
        self._on_end()


def run_driver(pipe: Connection, work: Callable[[], None]) -> None:
    """Run in the driver process: work until it returns or the other end of the pipe is gone; send why it failed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, which ends this process
    try:
        work()
    except Exception as error:  # of whatever type: the operator gets the reason, the process ends
        with contextlib.suppress(OSError):
            pipe.send(("failed", str(error) or type(error).__name__))
    os._exit(0)  # threads of a vendor's library may wait for a device that is gone
