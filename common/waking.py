"""Time in which this process was awake: what watchdogs count by, so that nobody is blamed for our own sleep."""

from __future__ import annotations


class Waking:
    """Counts waking time [s] from looks at a clock that come in a known rhythm.

    Between two looks no more than `longest` counts: a process that was suspended, or had to wait long for a processor,
    has neither heard the others nor been heard by them meanwhile.
    """

    def __init__(self, longest: float) -> None:
        """Begin at 0; `longest` [s] is what may count between two looks."""
        self.now = 0.0
        self.late = 0.0  # by how much the newest look came later than that [s]
        self._longest = longest
        self._before: float | None = None

    def look(self, now: float) -> float:
        """The waking time so far, given what the clock says [s, monotonic]."""
        passed = 0.0 if self._before is None else max(0.0, now - self._before)
        self._before = now
        self.late = max(0.0, passed - self._longest)
        self.now += min(passed, self._longest)
        return self.now
