"""The end of a process: on a signal, without its supervisor, or with a stuck event loop, whatever its main thread does.

`Lifeline` handles signals and the end of the supervisor. `LoopWatchdog` ends a process whose event loop is stuck, so
that its supervisor restarts it. Heavy work in a thread next to the loop does not count; only what blocks the loop does.
If foreign code holds the interpreter lock, so that even the watchdog's thread cannot run, a timer of the C runtime ends
the process after a longer time.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import faulthandler
import logging
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable
from typing import NoReturn

from common.time_source import WatchdogClock
from common.transport.session import LoopNotifier

log = logging.getLogger(__name__)

PR_SET_PDEATHSIG = 1  # of linux/prctl.h
FLUSH_SECONDS = 0.5
GRACE_SECONDS = 0.7  # from the signal to the end; the rest of the second is the system's

STUCK_EXIT = 70  # exit code of a process that ended itself because its loop was stuck
PERIOD = 0.25  # [s] between two checks of the loop
LOCKED_SECONDS = 30.0  # for which foreign code may hold the interpreter lock
_LAST_LOG_SECONDS = 1.0  # for the last log line: its reader may be stuck too


class Lifeline:
    """Watches signals, and with a gate also stdin, in a thread of its own.

    The first reason to end calls `on_stop` and starts the grace period: after `GRACE_SECONDS` the process exits, done
    or not. Signals reach this thread through a pipe that the interpreter writes at once, also while the main thread is
    in foreign code. Later signals change nothing.
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
        """Whether the process has to end."""
        return bool(self.reason)

    def start(self) -> None:
        """Take over the signals; call it on the main thread."""
        if self._gate:
            wake_when_orphaned()
        read, write = os.pipe()
        os.set_blocking(write, False)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: None)
        signal.set_wakeup_fd(write, warn_on_full_buffer=False)
        threading.Thread(target=self._watch, args=(read,), name="lifeline", daemon=True).start()

    def on_stop(self, callback: Callable[[], None]) -> None:
        """Call back on the lifeline's thread when the process has to end; at once if it already has to."""
        with self._lock:
            self._on_stop = callback
        if self.stopping:
            callback()

    def on_gate(self, callback: Callable[[], None]) -> None:
        """Call back when the gate opens; at once if it is open."""
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
        if on_stop is None:  # nothing was started yet
            os._exit(0)
        on_stop()
        time.sleep(GRACE_SECONDS)
        os._exit(0)


def wake_when_orphaned() -> None:
    """Make the kernel continue this process if it is stopped when its parent ends, so that it can shut down."""
    if sys.platform == "linux":  # on other systems a stopped process stays stopped
        ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGCONT)


def die_when_orphaned() -> None:
    """Make the kernel kill this process when its parent ends, for a worker whose results only the parent reads."""
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


def exit_now(code: int) -> NoReturn:
    """Exit without waiting for threads that still compute or for the network."""
    flushing = threading.Thread(target=_flush, daemon=True)
    flushing.start()
    flushing.join(FLUSH_SECONDS)  # the reader of stderr may be stalled
    os._exit(code)


def _flush() -> None:
    for handler in logging.getLogger().handlers:
        handler.flush()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()


def exit_with_error(error: Exception) -> NoReturn:
    """Exit because of bad input: one line on stderr, exit code 2."""
    sys.stderr.write(f"{error}\n")
    exit_now(2)


class StallTimer:
    """Measures for how long an event loop has not turned."""

    def __init__(self) -> None:
        """Start as if the loop had just turned."""
        self._awake = WatchdogClock(2 * PERIOD)
        self._turned = True
        self._since = 0.0

    def turned(self) -> None:
        """Record a turn of the loop."""
        self._turned = True

    def still_for(self, now: float) -> float:
        """Return for how long the loop has not turned [s]; call it each period with the monotonic time `now` [s]."""
        awake = self._awake.advance(now)
        if self._turned:
            self._turned, self._since = False, awake
        return awake - self._since


class LoopWatchdog:
    """Watches a running loop from a thread of its own, until `stop`."""

    def __init__(self, loop: asyncio.AbstractEventLoop, limit: Callable[[], float]) -> None:
        """Start to watch; `limit()` is the longest stall that is allowed now [s], 0 for no limit."""
        self._limit = limit
        self._timer = StallTimer()
        self._doorbell = LoopNotifier(loop, self._timer.turned)
        self._stopped = threading.Event()
        threading.Thread(target=self._watch, name="loop watchdog", daemon=True).start()

    def stop(self) -> None:
        """Stop watching."""
        self._stopped.set()
        faulthandler.cancel_dump_traceback_later()

    def _watch(self) -> None:
        armed = 0.0
        while not self._stopped.wait(PERIOD):
            now, limit = time.monotonic(), self._limit()
            self._doorbell.notify()
            still = self._timer.still_for(now)
            if limit and now - armed > 1.0 and not self._stopped.is_set():
                armed = now
                faulthandler.dump_traceback_later(LOCKED_SECONDS + limit, exit=True)
            if limit and still > limit:
                exit_stuck(still)


def exit_stuck(still: float) -> NoReturn:
    """Write the stacks of all threads and a log line, then exit with `STUCK_EXIT`; never waits for the log's reader."""

    def write_stacks() -> None:
        faulthandler.dump_traceback(sys.__stderr__ or 2, all_threads=True)
        log.critical("the event loop has not turned for %.1f s; the stacks above show where it is stuck", still)
        for handler in logging.getLogger().handlers:
            handler.flush()

    writing = threading.Thread(target=write_stacks, daemon=True)
    writing.start()
    writing.join(_LAST_LOG_SECONDS)
    os._exit(STUCK_EXIT)
