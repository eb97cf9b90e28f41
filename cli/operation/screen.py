"""What a screen is: where lines and the state of a cell are shown while it is up."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from common.messages import ServiceStatus


@dataclass(frozen=True)
class Content:
    """What the live table shows."""

    services: list[ServiceStatus]
    rates: dict[str, tuple[str, float]]  # by service: the topic that it writes most often, and how often [Hz]
    progress: str  # of the task


class Screen(Protocol):
    """Where lines and the state of the cell are shown."""

    def line(self, service: str, text: str) -> None:
        """Show one line that a process wrote."""

    def note(self, text: str) -> None:
        """Show a line of the supervisor's own for the person in front of it."""

    def progress(self, text: str) -> None:
        """Show how far the task is."""

    def close(self) -> None:
        """Leave the terminal as it was."""
