"""Goals by their ids, so that a repeated request is answered and never acted on twice."""

from __future__ import annotations

from collections import OrderedDict
from typing import Generic, TypeVar

S = TypeVar("S")

REMEMBERED = 100  # goals: minutes of them, where a request that is older than seconds is refused for its age


class GoalMemory(Generic[S]):
    """The newest states of the last goals."""

    def __init__(self, most: int = REMEMBERED) -> None:
        """Remember at most so many goals; the one heard of longest ago is forgotten first."""
        self._most = most
        self._states: OrderedDict[str, S] = OrderedDict()

    def get(self, goal: str) -> S | None:
        """The state of a goal, or None for an id that was never heard of."""
        return self._states.get(goal)

    def put(self, goal: str, state: S) -> S:
        """Remember and return the state of a goal."""
        self._states[goal] = state
        self._states.move_to_end(goal)
        while len(self._states) > self._most:
            self._states.popitem(last=False)
        return state
