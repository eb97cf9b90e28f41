"""The motion that a chunk continues: what of it is committed, and how the rows of a chunk are blended with it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from applications.policy.interface import MotionState, ProvedMotion
from common.control.joining import splice
from common.control.limiter import SLACK
from common.control.set_points import REWOUND
from common.control.trajectory import Trajectory, with_best_interpolation
from common.hardware.interface import Limits
from common.messages import MotionStatus

Array = NDArray[np.float64]

AT_REST = 1e-6  # [s] of a path: closer to its end, nothing can join it


@dataclass
class FollowedPath:
    """The motion that the executor follows. Its time axis is that of the executor: it passes slower while it is held.

    Attributes:
        id: of the goal.
        path: with the newest part of the motions before it.
        begin: time at which the trajectory of the goal starts [s].
        moving: time until which it follows a chunk; braking follows [s].
        known: a time [s, cell time], the time of the path then [s], and the share of its speed since then.
    """

    id: str
    path: Trajectory
    begin: float
    moving: float
    known: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def observe(self, status: MotionStatus) -> None:
        """Take where the executor is from a status of this goal."""
        rate = 0.0 if status.held else status.speed_scaling
        self.known = status.header.stamp * 1e-9, self.begin + status.path_time, rate

    @property
    def rate(self) -> float:
        """Time of the path that passes per cell time."""
        return self.known[2]

    def time(self, now: float) -> float:
        """Return the time of the path at a cell time [s], also one in the past."""
        stamp, time, rate = self.known
        return min(max(time + (now - stamp) * rate, 0.0), self.path.duration)

    def state(self, time: float) -> MotionState:
        """Return the set-point at a time of the path [s]."""
        times = self.path.times
        index = int(np.clip(np.searchsorted(times, time, side="right") - 1, 0, len(times) - 2))
        h = float(times[index + 1] - times[index])
        u = float(np.clip((time - times[index]) / h, 0.0, 1.0))
        c = self.path.segments[:, index]
        powers = np.arange(6)
        first = powers[1:] * u ** powers[:5]
        second = powers[2:] * powers[1:-1] * u ** powers[:4]
        return MotionState(u**powers @ c, first @ c[1:] / h, second @ c[2:] / h**2)

    def positions(self, times: Array) -> Array:
        """Return positions (n, dof) [rad] at times (n,) of the path [s]."""
        return self.path.positions_at(times)

    def committed(self, stamp: float, rate: float, until: float) -> Array:
        """Return (k, dof) [rad] the targets of rows at a rate [Hz] after a cell time [s], until a time of the path [s].

        These are reached whatever a chunk for an observation of that time says.
        """
        begin = self.time(stamp)
        count = max(int(np.floor((until - begin) * rate + 1e-6)), 0)
        return self.positions(begin + np.arange(1, count + 1) / rate)

    def followed_by(self, goal: str, time: float, motion: Trajectory, moving: float) -> FollowedPath:
        """Return the path with another motion from a time on [s]; `moving` [s] after that time it brakes."""
        joined, dropped = splice(self.path, time, motion, max(self.time(self.known[0]) - REWOUND, 0.0))
        stamp, known, rate = self.known
        return FollowedPath(goal, joined, time - dropped, time - dropped + moving, (stamp, known - dropped, rate))


def trajectory_of(motion: ProvedMotion, limits: Limits) -> Trajectory:
    """Return a proved motion as the executor will follow it."""
    return with_best_interpolation(
        Trajectory(motion.times, motion.positions, motion.velocities, motion.accelerations), limits, 1 + SLACK)


def blended(rows: Array, times: Array, before: FollowedPath, join: float, seconds: float) -> Array:
    """Return rows (n, dof) [rad] that leave the motion before gradually, in a time [s] from the join on.

    They have left it when that motion begins to brake.

    Args:
        rows: of the new chunk, (n, dof) [rad].
        times: of the rows after the join, (n,) [s].
        before: the motion that is followed.
        join: time of its path at which the new chunk takes over [s].
        seconds: in which it takes over completely at most; 0: at once.
    """
    seconds = min(seconds, before.moving - join)
    if seconds <= 0.0:
        return rows
    share = np.clip(times / seconds, 0.0, 1.0)[:, None]
    return np.where(share < 1.0, (1 - share) * before.positions(join + times) + share * rows, rows)
