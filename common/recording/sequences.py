"""Sequence numbers as they come: which message is a repetition, and how many were lost on the way."""

from __future__ import annotations

from collections import Counter


class Sequences:
    """The newest sequence number of each key and writer. Not thread-safe: one thread calls it at a time."""

    def __init__(self) -> None:
        """Nothing came yet."""
        self.missed: Counter[str] = Counter()  # by key: numbers that never came
        self._newest: dict[tuple[str, str], int] = {}

    def is_new(self, key: str, writer: str, sequence: int) -> bool:
        """Whether a message is newer than what its writer said before; a gap before it is counted.

        A state comes again each second under the same number, and by a question beside the subscription.
        """
        before = self._newest.get((key, writer))
        if before is not None and sequence <= before:
            return False
        self._newest[key, writer] = sequence
        if before is not None and sequence > before + 1:
            self.missed[key] += sequence - before - 1
        return True
