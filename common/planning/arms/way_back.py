"""Ways back: how an arm that obstructs another one returns to its home pose."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from common.hardware.interface import Limits
from common.planning.trajectory import TimedPath, at_rest, join, sample

Array = NDArray[np.float64]

SPEED = 0.5  # share of the limits of a way back that is not reversed
CLOSE = 0.01  # [rad] an arm this close to a pose is at it
_STEP = 0.05  # [s] between the states of a straight way back
_MOST_SECONDS = 120.0  # of a reversed way back: a longer one is not used


def straight(start: Array, end: Array, limits: Limits, share: float = SPEED) -> TimedPath:
    """Return the straight line in joint space from start to end (dof,) [rad] with limited jerk, from rest to rest."""
    move = np.abs(end - start)
    if move.max() < 1e-9:
        return at_rest(start)
    duration = max(  # peaks of the derivatives of 10 u^3 - 15 u^4 + 6 u^5
        float((1.875 * move / (share * limits.velocity)).max()),
        float(np.sqrt(5.774 * move / (share * limits.acceleration)).max()),
        float(np.cbrt(60 * move / (share * limits.jerks)).max()))
    u = np.linspace(0.0, 1.0, max(10, int(duration / _STEP)) + 1)[:, None]
    way = (end - start)[None]
    return TimedPath(
        u[:, 0] * duration, start + way * u**3 * (10 - 15 * u + 6 * u**2),
        way * 30 * u**2 * (1 - u) ** 2 / duration, way * (60 * u - 180 * u**2 + 120 * u**3) / duration**2)


def reversed_path(path: TimedPath, until: float | None = None) -> TimedPath:
    """Return the path backwards, from its end, or from where it is at a time [s] and at rest there."""
    if until is not None and until < path.duration:
        path = _cut(path, until)
    return TimedPath(
        path.duration - path.times[::-1], path.positions[::-1].copy(), -path.velocities[::-1],
        path.accelerations[::-1].copy())


def _cut(path: TimedPath, until: float) -> TimedPath:
    """Return the path up to a time [s], slower towards its new end so that it comes to rest there."""
    if until <= 2e-3:
        return at_rest(path.positions[0])
    u = np.linspace(0.0, 1.0, max(10, int(until / _STEP)) + 1)
    eased = until * u**2 * (3 - 2 * u)  # of its own time, in twice that time
    duration, step = 2 * until, 1e-4
    q = sample(path, eased)
    dq = (sample(path, eased + step) - sample(path, eased - step)) / (2 * step) * (
        until * 6 * u * (1 - u) / duration)[:, None]
    return TimedPath(u * duration, q, dq, np.zeros_like(q))


def behind(path: TimedPath, before: TimedPath | None) -> TimedPath | None:
    """Return the way back over a path and then over the way back from its start; None if that is unknown."""
    if before is None or np.abs(before.positions[0] - path.positions[0]).max() > CLOSE:
        return None
    back = reversed_path(path)
    if back.duration + before.duration > _MOST_SECONDS:
        return None
    return join([back, TimedPath(before.times, before.positions, before.velocities, before.accelerations)])
