"""Ends a process in time: on SIGINT, SIGTERM or the end of its supervisor, whatever its main thread is doing."""

from __future__ import annotations

import contextlib
import ctypes
import logging
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable
from typing import NoReturn

log = logging.getLogger(__name__)

PR_SET_PDEATHSIG = 1  # of linux/prctl.h
FLUSH_SECONDS = 0.5
GRACE_SECONDS = 0.7  # from the signal to the end; the rest of the second is the system's


class Lifeline:
    """Watches signals, and with a gate also stdin, in a thread of its own.

    The first reason to end calls `on_stop` and starts the time: what is not done after `GRACE_SECONDS` is cut off.
    Signals reach this thread through a pipe that the interpreter writes at once, also while the main thread waits in
    foreign code; further signals change nothing.
    """

    def __init__(self, *, gate: bool) -> None:
        self.reason = ""
        self.gate_open = threading.Event()
        self._gate = gate
        self._on_stop: Callable[[], None] | None = None
        self._on_gate: Callable[[], None] | None = None
        self._lock = threading.Lock()
        if not gate:
            self.gate_open.set()

    @property
    def stopping(self) -> bool:
        """Whether it is time to end."""
        return bool(self.reason)

    def start(self) -> None:
        """Take over the signals; on the main thread."""
        if self._gate:
            wake_when_orphaned()
        read, write = os.pipe()
        os.set_blocking(write, False)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: None)
        signal.set_wakeup_fd(write, warn_on_full_buffer=False)
        threading.Thread(target=self._watch, args=(read,), name="lifeline", daemon=True).start()

    def on_stop(self, callback: Callable[[], None]) -> None:
        """Have it called, on the thread of the lifeline, when it is time to end; at once if it already is."""
        with self._lock:
            self._on_stop = callback
        if self.stopping:
            callback()

    def on_gate(self, callback: Callable[[], None]) -> None:
        """Have it called when the gate opens; at once if it is open."""
        with self._lock:
            self._on_gate = callback
        if self.gate_open.is_set():
            callback()

    def _watch(self, signals: int) -> None:
        sources = [signals, *([sys.stdin.fileno()] if self._gate else [])]
        while True:
            ready, _, _ = select.select(sources, [], [])
            if signals in ready:
                names = [signal.Signals(n).name for n in os.read(signals, 64) if n in (signal.SIGINT, signal.SIGTERM)]
                if names:
                    return self._stop(names[0])
            elif ready:
                data = os.read(ready[0], 4096)
                if not data:
                    return self._stop("the supervisor is gone")
                if b"\n" in data:
                    self._open_gate()

    def _open_gate(self) -> None:
        with self._lock:
            self.gate_open.set()
            on_gate = self._on_gate
        if on_gate is not None:
            on_gate()

    def _stop(self, reason: str) -> None:
        with self._lock:
            self.reason = reason
            on_stop = self._on_stop
        if on_stop is None:  # nothing to take back yet
            os._exit(0)
        on_stop()
        time.sleep(GRACE_SECONDS)
        os._exit(0)


def wake_when_orphaned() -> None:
    """Have the kernel wake this process, should it be stopped when its parent ends: it can then end itself in order."""
    if sys.platform == "linux":  # elsewhere a stopped process stays until somebody wakes it
        ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGCONT)


def die_when_orphaned() -> None:
    """Have the kernel end this process when its parent ends: for one whose answer nobody else takes."""
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


def leave(code: int) -> NoReturn:
    """End the process now: neither threads that still compute nor the network can hold it."""
    flushing = threading.Thread(target=_flush, daemon=True)
    flushing.start()
    flushing.join(FLUSH_SECONDS)  # whoever should read may not
    os._exit(code)


def _flush() -> None:
    for handler in logging.getLogger().handlers:
        handler.flush()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()


def fail(error: Exception) -> NoReturn:
    """End the process over something the person can mend: one line, exit code 2."""
    sys.stderr.write(f"{error}\n")
    leave(2)
