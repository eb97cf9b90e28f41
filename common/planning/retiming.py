"""The fastest timing of a path within velocity and acceleration limits, from rest to rest, and limited jerk.

Reachability analysis along the path after Pham & Pham, "A New Approach to Time-Optimal Path Parameterization
Based on Reachability Analysis" (IEEE T-RO 2018): a backward pass finds the highest speed at each grid point from
which the end can still be reached, a forward pass goes as fast as that allows. The path's pieces are parabolas and
the grid ends where they end, so joint accelerations are linear between grid points, and limits that hold at both ends
of an interval hold all along it. Between grid points x = (ds/dt)^2 is linear and u = d2s/dt2 constant.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from common.messages.robot import MAX_POINTS
from common.planning.kernel.solvers import fastest_speeds
from common.planning.path import SmoothPath
from common.planning.trajectory import TimedPath, TooLong, cubics, end_accelerations, join
from common.time_source import monotonic

Array = NDArray[np.float64]

_TINY = 1e-12
_REFINEMENTS = 5
_OVERSHOOT = 1.01  # of the acceleration limits, by the cubics between the states
_MIN_INTERVALS = 20  # also on a short path: speed changes at grid points only
_SHARP = 0.02  # of the largest jump of acceleration: a larger jump gets states where it begins and ends
_SLOPE_CHANGE = 0.2  # of the jerk limit: the same where the acceleration's slope changes by more
_SHORTEST = 1e-5  # averaging time by duration: over less, rounding of the integrals exceeds low limits
_MIN_GAP = 0.005  # of the averaging time, between two states
_JERK_MARGIN = 0.02  # share by which a jerk limit may be exceeded
_ROUNDING = 1e-3  # of the largest jump of acceleration: a smaller one is rounding


class RetimingFailed(Exception):
    """A path that cannot be followed within the limits, which only a broken path or limit causes."""


def parametrise(
    path: SmoothPath,
    velocity: ArrayLike,
    acceleration: ArrayLike,
    step: float = 0.02,
    speed: float | Callable[[SmoothPath], Array] = math.inf,
    braking: ArrayLike | None = None,
    deadline: float = math.inf,
) -> TimedPath:
    """Return the time-optimal trajectory along a path, at rest at both ends.

    Args:
        path: pieces (P, dof).
        velocity, acceleration: limits (dof,) [rad/s], [rad/s^2].
        step: largest joint movement between grid points [rad].
        speed: highest ds/dt: that of the tool [m/s] along a path measured by the tool's travel; or a function of the
            path that returns it (P + 1,) where its pieces meet.
        braking: limits (dof,) that replace `acceleration` where speed along the path is lost.
        deadline: on the monotonic clock [s], after which no finer grid is tried.

    Raises:
        RetimingFailed: no speed is feasible somewhere.
        TooLong: too_long, timeout.
    """
    limit_v, limit_a = np.asarray(velocity, dtype=float), np.asarray(acceleration, dtype=float)
    limit_b = limit_a if braking is None else np.asarray(braking, dtype=float)
    move = float((np.maximum(np.abs(path.d0), np.abs(path.d1)).max(axis=1) * path.lengths).sum())
    if not 0 < move < math.inf:
        raise RetimingFailed(f"the path moves the joints by {move:g} rad")
    step = min(step, move / _MIN_INTERVALS)
    for _ in range(_REFINEMENTS):
        if monotonic() > deadline:
            raise TooLong("timeout", "planning ended while the path was timed")
        if (states := len(path.lengths) + move / step) > MAX_POINTS:
            raise TooLong("too_long", f"the path takes {states:.3g} states; a trajectory has {MAX_POINTS} at most")
        trajectory = _timed(path.divided(step), limit_v, limit_a, limit_b, speed)
        if _overshoot(trajectory, np.maximum(limit_a, limit_b)) <= _OVERSHOOT:
            return trajectory
        step /= 3
    raise RetimingFailed("the path bends too sharply to be followed by cubics")


def _timed(
    grid: SmoothPath, limit_v: Array, limit_a: Array, limit_b: Array, speed: float | Callable[[SmoothPath], Array]
) -> TimedPath:
    x, u = _profile(grid, limit_v, limit_a, limit_b, speed if isinstance(speed, float | int) else speed(grid))
    root = np.sqrt(x)
    durations = 2 * grid.lengths / (root[:-1] + root[1:])
    times = np.concatenate([[0.0], np.cumsum(durations)])
    slopes = np.concatenate([grid.d0, grid.d1[-1:]])
    bends = (grid.d1 - grid.d0) / grid.lengths[:, None]
    accelerations = grid.d0 * u[:, None] + bends * x[:-1, None]
    last = grid.d1[-1] * u[-1] + bends[-1] * x[-1]
    return TimedPath(
        times,
        np.concatenate([grid.starts, grid.end[None, :]]),
        slopes * root[:, None],
        np.concatenate([accelerations, last[None, :]]),
    )


def _overshoot(trajectory: TimedPath, limit_a: Array) -> float:
    """Return the largest acceleration of the cubics as a share of the limits: cubics only approximate bends."""
    return max(float((np.abs(values) / limit_a).max()) for values in end_accelerations(trajectory))


def _profile(
    grid: SmoothPath, limit_v: Array, limit_a: Array, limit_b: Array, speed: float | Array
) -> tuple[Array, Array]:
    """Return x (N + 1,) at the grid points and u (N,) between them."""
    d0, d1, lengths = grid.d0, grid.d1, grid.lengths
    bends = (d1 - d0) / lengths[:, None]
    # Joint accelerations at both ends of an interval, as D u + C x with the x of its beginning.
    D = np.concatenate([d0, d1 + 2 * lengths[:, None] * bends], axis=1)
    C = np.concatenate([bends, bends], axis=1)
    flat = np.abs(D) < _TINY
    sign = np.where(D < 0, -1.0, 1.0)
    safe = np.where(flat, 1.0, np.abs(D))
    up, down = (np.where(flat, np.inf, np.concatenate([limit, limit]) / safe) for limit in (limit_a, limit_b))
    B = np.where(flat, 0.0, sign * C / safe)  # -down - B x <= u <= up - B x
    most = _highest_x(grid, limit_v, np.minimum(limit_a, limit_b), bends, speed)
    count, found = len(lengths), fastest_speeds(lengths, up, down, B, np.array(most))
    if isinstance(found, tuple):
        return found
    if found is not None:
        if found < count:
            raise RetimingFailed(f"no feasible speed at grid point {found} of {count}")
        raise RetimingFailed(f"no feasible speed after grid point {found - count} of {count}")
    highest = _backward(most, lengths, down, B)
    return _forward(highest, lengths, up, B)


def _highest_x(
    grid: SmoothPath, limit_v: Array, limit_a: Array, bends: Array, speed: float | Array
) -> list[float]:
    """Return (N + 1,) x at which speed and velocities are within limits, and accelerations at constant speed.

    A path could be followed somewhat faster into a bend if the speed changed just right in it. Leaving that out ensures
    that each point that is reached can be left, also on a coarse grid.
    """
    slopes = np.abs(np.concatenate([grid.d0, grid.d1[-1:]]))
    most = np.minimum(((limit_v / np.maximum(slopes, _TINY)) ** 2).min(axis=1), speed**2)
    bound = (limit_a / np.maximum(np.abs(bends), _TINY)).min(axis=1)
    most[:-1] = np.minimum(most[:-1], bound)
    most[1:] = np.minimum(most[1:], bound)
    most[0] = most[-1] = 0.0
    return [float(v) for v in most]


def _backward(most: list[float], lengths: Array, A: Array, B: Array) -> list[float]:
    """Return (N + 1,) the highest x from which the next point's range can be reached, from the end to the start.

    x + 2 L u <= next, with the lowest u = max(-A - B x): each line gives x (1 - 2 L B) <= next + 2 L A.
    """
    L2 = 2 * lengths[:, None]
    slope = 1 - L2 * B
    usable = (slope > _TINY) & np.isfinite(A)
    gain = np.where(usable, 1 / np.where(usable, slope, 1.0), 0.0)
    offset = np.where(usable, np.where(np.isfinite(A), L2 * A, 0.0) * gain, np.inf)
    gains, offsets = gain.tolist(), offset.tolist()
    highest = list(most)
    for i in range(len(lengths) - 1, -1, -1):
        following = highest[i + 1]
        x = highest[i]
        for g, o in zip(gains[i], offsets[i], strict=True):
            x = min(x, g * following + o)
        if not x >= 0:
            raise RetimingFailed(f"no feasible speed at grid point {i} of {len(lengths)}")
        highest[i] = x
    return highest


def _forward(highest: list[float], lengths: Array, A: Array, B: Array) -> tuple[Array, Array]:
    """Return the fastest x and u, from the start to the end."""
    As, Bs, Ls = A.tolist(), B.tolist(), lengths.tolist()
    x, xs, us = 0.0, [0.0], []
    for i, length in enumerate(Ls):
        u = min(a - b * x for a, b in zip(As[i], Bs[i], strict=True))
        following = min(highest[i + 1], x + 2 * length * u)
        if following < 0 or (following <= 0 and x <= 0):
            raise RetimingFailed(f"no feasible speed after grid point {i} of {len(Ls)}")
        us.append((following - x) / (2 * length))
        x = following
        xs.append(x)
    return np.array(xs), np.array(us)


def limited_jerk(trajectory: TimedPath, jerk: ArrayLike) -> TimedPath:
    """Return the trajectory with limited jerk (dof,) [rad/s^3]: its average over a short time T, longer by T.

    An average respects all bounds of positions, velocities and accelerations, and changes acceleration by at most twice
    its peak in T. It leaves the path by at most a T^2 / 24: 0.1 mrad at 5 rad/s^2 and 20 ms. The states lie where the
    acceleration's slope changes, so cubics and quintics between them hardly differ. Stops of the trajectory remain.
    """
    stops = np.flatnonzero(np.abs(trajectory.velocities[1:-1]).max(axis=1, initial=0.0) < _TINY) + 1
    if not len(stops):
        return _averaged(trajectory, np.asarray(jerk, dtype=float))
    parts = [
        TimedPath(trajectory.times[a : b + 1] - trajectory.times[a], *(values[a : b + 1] for values in (
            trajectory.positions, trajectory.velocities, trajectory.accelerations)))
        for a, b in pairwise([0, *stops.tolist(), len(trajectory.times) - 1])
    ]
    return join([limited_jerk(part, jerk) for part in parts])


def _averaged(trajectory: TimedPath, limit: Array) -> TimedPath:
    """Return a trajectory without stops between its ends, averaged for a jerk limit (dof,) [rad/s^3]."""
    begin, finish = end_accelerations(trajectory)
    still = np.zeros((1, begin.shape[1]))
    jumps = np.abs(np.concatenate([begin, still]) - np.concatenate([still, finish]))
    peaks = np.maximum(np.abs(begin), np.abs(finish)).max(axis=0)
    slopes = (finish - begin) / np.diff(trajectory.times)[:, None]
    span = float((2 * peaks / limit).max())
    if (np.abs(slopes) <= limit * (1 + _JERK_MARGIN)).all() and (jumps <= _ROUNDING * span * limit).all():
        return trajectory
    span = max(span, _SHORTEST * trajectory.duration)
    bends = np.abs(np.diff(np.concatenate([still, slopes, still]), axis=0))
    sharp = (jumps > _SHARP * span * limit).any(axis=1) | (bends > _SLOPE_CHANGE * limit).any(axis=1)
    sharp[[0, -1]] = True
    at, end = trajectory.times, trajectory.duration + span
    wanted = np.unique(np.concatenate([at[sharp], at[sharp] + span, at[~sharp] + span / 2]))
    times = [0.0]
    for time in wanted[:-1].tolist():
        if times[-1] + _MIN_GAP * span < time < end - _MIN_GAP * span:
            times.append(time)
    t = np.array([*times, end])
    now, before = _with_integral(trajectory, t), _with_integral(trajectory, t - span)
    positions, velocities, accelerations = ((one - other) / span for one, other in zip(now, before, strict=True))
    positions += trajectory.positions[0]
    positions[0], positions[-1] = trajectory.positions[0], trajectory.positions[-1]
    velocities[[0, -1]] = accelerations[[0, -1]] = 0.0
    return TimedPath(t, positions, velocities, accelerations)


def _with_integral(trajectory: TimedPath, times: Array) -> tuple[Array, Array, Array]:
    """Return (N, dof) the integral of the offset from the start, that offset, and its rate; at rest outside."""
    t, ends = trajectory.times, np.clip(times, 0.0, trajectory.duration)
    i = np.clip(np.searchsorted(t, ends, side="right") - 1, 0, len(t) - 2)
    h = np.diff(t)[:, None]
    pieces = cubics(trajectory)
    pieces[:, 0] -= trajectory.positions[0]
    full = (pieces / np.array([1, 2, 3, 4])[:, None]).sum(axis=1) * h
    sums = np.concatenate([np.zeros((1, full.shape[1])), np.cumsum(full, axis=0)])
    r, h = ((ends - t[i]) / (t[i + 1] - t[i]))[:, None], h[i]
    c0, c1, c2, c3 = pieces[i].transpose(1, 0, 2)
    offset = c0 + r * (c1 + r * (c2 + r * c3))
    integral = sums[i] + h * r * (c0 + r * (c1 / 2 + r * (c2 / 3 + r * c3 / 4)))
    beyond = (times - ends)[:, None]
    speed = np.where(beyond == 0.0, (c1 + r * (2 * c2 + 3 * r * c3)) / h, 0.0)
    return integral + np.maximum(beyond, 0.0) * offset, offset, speed
