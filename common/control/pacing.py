"""How fast a trajectory's own time passes: slower for an operator, not at all while the robot is held.

The geometry of the path stays as it is. With s the trajectory's time, r = ds/dt its rate and ' = d/ds, the joints move
at dq = q' r and ddq = q'' r^2 + q' dr/dt. As the trajectory itself (r = 1) is within the limits, going on at any
constant rate up to 1 is too; what is left of the limits may change the rate. So a rate that is brought towards its
target by no more than the limits allow in each cycle can not run into a dead end.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from common.hardware.interface import Vector

Path = Callable[[float], tuple[Vector, Vector]]  # trajectory's time [s] to q (dof,) [rad] and q' (dof,) [rad/s]

QUICKEST = 0.03  # cell time in which the rate falls from 1 to 0 at best [s]
GENTLE = 0.3  # cell time in which it rises from 0 to 1, or changes with the speed that is asked for [s]
HALVINGS = 10  # of the interval in which the largest change is looked for


def next_rate(path: Path, time: float, rate: float, target: float, step: float, acceleration: Vector) -> float:
    """The rate at the end of a step, as near to the target as the accelerations allow.

    Args:
        path: what is followed.
        time: trajectory's time at the begin of the step [s].
        rate: at the begin of the step, 0 to 1.
        target: 0 to 1; 0 is braking, for which there is no time to lose.
        step: duration of the step, cell time [s].
        acceleration: what the joints can do, (dof,) [rad/s^2].
    """
    if rate == target or step <= 0.0:
        return target
    most = step / (QUICKEST if target == 0.0 else GENTLE)
    wanted = rate + min(max(target - rate, -most), most)
    before = path(time)[1] * rate

    def asked(end: float) -> Vector:
        return np.abs(path(time + way(rate, end, step))[1] * end - before) / step

    # Where the trajectory itself is a little over the limit, going on as planned must stay possible.
    allowed = np.maximum(acceleration, asked(rate))
    if np.all(asked(wanted) <= allowed):
        return wanted
    possible, share = 0.0, 0.5
    for halving in range(2, HALVINGS + 2):
        if np.all(asked(rate + share * (wanted - rate)) <= allowed):
            possible = share
            share += 0.5**halving
        else:
            share -= 0.5**halving
    return rate + possible * (wanted - rate)


def way(begin: float, end: float, step: float) -> float:
    """Trajectory's time that passes [s] in a step [s] during which the rate changes evenly."""
    return (begin + end) / 2 * step
