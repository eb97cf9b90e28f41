"""Goals by their ids, so that a repeated request is answered and never acted on twice."""

from __future__ import annotations

from collections import OrderedDict
from typing import Generic, TypeVar

S = TypeVar("S")

REMEMBERED = 1000  # goals that were followed, and as many that were refused; older requests are refused for their age


class GoalMemory(Generic[S]):
    """The newest states of the last goals; those that were refused push out none that was followed."""

    def __init__(self, most: int = REMEMBERED) -> None:
        """Remember at most so many goals of either kind; the one heard of longest ago is forgotten first."""
        self._most = most
        self._followed: OrderedDict[str, S] = OrderedDict()
        self._refused: OrderedDict[str, S] = OrderedDict()

    def get(self, goal: str) -> S | None:
        """The state of a goal, or None for an id that was never heard of."""
        return self._followed.get(goal) or self._refused.get(goal)

    def put(self, goal: str, state: S, *, refused: bool = False) -> S:
        """Remember and return the state of a goal."""
        states = self._refused if refused else self._followed
        states[goal] = state
        states.move_to_end(goal)
        while len(states) > self._most:
            states.popitem(last=False)
        return state
