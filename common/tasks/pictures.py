"""Whether a picture may be decided by: not too old, and not from the future, which only a wrong clock says."""

from __future__ import annotations

STEADY = 0.2  # [s] a clock that is this much further ahead than was said is worth saying so again


class Pictures:
    """Judges pictures by when they were taken. Tolerances are wall time [s], stamps cell time [s]."""

    def __init__(self, speed: float) -> None:
        """Judge in a cell whose time passes `speed` times as fast as that on the wall."""
        self._speed = speed
        self._ahead: float | None = None  # as it was last said [s, wall]

    def problem(self, now: float, stamps: tuple[float, ...], frame_timeout: float, clock_tolerance: float) -> str:
        """Why pictures that were taken then can not be decided by now; empty when they can.

        A picture that is late by the clock on the wall is later still by that of a fast cell.

        Args:
            now: cell time.
            stamps: when the newest picture was taken, as each of those says who looked at it.
            frame_timeout: one of this age is too old.
            clock_tolerance: one that is this far in the future was stamped by a clock that can not be relied on.
        """
        ahead = (max(stamps) - now) / self._speed
        if ahead > clock_tolerance:
            if self._ahead is None or abs(ahead - self._ahead) > STEADY:  # else it would be told with each picture
                self._ahead = ahead
            return f"the camera's clock is {self._ahead:.1f} s ahead"
        self._ahead = None
        return "" if now - min(stamps) < frame_timeout * self._speed else "no fresh picture"
