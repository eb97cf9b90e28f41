"""Checks whether this machine can run cells, and says what to do about problems."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Finding:
    """Result of one check, with a remedy unless it is ok."""

    level: Literal["ok", "warn", "fail"]
    what: str
    remedy: str = ""


def ok(what: str) -> Finding:
    """Return a passed check."""
    return Finding("ok", what)


def warn(what: str, remedy: str) -> Finding:
    """Return a problem with which a cell may run, but not as it should."""
    return Finding("warn", what, remedy)


def fail(what: str, remedy: str) -> Finding:
    """Return a problem with which a cell does not run."""
    return Finding("fail", what, remedy)
