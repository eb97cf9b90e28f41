"""When the arm is at its home pose, where it does not occlude the view of a camera."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

HOME_TOLERANCE = 0.02  # [rad] this close to its home pose, the arm is outside the image as well


def is_home(q: Sequence[float], home: Sequence[float]) -> bool:
    """Return whether joint positions [rad] are those of home, within the tolerance for cameras."""
    return bool(np.abs(np.array(q) - np.array(home)).max() <= HOME_TOLERANCE)


class HomeMonitor:
    """Records since when the arm is at home: images taken then show the objects without the arm."""

    def __init__(self, home: Sequence[float]) -> None:
        """Start without any joint state.

        Args:
            home: joint positions [rad] at which the arm occludes nothing.
        """
        self._home = list(home)
        self._since: int | None = None
        self._until: int | None = None
        self._known = False

    def add(self, q: Sequence[float], stamp: int) -> None:
        """Add joint positions [rad] and their time [ns]."""
        if not is_home(q, self._home):
            self._until = stamp if self._until is None else self._until
        elif not self._known:
            self._since = 0  # no earlier motion is known
        elif self._until is not None or (self._since or 0) > stamp:  # the earlier stamp was in the future
            self._since, self._until = stamp, None
        self._known = True

    def was_home(self, stamp: int) -> bool:
        """Return whether the arm was at home at a time [ns]."""
        return self._since is not None and self._since <= stamp and (self._until is None or stamp < self._until)
