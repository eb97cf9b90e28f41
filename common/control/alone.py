"""What the arm does when the task that moves it is gone: finish what was begun, or wait for the task on its path."""

from __future__ import annotations

from typing import Literal

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
