"""Watchdogs of a task: services that it depends on, freshness of images, and how long a condition lasts.

A task needs joint states, a planner and an executor. While one is missing the arm is held on its path and resumes the
same path later. Without joint states its position is unknown; without a planner no retreat is possible. A hold loses
nothing and repeats nothing.
"""

from __future__ import annotations

from collections.abc import Callable

from common import messages as m
from common.time_source import WatchdogClock

LOOK_PERIOD = 0.05  # [s] longest period between two updates of a task that runs on time
USUAL_GAPS = 4  # joint states are missing after this many of their usual periods
SLOWEST_GAP = 2.0  # [s] a longer gap is an outage, not a rate
REMEMBERED = 2.0  # [s] for which an own delay counts: other processes were probably delayed as well
STEADY = 0.2  # [s] change of a camera clock's lead that is reported again
HOPS = 2  # processes between robot and task, each assumed as late as this one


class LivenessWatchdog:
    """Checks on the process uptime clock whether the needed services are there. Times are wall time [s]."""

    def __init__(self, received: Callable[[], int], timeout: Callable[[], float]) -> None:
        """Start without any joint state, which is no fault yet.

        Args:
            received: number of joint states so far.
            timeout: time without joint states after which the arm is held [s].
        """
        self.trouble = ""  # why the arm must not move now
        self._received, self._timeout = received, timeout
        self._awake = WatchdogClock(2 * LOOK_PERIOD)
        self._count: int | None = None
        self._heard = 0.0  # process uptime
        self._gap = 0.0  # usual period of joint states
        self._late = self._late_at = 0.0
        self._seen: set[str] = set()
        self._holding: bool | None = None  # unknown until the first motion status

    def look(self, now: float, serving: dict[str, bool], motion: m.MotionStatus | None) -> list[m.HoldRequest]:
        """Return the hold requests to send; `trouble` tells what is missing.

        Args:
            now: monotonic clock [s].
            serving: by service name, whether it answers requests.
            motion: newest motion status.
        """
        self._seen |= {name for name, there in serving.items() if there}
        gone = [name for name, there in serving.items() if not there and name in self._seen]
        silent = self._joints_are_missing(self._awake.advance(now))
        self.trouble = f"{' and '.join(gone)} {'is' if len(gone) == 1 else 'are'} gone" if gone else silent
        if motion is None:
            return []
        if self._holding is None:  # set by the task process before this one
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
    """Checks the age of images by their stamps. Tolerances are wall time [s], stamps cell time [s]."""

    def __init__(self, speed: float) -> None:
        """Check in a cell whose time runs `speed` times as fast as wall time."""
        self._speed = speed
        self._ahead: float | None = None  # last reported lead of the camera clock [s, wall]

    def problem(self, now: float, stamps: tuple[float, ...], frame_timeout: float, clock_tolerance: float) -> str:
        """Return why images cannot be used to decide; empty when they can.

        Wall-time delays grow with the speed of the cell.

        Args:
            now: cell time.
            stamps: times of the newest images, one for each source.
            frame_timeout: age from which an image is too old.
            clock_tolerance: lead from which a camera clock is unusable.
        """
        ahead = (max(stamps) - now) / self._speed
        if ahead > clock_tolerance:
            if self._ahead is None or abs(ahead - self._ahead) > STEADY:  # else every image would change the message
                self._ahead = ahead
            return f"the camera's clock is {self._ahead:.1f} s ahead"
        self._ahead = None
        return "" if now - min(stamps) < frame_timeout * self._speed else "no fresh picture"


class DwellTimer:
    """Measures for how long the same reason has been given without interruption."""

    def __init__(self) -> None:
        """Start without a reason."""
        self._since: tuple[object, float] | None = None

    def elapsed(self, reason: object, now: float) -> float:
        """Return the time since this reason was first given [s]; another reason restarts the timer."""
        if self._since is None or self._since[0] != reason:
            self._since = reason, now
        return now - self._since[1]

    def reset(self) -> None:
        """Restart the timer."""
        self._since = None


def _hold(hold: bool, reason: str) -> m.HoldRequest:
    return m.HoldRequest(hold=hold, reason=reason, by="watchdog")
