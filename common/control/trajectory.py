"""A joint trajectory as a function of time: Hermite interpolation between its points."""

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
