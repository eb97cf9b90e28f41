"""Coming to rest along a trajectory's own path: its time axis is slowed down to nothing."""

from __future__ import annotations

import numpy as np

from common.hardware.interface import Limits
from common.hardware.trajectory import Trajectory

SHORTEST = 0.05  # cell time of the quickest stop [s]
SAMPLES = 16


class Stop:
    """A rate of the trajectory's time that falls smoothly from 1 to 0: 1 - 3u^2 + 2u^3, u = elapsed / duration."""

    def __init__(self, duration: float) -> None:
        """Come to rest in `duration` [s]."""
        self.duration = duration
        self._elapsed = 0.0

    @property
    def done(self) -> bool:
        """Whether the rate is 0."""
        return self._elapsed >= self.duration

    @property
    def rate(self) -> float:
        """Seconds of the trajectory per second now."""
        return self.rate_at(min(self._elapsed / self.duration, 1.0))

    def advance(self, seconds: float) -> float:
        """How far the trajectory's time moves on [s] in the next seconds."""
        before = self.way_at(min(self._elapsed / self.duration, 1.0))
        self._elapsed += seconds
        return self.way_at(min(self._elapsed / self.duration, 1.0)) - before

    def rate_at(self, u: float) -> float:
        """Rate at a fraction 0 to 1 of the stop."""
        return 1 - 3 * u**2 + 2 * u**3

    def way_at(self, u: float) -> float:
        """Integral of the rate [s] up to a fraction 0 to 1 of the stop."""
        return self.duration * (u - u**3 + u**4 / 2)

    def slowing_at(self, u: float) -> float:
        """Change of the rate [1/s] at a fraction 0 to 1 of the stop."""
        return -6 * u * (1 - u) / self.duration


def plan_stop(trajectory: Trajectory, time: float, limits: Limits) -> Stop:
    """The quickest stop from a time [s] on the trajectory that keeps within the acceleration limits.

    On the slowed path ddq = ddq(s) s'^2 + dq(s) s''. A stop that takes twice the time that is left ends at the
    trajectory's own end and asks for hardly more than the trajectory itself: the search ends there.
    """
    longest = max(SHORTEST, 2 * (trajectory.duration - time))
    duration = SHORTEST
    while duration < longest:
        stop = Stop(duration)
        if all(_within(trajectory, time, stop, u, limits) for u in np.linspace(0.0, 1.0, SAMPLES)):
            return stop
        duration *= 1.25
    return Stop(longest)


def _within(trajectory: Trajectory, time: float, stop: Stop, u: float, limits: Limits) -> bool:
    _, dq, ddq = trajectory.at(time + stop.way_at(u))
    asked = ddq * stop.rate_at(u) ** 2 + dq * stop.slowing_at(u)
    # Where the trajectory itself is a little over the limit, going on as planned must stay possible.
    return bool(np.all(np.abs(asked) <= np.maximum(limits.acceleration, np.abs(ddq))))
