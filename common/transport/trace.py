"""The trace id: what a message was caused by, carried from what a task read to what it puts."""

from __future__ import annotations

from contextvars import ContextVar

from common.sources import new_id

_current: ContextVar[str] = ContextVar("trace", default="")


def current_trace() -> str:
    """Trace of the message that this task read last, or a new one."""
    return _current.get() or new_id(8)


def follow(trace: str) -> None:
    """What this task puts from now on was caused by the message of that trace."""
    _current.set(trace)
