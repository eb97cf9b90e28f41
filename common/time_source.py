"""Where time and ids come from: this machine, or a simulation that runs in this process.

Whatever a cell does asks here and not the machine itself, so that a simulation decides both.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

# Where there is no such clock (macOS), the monotonic one is shared by all processes as well.
_HOST_CLOCK = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)


class TimeSource(Protocol):
    """A clock that never goes back, one that says what day it is, and ids."""

    def monotonic_ns(self) -> int:
        """Time since some moment [ns]."""

    def host_ns(self) -> int:
        """Time since this host was started, also while it slept [ns]: the same in all its processes."""

    def wall_ns(self) -> int:
        """Time since the Unix epoch [ns]."""

    def token_hex(self, count: int) -> str:
        """So many bytes that nobody else has, in hexadecimal digits."""


def _host_ns() -> int:
    return time.clock_gettime_ns(_HOST_CLOCK)


class SystemTimeSource:
    """The clocks of this machine, and ids that nobody can guess."""

    monotonic_ns = staticmethod(time.monotonic_ns)
    host_ns = staticmethod(_host_ns)
    wall_ns = staticmethod(time.time_ns)
    token_hex = staticmethod(secrets.token_hex)


class _Chosen:
    sources: TimeSource = SystemTimeSource()


def monotonic() -> float:
    """Time since some moment [s], for durations."""
    return _Chosen.sources.monotonic_ns() * 1e-9


def monotonic_ns() -> int:
    """Time since some moment [ns], for durations."""
    return _Chosen.sources.monotonic_ns()


def host_ns() -> int:
    """Time since this host was started, also while it slept [ns]: the same in all its processes."""
    return _Chosen.sources.host_ns()


def wall_ns() -> int:
    """Time since the Unix epoch [ns]; may be set back."""
    return _Chosen.sources.wall_ns()


def new_id(count: int = 4) -> str:
    """An id of `count` bytes in hexadecimal digits."""
    return _Chosen.sources.token_hex(count)


@contextmanager
def use_time_source(sources: TimeSource) -> Iterator[None]:
    """Inside, everything in this process takes time and ids from there."""
    before, _Chosen.sources = _Chosen.sources, sources
    try:
        yield
    finally:
        _Chosen.sources = before


class WatchdogClock:
    """Counts the time [s] in which this process ran, from readings of a clock that come in a known rhythm.

    At most `longest` counts between two readings: a suspended process, or one that waited long for a processor, could
    neither receive nor send meanwhile, and must not take others for silent.
    """

    def __init__(self, longest: float) -> None:
        """Start at 0; at most `longest` [s] counts between two readings."""
        self.now = 0.0
        self.late = 0.0  # delay of the newest reading beyond that [s]
        self._longest = longest
        self._before: float | None = None

    def advance(self, now: float) -> float:
        """Return the running time after a reading of the clock [s, monotonic]."""
        passed = 0.0 if self._before is None else max(0.0, now - self._before)
        self._before = now
        self.late = max(0.0, passed - self._longest)
        self.now += min(passed, self._longest)
        return self.now
