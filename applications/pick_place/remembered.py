"""What was offered to the task and cannot be judged any more, because something came before it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

Place = tuple[float, float, float]

HIDDEN = "hidden"  # label of a target that was seen before something hid it


class Remembered:
    """Keeps targets while their places are hidden: what nobody sees is not gone."""

    def __init__(self, same_place: float = 0.03) -> None:
        """Start with nothing seen.

        Args:
            same_place: detections within this are at the same place [m].
        """
        self._same_place = same_place
        self._before: list[Place] = []

    def hidden(
        self, targets: list[Place], others: Iterable[Place], hides: Callable[[Place], bool] | None
    ) -> list[Place]:
        """Targets of before that are not among those of this frame, and whose places it does not show.

        Args:
            targets: of the frame [m].
            others: what else the frame shows, which is at its place now [m].
            hides: whether a place cannot be judged in it; None: all of it can.
        """
        shown = [*targets, *others]
        kept = [] if hides is None else [
            place for place in self._before
            if all(math.dist(place, one) >= self._same_place for one in shown) and hides(place)
        ]
        self._before = [*targets, *kept]
        return kept
