"""One thing that was looked at."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at, and what to do when it is not well."""

    level: Literal["ok", "warn", "fail"]
    what: str
    remedy: str = ""


def ok(what: str) -> Finding:
    """All is well with something."""
    return Finding("ok", what)


def warn(what: str, remedy: str) -> Finding:
    """A cell may run, but not as it should."""
    return Finding("warn", what, remedy)


def fail(what: str, remedy: str) -> Finding:
    """A cell will not run."""
    return Finding("fail", what, remedy)
