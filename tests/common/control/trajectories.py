"""Trajectories of two joints for tests of controllers."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from common.hardware.interface import Limits
from common.messages import JointTrajectory, JointTrajectoryPoint

LIMITS = Limits(("shoulder", "elbow"), np.full(2, -3.0), np.full(2, 3.0), np.full(2, 2.0), np.full(2, 10.0))


def trajectory(rows: Iterable[Sequence], names: Sequence[str] = LIMITS.names) -> JointTrajectory:
    """Return a trajectory of rows: time [s], positions, velocities and accelerations; those left out are 0."""
    points = []
    for time, *given in rows:
        still = [0.0] * len(given[0])
        q, dq, ddq = (np.asarray(each, dtype=float).tolist() for each in [*given, still, still][:3])
        points.append(JointTrajectoryPoint(time_from_start=float(time), positions=q, velocities=dq, accelerations=ddq))
    return JointTrajectory(joint_names=list(names), points=points)


def rest_to_rest(
    start: Sequence[float], end: Sequence[float], duration: float = 1.0, points: int = 21,
    names: Sequence[str] = LIMITS.names,
) -> JointTrajectory:
    """Return a quintic from rest to rest, sampled at `points` instants."""
    q0, move = np.array(start, dtype=float), np.array(end, dtype=float) - np.array(start, dtype=float)
    rows = ((u * duration, q0 + move * (10 * u**3 - 15 * u**4 + 6 * u**5),
             move * (30 * u**2 - 60 * u**3 + 30 * u**4) / duration,
             move * (60 * u - 180 * u**2 + 120 * u**3) / duration**2) for u in np.linspace(0.0, 1.0, points))
    return trajectory(rows, names)
