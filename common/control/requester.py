"""What the controller makes of whoever asks: a request that comes too late, and a task that is gone in mid-motion."""

from __future__ import annotations

import math
from typing import Literal

from common.errors import Refused

WhenAlone = Literal["finish", "hold"]


class Alone:
    """Says when the arm is to be held because the task is gone in the middle of a motion."""

    def __init__(self) -> None:
        """Begin without having seen the task, whose absence then means nothing: a person may move the arm."""
        self._there = False
        self._orphan = ""  # goal that was followed when the task vanished

    def look(self, there: bool, goal: str, when: WhenAlone) -> bool:
        """Whether the arm is to be held now.

        Args:
            there: whether the task is ready, by its liveliness token.
            goal: id of the goal that is followed; empty when there is none.
            when: what was asked for.
        """
        if there:
            self._orphan = ""
        elif self._there:
            self._orphan = goal
        self._there = there
        return when == "hold" and bool(goal) and goal == self._orphan


STALE, AHEAD = "stale_request", "clock_ahead"


def objection(age: float, longest: float, clock_tolerance: float, uptime: float = math.inf) -> Refused | None:
    """What speaks against a request because of its age; None when nothing does.

    One that was decided before the controller began may have been carried out by the one before it, which knew its id.

    Args:
        age: since it was decided, by the clocks of both hosts; negative when that lies in the future [s, wall].
        longest: that it may take to arrive [s].
        clock_tolerance: how far the clocks may differ [s].
        uptime: since the controller began [s, wall].
    """
    if age > longest:
        told = f"is {age:.1f} s old" if age < 1e6 else "does not say when it was decided (header.stamp)"
        return Refused(STALE, f"the request {told}: more than {longest:g} s, or the clocks differ")
    if age > uptime:
        return Refused(STALE, f"the request was decided {age - uptime:.1f} s before the controller began: it may have "
                              "been carried out already")
    if age < -clock_tolerance:
        return Refused(AHEAD, f"the request comes from {-age:.1f} s ahead: the clock of who asks is wrong, or ours")
    return None
