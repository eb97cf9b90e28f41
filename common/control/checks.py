"""What a real controller refuses: trajectories that no arm can follow, or not from where it is."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from common.config import Parameters, Tunable
from common.control.trajectory import Trajectory, from_message, with_best_interpolation
from common.errors import Refused
from common.hardware.interface import Limits, Vector
from common.messages import JointTrajectory

_SHARES = 256  # of a segment at which positions are looked at that may be beyond a limit
_ROUNDING = 1e-9  # [rad]


class Tolerances(Parameters):
    """How exact a trajectory must be, and how exactly it must be followed."""

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


def checked_trajectory(
    message: JointTrajectory, limits: Limits, measured: Vector, tolerances: Tolerances
) -> Trajectory:
    """The trajectory, ready to be sampled.

    Args:
        message: joints in any order, but exactly those of the robot.
        limits: of the robot.
        measured: where the robot is, (dof,) [rad].
        tolerances: start, rest and slack.

    Raises:
        Refused: with a code and one line that names joint, point, value and limit.
    """
    if len(set(message.joint_names)) != len(message.joint_names) or set(message.joint_names) != set(limits.names):
        given, wanted = ", ".join(message.joint_names), ", ".join(limits.names)
        raise Refused("joint_names", f"trajectory is for joints {given}; this robot has {wanted}")
    _check_points(message)
    trajectory = from_message(message, limits.names)
    _check_numbers(trajectory, limits, tolerances)
    _check_start(trajectory, limits, measured, tolerances)
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
    """Refuse what swings out through a limit between two points, and is back before the second."""
    lower, upper = _inwards(trajectory.positions[:-1], limits, tolerances)
    lowest, highest = trajectory.hull()
    doubtful = (lowest < lower) | (highest > upper)
    if not doubtful.any():
        return
    q = trajectory.positions[:-1].copy()
    for u in np.arange(1, _SHARES) / _SHARES:
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
    for name, end in (("first", 0), ("last", -1)):
        speed = np.abs(trajectory.velocities[end])
        if np.any(speed > tolerances.stopped_velocity):
            j = int(np.argmax(speed))
            raise Refused("not_at_rest", f"{name} point is not at rest: {limits.names[j]} moves at "
                                         f"{trajectory.velocities[end, j]:.4f} rad/s")


def _within(what: str, values: Vector, lower: Vector, upper: Vector, names: tuple[str, ...]) -> None:
    outside = (values < lower) | (values > upper)
    if outside.any():
        point, j = np.argwhere(outside)[0]
        low, high = (float(np.broadcast_to(limit, values.shape)[point, j]) for limit in (lower, upper))
        raise Refused("limit", f"{what} point {point} exceeds the limit of {names[j]}: "
                               f"{values[point, j]:.4f} is not within {low:.4f} to {high:.4f}")


def _inwards(before: Vector, limits: Limits, tolerances: Tolerances) -> tuple[Vector, Vector]:
    """Lowest and highest positions (N, dof) [rad] after those before: a joint beyond its limit gets no farther out."""
    slack = tolerances.position_slack
    return np.minimum(limits.lower - slack, before), np.maximum(limits.upper + slack, before)


def _check_limits(trajectory: Trajectory, limits: Limits, measured: Vector, tolerances: Tolerances) -> None:
    lower, upper = _inwards(np.concatenate([[measured], trajectory.positions[:-1]]), limits, tolerances)
    lower[0] -= tolerances.position_slack  # what is measured has noise
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
    # Rounded numbers of a fine trajectory: a micrometre at arm's length is no contradiction.
    allowed = most * step**2 / 4 * np.maximum(0.0, 1 - share**2) + 1e-6 + tolerances.slack * np.abs(expected)
    for bad, text in ((share > 1 + 1e-6 / (most * step), "velocity changes by {0:.4f} rad/s in {1:.4f} s"),
                      (np.abs(moved - expected) > allowed, "positions move {2:.5f} rad, velocities say {3:.5f} rad")):
        if bad.any():
            point, j = np.argwhere(bad)[0]
            change = trajectory.velocities[point + 1, j] - trajectory.velocities[point, j]
            said = text.format(change, step[point, 0], moved[point, j], expected[point, j])
            raise Refused("contradiction", f"points {point} and {point + 1} contradict each other at "
                                           f"{limits.names[j]}: {said} (acceleration limit {limits.acceleration[j]:g})")
