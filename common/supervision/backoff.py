"""How long to wait before a process that died is started again."""

from __future__ import annotations


class Backoff:
    """A delay that doubles with each failure up to a cap, and starts over after a long enough life."""

    def __init__(self, first: float = 0.1, factor: float = 2.0, most: float = 5.0, reset_after: float = 10.0) -> None:
        """Start at the shortest delay.

        Args:
            first: delay after the first failure [s].
            factor: growth from one failure to the next.
            most: the delay never exceeds this [s].
            reset_after: a life at least this long counts as healthy [s].
        """
        self.first = first
        self.factor = factor
        self.most = most
        self.reset_after = reset_after
        self._next = first

    def after(self, alive_seconds: float) -> float:
        """Delay [s] before the next start, for a process that lived this long."""
        if alive_seconds >= self.reset_after:
            self._next = self.first
        delay = self._next
        self._next = min(self.most, delay * self.factor)
        return delay
