"""When the gripper is commanded: as the widths of a chunk cross the middle, with hysteresis."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

CLOSES, OPENS = 0.45, 0.55  # share of the largest width below which fingers close, and above which they open


class GripperSchedule:
    """Widths that a policy wants, by cell time."""

    def __init__(self, widest: float) -> None:
        """Start without any; `widest` [m] is the open gripper."""
        self._widest = widest
        self._times, self._widths = np.zeros(0), np.zeros(0)
        self.open: bool | None = None  # what was commanded last; None: unknown

    def reset(self, width: float | None = None) -> None:
        """Forget the widths, and what was commanded: it is what is measured [m], if that is known."""
        self._times, self._widths = np.zeros(0), np.zeros(0)
        self.open = None if width is None else width > OPENS * self._widest

    def set(self, times: NDArray[np.float64], widths: NDArray[np.float64]) -> None:
        """Replace the widths (n,) [m] from the first of these cell times (n,) [s] on."""
        if len(times) == 0 or self._widest <= 0.0:
            return
        before = self._times < times[0]
        self._times = np.concatenate([self._times[before], times])
        self._widths = np.concatenate([self._widths[before], np.clip(widths, 0.0, self._widest)])

    def due(self, now: float) -> float | None:
        """Return the width [m] to command at a cell time [s], or None."""
        index = int(np.searchsorted(self._times, now, side="right")) - 1
        if index < 0:
            return None
        width = float(self._widths[index])
        self._times, self._widths = self._times[index:], self._widths[index:]
        if width < CLOSES * self._widest and self.open is not False:
            self.open = False
        elif width > OPENS * self._widest and self.open is not True:
            self.open = True
        else:
            return None
        return width
