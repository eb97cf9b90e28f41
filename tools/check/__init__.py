"""Checks of a cell before anything moves: problems that its files show, without processes or network."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from common.errors import ConfigError


@dataclass(frozen=True)
class Finding:
    """One problem and its remedy.

    Attributes:
        severity: with an error the cell cannot do its task; with a warning it may.
        what: field or object with its value, and what is wrong with it.
        remedy: what to change.
        refused: whether the arm or its fingers would move wrongly, so that `run` and `up` refuse the cell.
    """

    severity: Literal["error", "warning"]
    what: str
    remedy: str
    refused: bool = False

    @property
    def line(self) -> str:
        """Problem and remedy in one line."""
        return f"{self.what}: {self.remedy}"


def error(what: str, remedy: str, *, refused: bool = False) -> Finding:
    """Return a finding because of which the cell cannot do its task."""
    return Finding("error", what, remedy, refused)


def warning(what: str, remedy: str) -> Finding:
    """Return a finding about what may go wrong."""
    return Finding("warning", what, remedy)


def refusal(problem: ConfigError) -> Finding:
    """Return a finding of a configuration error, with which a service does not start either."""
    return Finding("error", str(problem), "correct it; the cell does not come up", refused=True)
