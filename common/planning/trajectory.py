"""Timed paths: states of the joints at increasing times, joined by cubics as the controller follows them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from common.messages import JointTrajectory, JointTrajectoryPoint
from common.messages.robot import MAX_POINTS, MAX_SECONDS
from common.robot.model import RobotModel

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TimedPath:
    """States of the joints at times from the start: times (N,) [s], positions, velocities, accelerations (N, dof)."""

    times: Array
    positions: Array
    velocities: Array
    accelerations: Array

    @property
    def duration(self) -> float:
        """Seconds from the first to the last state."""
        return float(self.times[-1])


class TooLong(Exception):
    """A path whose timing takes more time than there is, or more states than a trajectory may have."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code


def require_sendable(trajectory: TimedPath) -> None:
    """Return if a trajectory fits into a message.

    Raises:
        TooLong: too_long: it has too many states, or takes longer than any motion does.
    """
    if (states := len(trajectory.times)) > MAX_POINTS or trajectory.duration > MAX_SECONDS:
        size = f"the trajectory has {states} states and takes {trajectory.duration:.3g} s"
        raise TooLong("too_long", f"{size}; the limits are {MAX_POINTS} states and {MAX_SECONDS:g} s")


def at_rest(q: Array) -> TimedPath:
    """Return a trajectory of 10 ms that stays at q (dof,) [rad]."""
    still = np.zeros((2, len(q)))
    return TimedPath(np.array([0.0, 0.01]), np.array([q, q]), still, still)


def timed_path(trajectory: JointTrajectory) -> TimedPath:
    """Return the arrays of a trajectory message."""
    points = trajectory.points
    dof = len(trajectory.joint_names)
    return TimedPath(
        np.array([p.time_from_start for p in points]),
        np.array([p.positions for p in points]).reshape(-1, dof),
        np.array([p.velocities for p in points]).reshape(-1, dof),
        np.array([p.accelerations for p in points]).reshape(-1, dof),
    )


def trajectory_message(robot: RobotModel, trajectory: TimedPath) -> JointTrajectory:
    """Return the message of a validated trajectory."""
    # Validation found these numbers finite and in shape: pydantic would take milliseconds to check each again.
    columns = (
        trajectory.times.tolist(),
        trajectory.positions.tolist(),
        trajectory.velocities.tolist(),
        trajectory.accelerations.tolist(),
    )
    points = [
        JointTrajectoryPoint.model_construct(time_from_start=t, positions=q, velocities=dq, accelerations=ddq)
        for t, q, dq, ddq in zip(*columns, strict=True)
    ]
    return JointTrajectory.model_construct(joint_names=list(robot.joint_names), points=points)


def end_accelerations(trajectory: TimedPath) -> tuple[Array, Array]:
    """Return (N - 1, dof) accelerations at the beginning and the end of the cubics between the states."""
    h = np.diff(trajectory.times)[:, None]
    ahead = np.diff(trajectory.positions, axis=0) / h
    v0, v1 = trajectory.velocities[:-1], trajectory.velocities[1:]
    return (6 * ahead - 4 * v0 - 2 * v1) / h, (-6 * ahead + 2 * v0 + 4 * v1) / h


def stretch(trajectory: TimedPath, scale: float) -> TimedPath:
    """Return the same motion slower: times t / s, velocities v s, accelerations a s^2.

    Raises:
        ValueError: the scale is not within 0 to 1.
    """
    if not (0 < scale <= 1 and math.isfinite(scale)):
        raise ValueError(f"scale {scale:g} is not within 0 to 1")
    return TimedPath(
        trajectory.times / scale,
        trajectory.positions,
        trajectory.velocities * scale,
        trajectory.accelerations * scale**2,
    )


def join(parts: Sequence[TimedPath]) -> TimedPath:
    """Return trajectories one after the other; each starts at rest where the one before came to rest."""
    times, last = [parts[0].times], parts[0].duration
    for part in parts[1:]:
        times.append(part.times[1:] + last)
        last += part.duration
    rest = parts[1:]
    return TimedPath(
        np.concatenate(times),
        np.concatenate([parts[0].positions, *(part.positions[1:] for part in rest)]),
        np.concatenate([parts[0].velocities, *(part.velocities[1:] for part in rest)]),
        np.concatenate([parts[0].accelerations, *(part.accelerations[1:] for part in rest)]),
    )


def sample(trajectory: TimedPath, times: ArrayLike) -> Array:
    """Return (N, dof) positions at times [s]: cubic Hermite interpolation between states, as in the controller."""
    t = np.clip(np.asarray(times, dtype=float), 0.0, trajectory.duration)
    i = np.clip(np.searchsorted(trajectory.times, t, side="right") - 1, 0, len(trajectory.times) - 2)
    span = (trajectory.times[i + 1] - trajectory.times[i])[:, None]
    r = (t - trajectory.times[i])[:, None] / span
    q0, q1 = trajectory.positions[i], trajectory.positions[i + 1]
    v0, v1 = trajectory.velocities[i] * span, trajectory.velocities[i + 1] * span
    return np.array(
        q0 + r * v0 + r**2 * (3 * (q1 - q0) - 2 * v0 - v1) + r**3 * (2 * (q0 - q1) + v0 + v1)
    )


def cubics(trajectory: TimedPath) -> Array:
    """Return (N - 1, 4, dof) coefficients c0 + c1 r + c2 r^2 + c3 r^3 between states, r from 0 to 1, as in `sample`."""
    span = np.diff(trajectory.times)[:, None]
    q0, q1 = trajectory.positions[:-1], trajectory.positions[1:]
    v0, v1 = trajectory.velocities[:-1] * span, trajectory.velocities[1:] * span
    return np.stack([q0, v0, 3 * (q1 - q0) - 2 * v0 - v1, 2 * (q0 - q1) + v0 + v1], axis=1)


def moving_samples(trajectory: TimedPath, step: float) -> tuple[Array, Array]:
    """Return (N, dof) positions [rad] and velocities [rad/s] along a trajectory, about `step` [rad] apart."""
    pieces = cubics(trajectory)
    spans = np.diff(trajectory.times)
    counts = np.maximum(2, np.ceil(np.abs(pieces[:, 1:]).sum(axis=1).max(axis=1) / step).astype(int))
    owners = np.repeat(np.arange(len(counts)), counts)
    r = ((np.arange(len(owners)) - np.repeat(np.cumsum(counts) - counts, counts)) / counts[owners])[:, None]
    c0, c1, c2, c3 = pieces[owners].transpose(1, 0, 2)
    return c0 + r * (c1 + r * (c2 + r * c3)), (c1 + r * (2 * c2 + 3 * r * c3)) / spans[owners, None]
