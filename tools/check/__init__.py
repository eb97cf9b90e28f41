"""One thing in a cell that will not work."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from common.errors import ConfigError


@dataclass(frozen=True)
class Finding:
    """One thing that will not work, and what helps.

    Attributes:
        severity: with an error the cell does not do what it is for; with a warning it may.
        what: the field or thing with its value, and what is wrong with it.
        remedy: what to change.
        refused: the arm or its fingers would move wrongly, so `run` and `up` do not begin.
    """

    severity: Literal["error", "warning"]
    what: str
    remedy: str
    refused: bool = False

    @property
    def line(self) -> str:
        """All of it in one line."""
        return f"{self.what}: {self.remedy}"


def error(what: str, remedy: str, *, refused: bool = False) -> Finding:
    """Something because of which the cell does not do what it is for."""
    return Finding("error", what, remedy, refused)


def warning(what: str, remedy: str) -> Finding:
    """Something that may go wrong."""
    return Finding("warning", what, remedy)


def refusal(told: ConfigError) -> Finding:
    """An error that ends the start of a service, too."""
    return Finding("error", str(told), "correct it; the cell does not come up so", refused=True)
