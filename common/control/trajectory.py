"""A joint trajectory as a function of time, and how fast that time passes: Hermite interpolation between its points."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from common.hardware.interface import Limits, Vector
from common.messages import JointTrajectory, JointTrajectoryPoint

PIECE = 1000  # points that are made an array of at once: all else waits meanwhile
_BEZIER = np.array([[math.comb(i, k) / math.comb(5, k) for k in range(6)] for i in range(6)])  # of powers, degree 5
ACCELERATION_MISMATCH = 0.3  # share of the velocity changes that the given accelerations may leave unexplained


@dataclass(frozen=True)
class Trajectory:
    """Points of a trajectory: `times` (N,) [s] from 0, positions, velocities and accelerations (N, dof).

    Between the points it is the quintic that meets all of them, or the cubic that meets positions and velocities:
    the choice is made by `interpolation_order`.
    """

    times: Vector
    positions: Vector
    velocities: Vector
    accelerations: Vector
    quintic: bool = False

    @cached_property
    def duration(self) -> float:
        """Time of the last point [s]."""
        return float(self.times[-1])

    def at(self, time: float) -> tuple[Vector, Vector]:
        """Positions and velocities (dof,) at a time [s]; at rest at the ends outside of it."""
        if time <= 0.0 or time >= self.duration:
            end = 0 if time <= 0.0 else -1
            return self.positions[end], 0.0 * self.positions[end]
        index = int(np.searchsorted(self.times, time, side="right")) - 1
        begin, end = self.times[index], self.times[index + 1]
        return _interpolated((time - begin) / (end - begin), end - begin, self._segments[:, index])

    def positions_at(self, times: Vector) -> Vector:
        """Positions (N, dof) at times (N,) [s]; those of the ends outside of it."""
        index = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, len(self.times) - 2)
        begin, end = self.times[index], self.times[index + 1]
        u = np.clip((times - begin) / (end - begin), 0.0, 1.0)[:, None]
        return _interpolated(u, (end - begin)[:, None], self._segments[:, index])[0]

    def between(self, fraction: float) -> tuple[Vector, Vector, Vector]:
        """Positions, velocities and accelerations (N - 1, dof) at a fraction, 0 to 1, of every segment."""
        h, (_, _, a0, c3, c4, c5) = np.diff(self.times)[:, None], self._segments
        u = fraction
        ddq = (2 * a0 + u * (6 * c3 + u * (12 * c4 + u * 20 * c5))) / h**2
        return *_interpolated(u, h, self._segments), ddq

    def hull(self) -> tuple[Vector, Vector]:
        """Bounds (N - 1, dof) that each segment's positions keep to: those of its Bezier points."""
        points = np.tensordot(_BEZIER, self._segments, axes=1)
        return points.min(axis=0), points.max(axis=0)

    def at_share(self, u: float, chosen: NDArray[np.bool_]) -> Vector:
        """Positions (M,) at a share u, 0 to 1, of the M chosen among segments and joints (N - 1, dof)."""
        return _interpolated(u, 1.0, self._segments[:, chosen])[0]

    @cached_property
    def _segments(self) -> Vector:
        """Coefficients (6, N - 1, dof) [rad] of the polynomials of the segments, from the lowest up."""
        h = (self.times[1:] - self.times[:-1])[:, None]
        q0, move = self.positions[:-1], self.positions[1:] - self.positions[:-1]
        v0, v1 = self.velocities[:-1] * h, self.velocities[1:] * h
        if self.quintic:
            a0, a1 = self.accelerations[:-1] * h**2 / 2, self.accelerations[1:] * h**2 / 2
            rest, slope, bend = move - v0 - a0, v1 - v0 - 2 * a0, 2 * a1 - 2 * a0
            c3 = 10 * rest - 4 * slope + bend / 2
            c4 = -15 * rest + 7 * slope - bend
            c5 = 6 * rest - 3 * slope + bend / 2
        else:
            a0, c3 = 3 * move - 2 * v0 - v1, v0 + v1 - 2 * move
            c4 = c5 = np.zeros_like(move)
        return np.stack([q0, v0, a0, c3, c4, c5])


def _interpolated(u: float | Vector, duration: float | Vector, coefficients: Vector) -> tuple[Vector, Vector]:
    """Positions and velocities at a share u of segments of these durations [s]."""
    q0, v0, a0, c3, c4, c5 = coefficients
    q = q0 + u * (v0 + u * (a0 + u * (c3 + u * (c4 + u * c5))))
    dq = (v0 + u * (2 * a0 + u * (3 * c3 + u * (4 * c4 + u * 5 * c5)))) / duration
    return q, dq


def from_message(message: JointTrajectory, names: tuple[str, ...]) -> Trajectory:
    """The message's points with its joints, which must be the named ones, brought into their order."""
    order = [message.joint_names.index(name) for name in names]
    pieces = [message.points[first : first + PIECE] for first in range(0, len(message.points), PIECE)]

    def together(values: Callable[[JointTrajectoryPoint], float | list[float]]) -> Vector:
        return np.concatenate([np.array([values(point) for point in piece], dtype=float) for piece in pieces])

    return Trajectory(
        together(lambda point: point.time_from_start),
        together(lambda point: point.positions)[:, order],
        together(lambda point: point.velocities)[:, order],
        together(lambda point: point.accelerations)[:, order],
    )


def with_best_interpolation(trajectory: Trajectory, limits: Limits, slack: float) -> Trajectory:
    """The trajectory with quintic segments when its accelerations explain its velocities, else with cubic ones.

    Accelerations that are all zero, or of another retiming, would make a quintic swing between the points.
    """
    step = np.diff(trajectory.times)[:, None]
    change = np.diff(trajectory.velocities, axis=0)
    explained = step * (trajectory.accelerations[1:] + trajectory.accelerations[:-1]) / 2
    if np.abs(change - explained).sum() > ACCELERATION_MISMATCH * np.abs(change).sum():
        return trajectory
    quintic = Trajectory(
        trajectory.times, trajectory.positions, trajectory.velocities, trajectory.accelerations, quintic=True
    )
    for fraction in (0.25, 0.5, 0.75):
        _, dq, ddq = quintic.between(fraction)
        if np.any(np.abs(dq) > limits.velocity * slack) or np.any(np.abs(ddq) > limits.acceleration * slack):
            return trajectory
    return quintic


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
        acceleration: mean of the joints (dof,) in that step [rad/s^2].
    """

    rate: float
    acceleration: Vector
    slope: float = 0.0

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
        rate = next_rate(path, time, self, target, step, acceleration, jerk)
        after = time + way(self.rate, rate, step)
        self.acceleration = (path(after)[1] * rate - path(time)[1] * self.rate) / step
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
    wanted = math.copysign(min(eased, 1 / (QUICKEST if target == 0.0 else GENTLE)), target - rate)
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
