"""Joint trajectories as functions of time (Hermite interpolation), and the checks that a real controller makes.

Refused are trajectories that no arm can follow, or that do not start where this arm is.
"""


from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from common.config import Parameters, Tunable
from common.errors import Refused
from common.hardware.interface import Limits, Vector
from common.messages import JointTrajectory, JointTrajectoryPoint

CHUNK = 1000  # points that are converted at once, while the control cycle waits
_BEZIER = np.array([[math.comb(i, k) / math.comb(5, k) for k in range(6)] for i in range(6)])  # of powers, degree 5
ACCELERATION_MISMATCH = 0.3  # share of the velocity changes that the accelerations may leave unexplained
_SAMPLES = 256  # positions of a segment that are checked if it may leave a limit
_ROUNDING = 1e-9  # [rad]
JOIN_POSITION, JOIN_VELOCITY = 1e-5, 1e-3  # [rad], [rad/s] between a motion and what joins it: one cycle evens it out


class Tolerances(Parameters):
    """Required accuracy of a trajectory, and of the arm that follows it."""

    start: Tunable[float] = Field(0.01, gt=0, le=1, description="first point to measured position, each joint [rad]")
    path: Tunable[float] = Field(0.1, gt=0, le=1, description="measured to commanded position while moving [rad]")
    goal: Tunable[float] = Field(0.002, gt=0, le=1, description="measured to last position for success [rad]")
    stopped_velocity: Tunable[float] = Field(0.01, gt=0, le=1, description="slower than this is at rest [rad/s]")
    goal_time: Tunable[float] = Field(1.0, gt=0, le=60, description="cell time to settle after the last point [s]")
    slack: Tunable[float] = Field(
        0.02, ge=0, le=0.5, description="share by which speed and acceleration limits may be exceeded"
    )
    position_slack: Tunable[float] = Field(
        1e-3, ge=0, le=0.1, description="position limits may be exceeded by this [rad]"
    )


@dataclass(frozen=True)
class Trajectory:
    """Points of a trajectory: `times` (N,) [s] from 0, positions, velocities and accelerations (N, dof).

    Between the points it is the quintic through all of them, or the cubic through positions and velocities: see
    `with_best_interpolation`.
    """

    times: Vector
    positions: Vector
    velocities: Vector
    accelerations: Vector
    quintic: bool = False
    given: Vector | None = None  # coefficients of its segments, if it was joined from other trajectories

    @cached_property
    def duration(self) -> float:
        """Time of the last point [s]."""
        return float(self.times[-1])

    def at(self, time: float) -> tuple[Vector, Vector]:
        """Return positions and velocities (dof,) at a time [s]; at rest at the ends outside the trajectory."""
        if time <= 0.0 or time >= self.duration:
            end = 0 if time <= 0.0 else -1
            return self.positions[end], 0.0 * self.positions[end]
        index = int(np.searchsorted(self.times, time, side="right")) - 1
        begin, end = self.times[index], self.times[index + 1]
        return _interpolated((time - begin) / (end - begin), end - begin, self.segments[:, index])

    def positions_at(self, times: Vector) -> Vector:
        """Return positions (N, dof) at times (N,) [s]; those of the ends outside the trajectory."""
        index = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, len(self.times) - 2)
        begin, end = self.times[index], self.times[index + 1]
        u = np.clip((times - begin) / (end - begin), 0.0, 1.0)[:, None]
        return _interpolated(u, (end - begin)[:, None], self.segments[:, index])[0]

    def between(self, fraction: float) -> tuple[Vector, Vector, Vector]:
        """Return positions, velocities and accelerations (N - 1, dof) at a fraction, 0 to 1, of every segment."""
        h, (_, _, a0, c3, c4, c5) = np.diff(self.times)[:, None], self.segments
        u = fraction
        ddq = (2 * a0 + u * (6 * c3 + u * (12 * c4 + u * 20 * c5))) / h**2
        return *_interpolated(u, h, self.segments), ddq

    def hull(self) -> tuple[Vector, Vector]:
        """Return bounds (N - 1, dof) of each segment's positions: those of its Bezier points."""
        points = np.tensordot(_BEZIER, self.segments, axes=1)
        return points.min(axis=0), points.max(axis=0)

    def at_share(self, u: float, chosen: NDArray[np.bool_]) -> Vector:
        """Return positions (M,) at a share u, 0 to 1, of the M chosen among segments and joints (N - 1, dof)."""
        return _interpolated(u, 1.0, self.segments[:, chosen])[0]

    @cached_property
    def segments(self) -> Vector:
        """Coefficients (6, N - 1, dof) [rad] of the segments' polynomials, lowest first."""
        if self.given is not None:
            return self.given
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
    """Return positions and velocities at a share u of segments of these durations [s]."""
    q0, v0, a0, c3, c4, c5 = coefficients
    q = q0 + u * (v0 + u * (a0 + u * (c3 + u * (c4 + u * c5))))
    dq = (v0 + u * (2 * a0 + u * (3 * c3 + u * (4 * c4 + u * 5 * c5)))) / duration
    return q, dq


def from_message(message: JointTrajectory, names: tuple[str, ...]) -> Trajectory:
    """Return the message's points, with its joints in the order of `names`."""
    order = [message.joint_names.index(name) for name in names]
    chunks = [message.points[first : first + CHUNK] for first in range(0, len(message.points), CHUNK)]

    def concatenated(values: Callable[[JointTrajectoryPoint], float | list[float]]) -> Vector:
        return np.concatenate([np.array([values(point) for point in chunk], dtype=float) for chunk in chunks])

    return Trajectory(
        concatenated(lambda point: point.time_from_start),
        concatenated(lambda point: point.positions)[:, order],
        concatenated(lambda point: point.velocities)[:, order],
        concatenated(lambda point: point.accelerations)[:, order],
    )


def to_message(trajectory: Trajectory, names: tuple[str, ...]) -> JointTrajectory:
    """Return the points of a trajectory, whose joints have these names."""
    columns = (trajectory.times, trajectory.positions, trajectory.velocities, trajectory.accelerations)
    return JointTrajectory.model_construct(joint_names=list(names), points=[
        JointTrajectoryPoint.model_construct(time_from_start=t, positions=q, velocities=dq, accelerations=ddq)
        for t, q, dq, ddq in zip(*(column.tolist() for column in columns), strict=True)])


def with_best_interpolation(trajectory: Trajectory, limits: Limits, slack: float) -> Trajectory:
    """Return the trajectory with quintic segments if its accelerations explain its velocities, else with cubic ones.

    With accelerations that are all zero, or of another retiming, a quintic would oscillate between the points.
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


# --- checks ---


def checked_trajectory(
    message: JointTrajectory, limits: Limits, measured: Vector, tolerances: Tolerances, velocity: Vector | None = None
) -> Trajectory:
    """Return the trajectory, ready to be sampled.

    Args:
        message: joints in any order, but exactly those of the robot.
        limits: of the robot.
        measured: where the robot is, or will be when it joins a motion, (dof,) [rad].
        tolerances: start, rest and slack.
        velocity: of the motion that it joins, (dof,) [rad/s]; None: it starts at rest.

    Raises:
        Refused: with a code and one line that names joint, point, value and limit.
    """
    if len(set(message.joint_names)) != len(message.joint_names) or set(message.joint_names) != set(limits.names):
        names, expected = ", ".join(message.joint_names), ", ".join(limits.names)
        raise Refused("joint_names", f"trajectory is for joints {names}; this robot has {expected}")
    _check_points(message)
    trajectory = from_message(message, limits.names)
    _check_numbers(trajectory, limits, tolerances)
    if velocity is None:
        _check_start(trajectory, limits, measured, tolerances)
    else:
        _check_join(trajectory, limits, measured, velocity)
    _check_end(trajectory, limits, tolerances)
    _check_limits(trajectory, limits, measured, tolerances)
    _check_consistency(trajectory, limits, tolerances)
    best = with_best_interpolation(trajectory, limits, 1 + tolerances.slack)
    for fraction in (0.25, 0.5, 0.75):
        _, dq, _ = best.between(fraction)
        fastest = limits.velocity * (1 + tolerances.slack)
        _within("velocity after", dq, -fastest, fastest, limits.names)
    _check_positions_between(best, limits, tolerances)
    return best


def _check_positions_between(trajectory: Trajectory, limits: Limits, tolerances: Tolerances) -> None:
    """Refuse a segment that leaves a limit between its two points."""
    lower, upper = _allowed_positions(trajectory.positions[:-1], limits, tolerances)
    lowest, highest = trajectory.hull()
    doubtful = (lowest < lower) | (highest > upper)
    if not doubtful.any():
        return
    q = trajectory.positions[:-1].copy()
    for u in np.arange(1, _SAMPLES) / _SAMPLES:
        q[doubtful] = trajectory.at_share(float(u), doubtful)
        _within("position after", q, lower - _ROUNDING, upper + _ROUNDING, limits.names)


def _check_points(message: JointTrajectory) -> None:
    dof, points = len(message.joint_names), message.points
    if len(points) < 2:
        raise Refused("too_few_points", f"trajectory has {len(points)} points; at least 2 are needed")
    for index, point in enumerate(points):
        for field in ("positions", "velocities", "accelerations"):
            if len(getattr(point, field)) != dof:
                count = len(getattr(point, field))
                raise Refused("joint_names", f"point {index} has {count} {field} for {dof} joints")


def _check_numbers(trajectory: Trajectory, limits: Limits, tolerances: Tolerances) -> None:
    times = trajectory.times
    if not np.all(np.isfinite(times)):
        raise Refused("not_finite", f"time of point {int(np.argmin(np.isfinite(times)))} is not finite")
    for field in ("positions", "velocities", "accelerations"):
        finite = np.isfinite(getattr(trajectory, field))
        if not finite.all():
            point, joint = np.argwhere(~finite)[0]
            raise Refused("not_finite", f"{field} of point {point}, joint {limits.names[joint]}, are not finite")
    if times[0] != 0.0:
        raise Refused("bad_times", f"first point is at {times[0]:g} s, not at 0")
    late = np.diff(times) <= 0
    if late.any():
        point = int(np.argmax(late)) + 1
        raise Refused("bad_times", f"times do not increase: point {point} at {times[point]:g} s is not after "
                                   f"point {point - 1} at {times[point - 1]:g} s")


def _check_start(trajectory: Trajectory, limits: Limits, measured: Vector, tolerances: Tolerances) -> None:
    off = np.abs(trajectory.positions[0] - measured)
    if np.any(off > tolerances.start):
        j = int(np.argmax(off))
        raise Refused("start_mismatch", f"trajectory starts with {limits.names[j]} at {trajectory.positions[0, j]:.4f} "
                                        f"rad, but it is at {measured[j]:.4f} rad (tolerance {tolerances.start:g})")
    _check_end(trajectory, limits, tolerances, "first", 0)


def _check_end(
    trajectory: Trajectory, limits: Limits, tolerances: Tolerances, name: str = "last", index: int = -1
) -> None:
    speed = np.abs(trajectory.velocities[index])
    if np.any(speed > tolerances.stopped_velocity):
        j = int(np.argmax(speed))
        raise Refused("not_at_rest", f"{name} point is not at rest: {limits.names[j]} moves at "
                                     f"{trajectory.velocities[index, j]:.4f} rad/s")


def _check_join(trajectory: Trajectory, limits: Limits, position: Vector, velocity: Vector) -> None:
    for what, first, there, unit, tolerance in (
        ("", trajectory.positions[0], position, "rad", JOIN_POSITION),
        ("the speed of ", trajectory.velocities[0], velocity, "rad/s", JOIN_VELOCITY),
    ):
        off = np.abs(first - there)
        if np.any(off > tolerance):
            j = int(np.argmax(off))
            raise Refused("discontinuous", f"trajectory starts with {what}{limits.names[j]} at {first[j]:.6f} {unit}, "
                                           f"but the motion that it joins is at {there[j]:.6f} {unit} there "
                                           f"(tolerance {tolerance:g})")


def _within(what: str, values: Vector, lower: Vector, upper: Vector, names: tuple[str, ...]) -> None:
    outside = (values < lower) | (values > upper)
    if outside.any():
        point, j = np.argwhere(outside)[0]
        low, high = (float(np.broadcast_to(limit, values.shape)[point, j]) for limit in (lower, upper))
        raise Refused("limit", f"{what} point {point} exceeds the limit of {names[j]}: "
                               f"{values[point, j]:.4f} is not within {low:.4f} to {high:.4f}")


def _allowed_positions(before: Vector, limits: Limits, tolerances: Tolerances) -> tuple[Vector, Vector]:
    """Return lowest and highest positions (N, dof) [rad] after those before: a joint beyond a limit stays there."""
    slack = tolerances.position_slack
    return np.minimum(limits.lower - slack, before), np.maximum(limits.upper + slack, before)


def _check_limits(trajectory: Trajectory, limits: Limits, measured: Vector, tolerances: Tolerances) -> None:
    lower, upper = _allowed_positions(np.concatenate([[measured], trajectory.positions[:-1]]), limits, tolerances)
    lower[0] -= tolerances.position_slack  # measurements are noisy
    upper[0] += tolerances.position_slack
    _within("position of", trajectory.positions, lower, upper, limits.names)
    for what, values, most in (
        ("velocity of", trajectory.velocities, limits.velocity),
        ("acceleration of", trajectory.accelerations, limits.acceleration),
    ):
        allowed = most * (1 + tolerances.slack)
        _within(what, values, -allowed, allowed, limits.names)


def _check_consistency(trajectory: Trajectory, limits: Limits, tolerances: Tolerances) -> None:
    """Refuse points that no motion within the acceleration limits connects.

    With speeds v0, v1 at the ends of a step h and |a| <= A, the velocity lies within the parallelogram between
    "brake first" and "speed up first", so that the distance differs from h (v0 + v1) / 2 by at most
    A h^2 / 4 (1 - b^2), b = |v1 - v0| / (A h).
    """
    step = np.diff(trajectory.times)[:, None]
    most = limits.acceleration * (1 + tolerances.slack)
    share = np.abs(np.diff(trajectory.velocities, axis=0)) / (most * step)
    moved = np.diff(trajectory.positions, axis=0)
    expected = step * (trajectory.velocities[1:] + trajectory.velocities[:-1]) / 2
    # Numbers of a fine trajectory are rounded: a micrometre at arm's length is no contradiction.
    allowed = most * step**2 / 4 * np.maximum(0.0, 1 - share**2) + 1e-6 + tolerances.slack * np.abs(expected)
    for bad, text in ((share > 1 + 1e-6 / (most * step), "velocity changes by {0:.4f} rad/s in {1:.4f} s"),
                      (np.abs(moved - expected) > allowed, "positions move {2:.5f} rad, velocities say {3:.5f} rad")):
        if bad.any():
            point, j = np.argwhere(bad)[0]
            change = trajectory.velocities[point + 1, j] - trajectory.velocities[point, j]
            difference = text.format(change, step[point, 0], moved[point, j], expected[point, j])
            name, most_here = limits.names[j], limits.acceleration[j]
            raise Refused("contradiction", f"points {point} and {point + 1} contradict each other at {name}: "
                                           f"{difference} (acceleration limit {most_here:g})")
