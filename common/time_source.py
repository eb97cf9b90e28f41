"""Source of time and ids: this machine, or a simulation that runs in this process.

All code of a cell takes them from here, so that a simulation controls both.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

# Without such a clock (macOS) the monotonic one is the same in all processes as well.
_HOST_CLOCK = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)

_READINGS, _GOOD_READING_NS = 10, 10_000  # of two clocks at one time


class TimeSource(Protocol):
    """A monotonic clock, a boot clock, a wall clock, and ids."""

    def monotonic_ns(self) -> int:
        """Return the time since an arbitrary moment [ns]."""

    def host_ns(self) -> int:
        """Return the time since this host was booted, sleep included [ns]: the same in all its processes."""

    def wall_ns(self) -> int:
        """Return the time since the Unix epoch [ns]."""

    def token_hex(self, count: int) -> str:
        """Return `count` unique bytes in hexadecimal digits."""


def _host_ns() -> int:
    return time.clock_gettime_ns(_HOST_CLOCK)


class SystemTimeSource:
    """The clocks of this machine, and random ids."""

    monotonic_ns = staticmethod(time.monotonic_ns)
    host_ns = staticmethod(_host_ns)
    wall_ns = staticmethod(time.time_ns)
    token_hex = staticmethod(secrets.token_hex)


class _Current:
    source: TimeSource = SystemTimeSource()


def monotonic() -> float:
    """Return the time since an arbitrary moment [s], for durations."""
    return _Current.source.monotonic_ns() * 1e-9


def monotonic_ns() -> int:
    """Return the time since an arbitrary moment [ns], for durations."""
    return _Current.source.monotonic_ns()


def host_ns() -> int:
    """Return the time since this host was booted, sleep included [ns]: the same in all its processes."""
    return _Current.source.host_ns()


def wall_ns() -> int:
    """Return the time since the Unix epoch [ns]; it may be set back."""
    return _Current.source.wall_ns()


def booted_ns() -> int:
    """Return the Unix time at which this host's boot clock was at 0 [ns], by the system clock as it is set now."""
    best, error = 0, None
    for _ in range(_READINGS):
        before = host_ns()
        wall = wall_ns()
        took = host_ns() - before
        if error is None or took < error:
            best, error = wall - before - took // 2, took
        if error < _GOOD_READING_NS:
            break  # else another process had the processor between the readings
    return best


def new_id(count: int = 4) -> str:
    """Return an id of `count` bytes in hexadecimal digits."""
    return _Current.source.token_hex(count)


@contextmanager
def use_time_source(source: TimeSource) -> Iterator[None]:
    """Use another source for the whole process inside the block."""
    before, _Current.source = _Current.source, source
    try:
        yield
    finally:
        _Current.source = before


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
