"""What a task watches while the arm moves: that those it relies on are there, and that its pictures are fresh.

It relies on joint states that keep coming, on a planner, and on an executor. Without them the arm is held on its path,
and goes on along the same path when they are back. It could finish a motion that was planned; but without joint states
nobody sees where it is, and without a planner nobody could bring it away from where something goes wrong. A hold loses
nothing and does nothing twice.
"""

from __future__ import annotations

from collections.abc import Callable

from common import messages as m
from common.waking import Waking

LOOK_PERIOD = 0.05  # [s] the longest time between two looks of a task that is not late itself
USUAL_GAPS = 4  # joint states that come slowly are missed after so many of their usual gaps
SLOWEST_GAP = 2.0  # [s] a longer one is a silence
REMEMBERED = 2.0  # [s] for which our own lateness counts: who waits for a processor is seldom alone
STEADY = 0.2  # [s] a camera's clock that is this much further ahead than was said is worth saying so again
HOPS = 2  # processes between the robot and us, each as late as we are


class LivenessWatchdog:
    """Judges by our own waking time whether those are there that the task relies on. Times are wall time [s]."""

    def __init__(self, received: Callable[[], int], timeout: Callable[[], float]) -> None:
        """Begin without having heard anything, which is no trouble yet.

        Args:
            received: how many joint states came so far.
            timeout: after how long without one the arm is held [s].
        """
        self.trouble = ""  # why the arm must not move now
        self._received, self._timeout = received, timeout
        self._awake = Waking(2 * LOOK_PERIOD)
        self._count: int | None = None
        self._heard = 0.0  # waking time
        self._gap = 0.0  # usual time between two joint states
        self._late = self._late_at = 0.0
        self._seen: set[str] = set()
        self._holding: bool | None = None  # not known until the robot was looked at

    def look(self, now: float, serving: dict[str, bool], motion: m.MotionStatus | None) -> list[m.HoldRequest]:
        """What to ask of the executor; `trouble` says what is the matter.

        Args:
            now: what the clock says [s, monotonic].
            serving: by the name of a service, whether it answers requests now.
            motion: what is known of the robot's motion.
        """
        self._seen |= {name for name, there in serving.items() if there}
        gone = [name for name, there in serving.items() if not there and name in self._seen]
        silent = self._joints_are_missing(self._awake.look(now))
        self.trouble = f"{' and '.join(gone)} {'is' if len(gone) == 1 else 'are'} gone" if gone else silent
        if motion is None:
            return []
        if self._holding is None:  # by the task before this one
            self._holding = "watchdog" in motion.held_by
        if self.trouble and motion.state == "active" and not self._holding:
            self._holding = True
            return [_hold(True, self.trouble)]
        if not self.trouble and self._holding:
            self._holding = False
            return [_hold(False, "what was missing is back")]
        return []

    def _joints_are_missing(self, awake: float) -> str:
        if self._awake.late >= self._late or awake - self._late_at > REMEMBERED:
            self._late, self._late_at = self._awake.late, awake
        new = self._received() - (self._count or 0)
        if new > 0:
            gap = (awake - self._heard) / new
            if self._count is not None and gap <= SLOWEST_GAP:
                self._gap += (0.1 if self._gap else 1.0) * (gap - self._gap)
            self._count, self._heard = self._received(), awake
        if self._count is None:
            return ""
        patience = max(self._timeout(), USUAL_GAPS * self._gap) + HOPS * self._late
        return f"no joint states for {1e3 * self._timeout():.0f} ms" if awake - self._heard > patience else ""


class ImageAge:
    """Judges pictures by when they were taken. Tolerances are wall time [s], stamps cell time [s]."""

    def __init__(self, speed: float) -> None:
        """Judge in a cell whose time passes `speed` times as fast as that on the wall."""
        self._speed = speed
        self._ahead: float | None = None  # as it was last said [s, wall]

    def problem(self, now: float, stamps: tuple[float, ...], frame_timeout: float, clock_tolerance: float) -> str:
        """Why pictures that were taken then cannot be decided by now; empty when they can.

        A picture that is late by the clock on the wall is later still by that of a fast cell.

        Args:
            now: cell time.
            stamps: when the newest picture was taken, as each of those says who looked at it.
            frame_timeout: one of this age is too old.
            clock_tolerance: one that is this far in the future was stamped by a clock that cannot be relied on.
        """
        ahead = (max(stamps) - now) / self._speed
        if ahead > clock_tolerance:
            if self._ahead is None or abs(ahead - self._ahead) > STEADY:  # else it would be told with each picture
                self._ahead = ahead
            return f"the camera's clock is {self._ahead:.1f} s ahead"
        self._ahead = None
        return "" if now - min(stamps) < frame_timeout * self._speed else "no fresh picture"


class DwellTimer:
    """For how long the same reason to wait has lasted."""

    def __init__(self) -> None:
        """Begin without a reason."""
        self._since: tuple[object, float] | None = None

    def elapsed(self, reason: object, now: float) -> float:
        """How long ago that reason was given for the first time, with no other since [s]."""
        if self._since is None or self._since[0] != reason:
            self._since = reason, now
        return now - self._since[1]

    def reset(self) -> None:
        """Begin anew."""
        self._since = None


def _hold(hold: bool, reason: str) -> m.HoldRequest:
    return m.HoldRequest(hold=hold, reason=reason, by="watchdog")
