"""Since when the arm is at home, out of the way of a camera that looks at what lies around it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

AT_HOME = 0.02  # [rad] from it the arm is out of the picture as well


def is_home(q: Sequence[float], home: Sequence[float]) -> bool:
    """Whether joint positions [rad] are those of home, as far as a camera is concerned."""
    return bool(np.abs(np.array(q) - np.array(home)).max() <= AT_HOME)


class HomeWatch:
    """Knows since when the arm is at home: only then does a picture show the objects without the arm."""

    def __init__(self, home: Sequence[float]) -> None:
        """Start with nothing known of the arm.

        Args:
            home: joint positions [rad] at which the arm hides nothing.
        """
        self._home = list(home)
        self._since: int | None = None
        self._until: int | None = None
        self._known = False

    def note(self, q: Sequence[float], stamp: int) -> None:
        """Take in joint positions [rad] and when they were measured [ns]."""
        if not is_home(q, self._home):
            self._until = stamp if self._until is None else self._until
        elif not self._known:
            self._since = 0  # it has not moved before, as far as anybody here knows
        elif self._until is not None or (self._since or 0) > stamp:  # that was of a time to come
            self._since, self._until = stamp, None
        self._known = True

    def covers(self, stamp: int) -> bool:
        """Whether the arm was at home at a time [ns]."""
        return self._since is not None and self._since <= stamp and (self._until is None or stamp < self._until)
