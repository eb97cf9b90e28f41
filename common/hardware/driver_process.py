"""A driver in a process of its own: begun again after a time that doubles whenever it ends, however it ended."""

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

FIRST_PAUSE, LONGEST_PAUSE = 0.5, 8.0  # [s] before a process that failed is begun again
ENDS = 2.0  # [s] in which it ends when it is told to


class DriverProcess:
    """This end of the pipe to the process, which is begun by `keep_up`.

    Attributes:
        problem: why the device cannot be used; empty while the process says how it is.
    """

    def __init__(
        self, name: str, target: Callable[..., None], args: tuple[object, ...], hear: Callable[[Any], None],
        lost: Callable[[], None],
    ) -> None:
        """The process runs `target(*args, pipe)`, in which `run` says how it ends; `name` is for people.

        What it sends comes to `hear`, in a thread beside; when it has ended `lost` is called by whoever finds out.
        """
        self.name, self.problem = name, f"connecting to {name}"
        context = multiprocessing.get_context("spawn")
        self._begin: Callable[[Connection], multiprocessing.process.BaseProcess] = lambda theirs: context.Process(
            target=target, args=(*args, theirs), name=f"driver of {name}", daemon=True)
        self._hear, self._lost = hear, lost
        self._process: multiprocessing.process.BaseProcess | None = None
        self._ours: Connection | None = None
        self._listener = threading.Thread()
        self._pause, self._due = FIRST_PAUSE, 0.0

    def keep_up(self) -> None:
        """Begin the process where there is none, or it has ended."""
        now = time.monotonic()
        if self._process is None:
            if now < self._due:
                return
            self._ours, theirs = multiprocessing.Pipe()
            self._process = self._begin(theirs)
            self._process.start()
            theirs.close()
            self._listener = threading.Thread(target=self._listen, args=(self._ours,), daemon=True)
            self._listener.start()
        elif not self._listener.is_alive():
            self._end()
            self.problem = self.problem or f"{self.name}: its driver ended without a word"
            self._due, self._pause = now + self._pause, min(2 * self._pause, LONGEST_PAUSE)

    def send(self, message: tuple[object, ...]) -> bool:
        """Whether the process is there to take it."""
        try:
            if self._ours is None:
                return False
            self._ours.send(message)
        except OSError:
            return False  # the process is gone, which is seen when it is read
        return True

    def works(self) -> None:
        """Take note that the device can be used."""
        self.problem, self._pause = "", FIRST_PAUSE

    def close(self) -> None:
        """Have the process let go of the device, and end."""
        if self._process is None:
            return
        self.send(("end",))
        self._process.join(ENDS)
        self._end()

    def _listen(self, pipe: Connection) -> None:
        """Be the thread that takes what the process tells, whether anybody reads or not, until it has ended."""
        with contextlib.suppress(EOFError, OSError):
            while True:
                told = pipe.recv()
                if isinstance(told, tuple) and told[0] == "failed":
                    self.problem = f"{self.name}: {told[1]}"
                else:
                    self._hear(told)

    def _end(self) -> None:
        assert self._process is not None and self._ours is not None
        self._process.join(0.1)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._listener.join(ENDS)
        self._ours.close()
        self._process, self._ours = None, None
        self._lost()


def run(pipe: Connection, work: Callable[[], None]) -> None:
    """Be the process: do the work until it ends or the other end of the pipe is gone, and say what went wrong."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for those who started us: they tell us when to end
    try:
        work()
    except Exception as error:  # of whatever type: the reason is for the person, the process is done
        with contextlib.suppress(OSError):
            pipe.send(("failed", str(error) or type(error).__name__))
    os._exit(0)  # a vendor's threads may wait for a device that is gone
