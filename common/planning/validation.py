"""The last check of a trajectory before it is sent: what a real controller would refuse, and collisions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from common.planning.collision import CollisionWorld, Pair
from common.planning.trajectory import TimedPath, cubics, end_accelerations, sample
from common.robot.model import RobotModel

Array = NDArray[np.float64]

TOLERANCE = 0.02  # of velocity and acceleration limits
_CLOSE = 1e-4  # [rad]


@dataclass(frozen=True)
class Fault:
    """Why a trajectory may not be executed: code for programs, message for people."""

    code: str
    message: str
    waypoint: int | None = None
    colliding: Pair | None = None


def validate(
    trajectory: TimedPath,
    robot: RobotModel,
    world: CollisionWorld,
    *,
    start: ArrayLike,
    velocity: ArrayLike,
    acceleration: ArrayLike,
    step: float,
) -> Fault | None:
    """Return the first fault of a trajectory, or None. The kernel proves all of it free where it can.

    Args:
        trajectory: states (N, dof).
        robot: the model, for position limits and names.
        world: obstacles; its rule for contact at the start applies here as well.
        start: (dof,) [rad] where the robot is.
        velocity, acceleration: limits (dof,) [rad/s], [rad/s^2].
        step: largest joint step [rad] between states that are checked for collision where the kernel proves nothing.
    """
    fault = check_numbers(trajectory, robot, start=start, velocity=velocity, acceleration=acceleration)
    if fault is not None:
        return fault
    proved, hit = world.check_cubics(cubics(trajectory))
    if proved:
        return None
    if hit is not None:
        waypoint = hit.index
    else:
        path, owners = fine_samples(trajectory, step)
        hit = world.first_collision(path)
        if hit is None:
            return None
        waypoint = int(owners[hit.index])
    message = f"waypoint {waypoint} of {len(trajectory.times)}: {hit.pair[0]} collides with {hit.pair[1]}"
    return Fault("collision", message, waypoint, hit.pair)


def fine_samples(trajectory: TimedPath, step: float) -> tuple[Array, NDArray[np.int64]]:
    """Return (N, dof) positions along a trajectory at most `step` [rad] apart, and the interval of each."""
    spans = np.diff(trajectory.times)
    speeds = np.abs(trajectory.velocities).max(axis=1)
    moves = np.maximum(
        np.abs(np.diff(trajectory.positions, axis=0)).max(axis=1), np.maximum(speeds[:-1], speeds[1:]) * spans
    )
    counts = np.maximum(1, np.ceil(moves / step).astype(int))
    owners = np.repeat(np.arange(len(counts)), counts)
    number = np.arange(len(owners)) - np.repeat(np.cumsum(counts) - counts, counts)
    times = trajectory.times[owners] + number * (spans / counts)[owners]
    path = np.concatenate([sample(trajectory, times), trajectory.positions[-1:]])
    return path, np.append(owners, len(counts))


def _outwards(q: Array, lower: Array, upper: Array) -> Array:
    """Return (N, dof) [rad] how far positions exceed a limit and the position before; 0 or less for none."""
    before = np.concatenate([q[:1], q[:-1]])
    excess: Array = np.maximum(np.minimum(lower - 1e-6, before) - q, q - np.maximum(upper + 1e-6, before))
    return excess


def check_numbers(
    trajectory: TimedPath, robot: RobotModel, *, start: ArrayLike, velocity: ArrayLike, acceleration: ArrayLike
) -> Fault | None:
    """Return the first fault of a trajectory's numbers: finite, times, start, rest, limits, consistency; or None."""
    times, q, dq, ddq = trajectory.times, trajectory.positions, trajectory.velocities, trajectory.accelerations
    limit_v, limit_a = np.asarray(velocity, dtype=float), np.asarray(acceleration, dtype=float)
    if len(times) < 2 or not (len(times) == len(q) == len(dq) == len(ddq)) or q.shape[1] != robot.dof:
        return Fault("bad_trajectory", f"has {len(times)} points of {q.shape[1]} joints")
    if not all(np.isfinite(values).all() for values in (times, q, dq, ddq)):
        return Fault("not_finite", "holds a number that is not finite")
    spans = np.diff(times)
    if times[0] != 0 or (spans <= 0).any():
        return Fault("bad_times", f"times do not increase strictly from 0 at waypoint {int(np.argmin(spans)) + 1}")
    away = np.abs(q[0] - np.asarray(start, dtype=float))
    if (away > _CLOSE).any():
        joint = int(np.argmax(away))
        return Fault("start_mismatch", f"starts {away[joint]:.4f} rad away from {robot.joint_names[joint]}'s start", 0)
    if max(np.abs(dq[0]).max(), np.abs(dq[-1]).max()) > 1e-6:
        return Fault("not_at_rest", "does not start and end at rest")
    h = spans[:, None]
    ahead = np.diff(q, axis=0) / h
    peak = 1.5 * ahead - 0.25 * (dq[:-1] + dq[1:])  # velocity in the middle of the cubic
    begin, finish = end_accelerations(trajectory)
    checks: list[tuple[str, Array, Callable[[int], str]]] = [
        ("position_limit", _outwards(q, robot.lower, robot.upper), lambda j: "its position limit"),
        ("velocity_limit", np.abs(dq) - (1 + TOLERANCE) * limit_v, lambda j: f"{limit_v[j]:.3f} rad/s"),
        ("velocity_limit", np.abs(peak) - (1 + TOLERANCE) * limit_v, lambda j: f"{limit_v[j]:.3f} rad/s"),
        ("acceleration_limit", np.abs(ddq) - (1 + TOLERANCE) * limit_a, lambda j: f"{limit_a[j]:.3f} rad/s^2"),
        ("inconsistent", np.abs(begin) - (1 + TOLERANCE) * limit_a - 1e-6 / h, lambda j: "the limit between states"),
        ("inconsistent", np.abs(finish) - (1 + TOLERANCE) * limit_a - 1e-6 / h, lambda j: "the limit between states"),
    ]
    for code, excess, limit in checks:
        if (excess > 0).any():
            waypoint, joint = divmod(int(np.argmax(excess)), robot.dof)
            message = f"waypoint {waypoint} of {len(times)}: {robot.joint_names[joint]} exceeds {limit(joint)}"
            return Fault(code, message, waypoint)
    return None
