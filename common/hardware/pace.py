"""How fast a trajectory's time passes, so that the joints keep their limits while that changes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from common.hardware.interface import Vector

Path = Callable[[float], tuple[Vector, Vector]]  # trajectory's time [s] to q (dof,) [rad] and q' (dof,) [rad/s]

QUICKEST = 0.03  # cell time in which the rate falls from 1 to 0 at best [s]
GENTLE = 0.3  # cell time in which it rises from 0 to 1, or changes with the speed that is asked for [s]
HALVINGS = 10  # of the interval in which the largest change is looked for
REACHED = 1e-9  # nearer to its target, the rate is there


@dataclass
class Pace:
    """How fast a trajectory's time passes, and how that changes.

    Attributes:
        rate: seconds of trajectory's time per second of cell time, 0 to 1.
        slope: change of the rate in the newest step [1/s].
        gentle: cell time in which it rises from 0 to 1 at best [s].
        acceleration: mean of the joints (dof,) in that step [rad/s^2].
    """

    rate: float
    acceleration: Vector
    slope: float = 0.0
    gentle: float = GENTLE

    def rest(self) -> None:
        """Go on from rest."""
        self.rate, self.slope, self.acceleration = 0.0, 0.0, 0.0 * self.acceleration

    def advance(
        self, path: Path, time: float, target: float, step: float, acceleration: Vector, jerk: Vector
    ) -> float:
        """Trajectory's time after a step [s], with the rate as near to the target as accelerations and jerk allow.

        Args:
            path: what is followed.
            time: trajectory's time at the begin of the step [s].
            target: 0 to 1; 0 is braking, for which there is no time to lose.
            step: duration of the step, cell time [s].
            acceleration, jerk: what the joints can do, (dof,) [rad/s^2], [rad/s^3].
        """
        if step <= 0.0:
            return time
        before = path(time)[1] * self.rate
        rate = next_rate(path, time, self, target, step, acceleration, jerk)
        after = time + way(self.rate, rate, step)
        self.acceleration = (path(after)[1] * rate - before) / step
        self.rate, self.slope = rate, (rate - self.rate) / step
        return after


def next_rate(
    path: Path, time: float, pace: Pace, target: float, step: float, acceleration: Vector, jerk: Vector
) -> float:
    """The rate at the end of a step: see `Pace.advance`."""
    rate, slope = pace.rate, pace.slope
    if rate == target and slope == 0.0:
        return target
    change = path(time)[1]
    # How fast the slope may change: so that the joints keep their jerk, and the slope is back at 0 at the target.
    bend = float(np.min(jerk / np.maximum(np.abs(change), 1e-9))) * step
    off = abs(target - rate) / step
    eased = off if off <= bend else bend * (math.sqrt(1 + 8 * off / bend) - 1) / 2
    wanted = math.copysign(min(eased, 1 / (QUICKEST if target == 0.0 else pace.gentle)), target - rate)
    wanted = min(max(wanted, slope - bend), slope + bend)
    even = min(max(0.0, slope - bend), slope + bend)  # the nearest to going on at the rate of now
    before = change * rate

    def asked(slope: float) -> Vector:
        end = max(rate + slope * step, 0.0)
        return (path(time + way(rate, end, step))[1] * end - before) / step

    # Where the trajectory itself is a little over the limits, going on as planned must stay possible.
    planned = asked(even)
    hardest = np.maximum(acceleration, np.abs(planned))
    jump = np.maximum(jerk * step, np.abs(planned - pace.acceleration))

    def possible(slope: float) -> bool:
        found = asked(slope)
        return bool(np.all(np.abs(found) <= hardest) and np.all(np.abs(found - pace.acceleration) <= jump))

    if not possible(wanted):
        share, step_share = 0.0, 0.5
        for _ in range(HALVINGS):
            if possible(even + (share + step_share) * (wanted - even)):
                share += step_share
            step_share /= 2
        wanted = even + share * (wanted - even)
    end = max(rate + wanted * step, 0.0)
    return target if abs(end - target) < REACHED else end


def way(begin: float, end: float, step: float) -> float:
    """Trajectory's time that passes [s] in a step [s] during which the rate changes evenly."""
    return (begin + end) / 2 * step
