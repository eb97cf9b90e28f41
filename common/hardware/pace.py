"""Time scaling of a trajectory: change the rate at which its time passes while the joints keep their limits."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from common.hardware.interface import Vector

Path = Callable[[float], tuple[Vector, Vector]]  # trajectory time [s] to q (dof,) [rad] and q' (dof,) [rad/s]

SHORTEST_STOP = 0.03  # [s] cell time in which the rate falls from 1 to 0 at best
RAMP_UP = 0.3  # [s] cell time in which it rises from 0 to 1, or follows a change of the requested speed
CATCH_UP = 1.15  # rate at most of a trajectory that is behind its schedule
HALVINGS = 10  # of the interval in which the largest allowed change is searched
REACHED = 1e-9  # closer to its target, the rate is there


@dataclass
class Pace:
    """The rate of a trajectory's time, and how it changes; above 1 only to catch up with a schedule.

    Attributes:
        rate: seconds of trajectory time per second of cell time, 0 to CATCH_UP.
        slope: change of the rate in the newest step [1/s].
        ramp_up: cell time in which it rises from 0 to 1 at best [s].
        acceleration: mean of the joints (dof,) in that step [rad/s^2].
    """

    rate: float
    acceleration: Vector
    slope: float = 0.0
    ramp_up: float = RAMP_UP

    def rest(self) -> None:
        """Continue from rest."""
        self.rate, self.slope, self.acceleration = 0.0, 0.0, 0.0 * self.acceleration

    def advance(
        self, path: Path, time: float, target: float, step: float, acceleration: Vector, jerk: Vector
    ) -> float:
        """Return the trajectory time after a step [s]; the rate comes as close to the target as the limits allow.

        Args:
            path: the trajectory.
            time: trajectory time at the start of the step [s].
            target: 0 to 1; 0 brakes as hard as the limits allow.
            step: duration of the step, cell time [s].
            acceleration, jerk: limits of the joints, (dof,) [rad/s^2], [rad/s^3].
        """
        if step <= 0.0:
            return time
        before = path(time)[1] * self.rate
        rate = next_rate(path, time, self, target, step, acceleration, jerk)
        after = time + elapsed_time(self.rate, rate, step)
        self.acceleration = (path(after)[1] * rate - before) / step
        self.rate, self.slope = rate, (rate - self.rate) / step
        return after


def next_rate(
    path: Path, time: float, pace: Pace, target: float, step: float, acceleration: Vector, jerk: Vector
) -> float:
    """Return the rate at the end of a step: see `Pace.advance`."""
    rate, slope = pace.rate, pace.slope
    if rate == target and slope == 0.0:
        return target
    change = path(time)[1]
    # Largest change of the slope with which the joints keep their jerk; the slope must be back at 0 at the target.
    bend = float(np.min(jerk / np.maximum(np.abs(change), 1e-9))) * step
    off = abs(target - rate) / step
    eased = off if off <= bend else bend * (math.sqrt(1 + 8 * off / bend) - 1) / 2
    desired = math.copysign(min(eased, 1 / (SHORTEST_STOP if target == 0.0 else pace.ramp_up)), target - rate)
    desired = min(max(desired, slope - bend), slope + bend)
    steady = min(max(0.0, slope - bend), slope + bend)  # the slope closest to keeping the present rate
    before = change * rate

    def mean_acceleration(slope: float) -> Vector:
        end = max(rate + slope * step, 0.0)
        return (path(time + elapsed_time(rate, end, step))[1] * end - before) / step

    # A trajectory that is slightly over the limits itself must still be able to continue as planned.
    planned = mean_acceleration(steady)
    most = np.maximum(acceleration, np.abs(planned))
    jump = np.maximum(jerk * step, np.abs(planned - pace.acceleration))

    def possible(slope: float) -> bool:
        found = mean_acceleration(slope)
        return bool(np.all(np.abs(found) <= most) and np.all(np.abs(found - pace.acceleration) <= jump))

    if not possible(desired):
        share, step_share = 0.0, 0.5
        for _ in range(HALVINGS):
            if possible(steady + (share + step_share) * (desired - steady)):
                share += step_share
            step_share /= 2
        desired = steady + share * (desired - steady)
    end = max(rate + desired * step, 0.0)
    return target if abs(end - target) < REACHED else end


def elapsed_time(begin: float, end: float, step: float) -> float:
    """Return the trajectory time [s] that passes in a step [s] in which the rate changes linearly."""
    return (begin + end) / 2 * step
