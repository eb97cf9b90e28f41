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


class Sources(Protocol):
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


class Machine:
    """The clocks of this machine, and ids that nobody can guess."""

    monotonic_ns = staticmethod(time.monotonic_ns)
    host_ns = staticmethod(_host_ns)
    wall_ns = staticmethod(time.time_ns)
    token_hex = staticmethod(secrets.token_hex)


class _Chosen:
    sources: Sources = Machine()


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
def drawn_from(sources: Sources) -> Iterator[None]:
    """Inside, everything in this process takes time and ids from there."""
    before, _Chosen.sources = _Chosen.sources, sources
    try:
        yield
    finally:
        _Chosen.sources = before
