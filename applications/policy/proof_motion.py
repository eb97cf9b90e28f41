"""Smooth motions through the rows of a chunk: the fitted spline, the stops from it, and the limits that they keep.

All motions are cubic splines with continuous acceleration, given by their states at the knots. Cubic and quintic
interpolation of such states are the spline itself, so the executor follows exactly what is proved, and velocity,
acceleration and jerk have their extremes where a formula finds them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from applications.policy.interface import Cause, MotionState
from common.hardware.interface import Limits
from common.planning.trajectory import TimedPath, cubics

Array = NDArray[np.float64]

SHORTEST_STEP, LONGEST_STEP = 0.02, 0.1  # [s] between knots
MOST_KNOTS = 100  # unless there are more rows
CUTOFF = 30.0  # [rad/s] faster parts of the rows are smoothed away
ROUNDING = 1e-6  # share by which a limit may be exceeded, and [rad]
_RAMP = 0.2  # share of a stop's duration in which the deceleration is reached, and the same at the end
_SHORTEST_STOP = 0.04  # [s]


def fitted(state: MotionState, rows: Array, times: Array, fade: float = 0.0) -> TimedPath:
    """Return the spline from a state that follows rows (n, dof) [rad] at times (n,) [s], with a knot for each.

    It minimises the squared distance from the rows plus the squared jerk / CUTOFF^3, and so removes noise without a
    delay. Its knots are at most a row apart; the last is at the last row.

    Args:
        state: positions, velocities and accelerations at time 0, which it has exactly.
        rows, times: what to follow; fade: duration [s] in which the weight of the rows grows.
    """
    end = float(times[-1])
    step = float(np.clip(end / len(times), SHORTEST_STEP, LONGEST_STEP))
    count = min(max(1, int(np.ceil(end / step - 1e-6))), max(MOST_KNOTS, len(times)))
    h = end / count
    place = np.minimum((times / h).astype(int), count - 1)
    basis = np.zeros((len(times), count + 3))
    np.put_along_axis(basis, place[:, None] + np.arange(4), _basis(times / h - place), axis=1)
    weights = np.minimum(times / fade, 1.0) ** 2 if fade > 0 else np.ones(len(times))
    weighted = basis * (weights * (end / len(times)))[:, None]
    normal = weighted.T @ basis + _roughness(count) / (CUTOFF**6 * h**5)
    bend = state.accelerations * h * h
    first = state.positions - bend / 6
    fixed = np.array([first - state.velocities * h + bend / 2, first, first + state.velocities * h + bend / 2])
    free = np.linalg.solve(normal[3:, 3:], weighted[:, 3:].T @ rows - normal[3:, :3] @ fixed)
    c = np.concatenate([fixed, free])
    q, dq = (c[:-2] + 4 * c[1:-1] + c[2:]) / 6, (c[2:] - c[:-2]) / (2 * h)
    ddq = (c[2:] - 2 * c[1:-1] + c[:-2]) / h**2
    q[0], dq[0], ddq[0] = state.positions, state.velocities, state.accelerations
    return TimedPath(np.linspace(0.0, end, count + 1), q, dq, ddq)


def _basis(u: Array) -> Array:
    """Return (n, 4) the uniform cubic B-splines that differ from 0 at shares u (n,) of an interval."""
    v = 1 - u
    return np.stack([v**3, 3 * u**3 - 6 * u**2 + 4, 3 * v**3 - 6 * v**2 + 4, u**3], axis=1) / 6


@lru_cache(maxsize=64)
def _roughness(count: int) -> Array:
    """Return (count + 3, count + 3) the squared third differences of coefficients, as a quadratic form."""
    third = np.zeros((count, count + 3))
    for offset, value in enumerate((-1.0, 3.0, -3.0, 1.0)):
        third[np.arange(count), np.arange(count) + offset] = value
    return np.asarray(third.T @ third)


@dataclass(frozen=True)
class Stops:
    """Motions to rest from N states, each of three cubics: times (N, 4) [s] from its state, states (N, 4, dof)."""

    times: Array
    positions: Array
    velocities: Array
    accelerations: Array

    def one(self, index: int) -> TimedPath:
        """Return the stop from one of the states."""
        return TimedPath(
            self.times[index], self.positions[index], self.velocities[index], self.accelerations[index])

    @property
    def spans(self) -> Array:
        """Durations (3 N,) of the cubics [s]."""
        return np.diff(self.times, axis=1).reshape(-1)

    def cubics(self) -> Array:
        """Return (3 N, 4, dof) all of them, one after the other, as `common.planning.trajectory.cubics`."""
        count, _, dof = self.positions.shape
        h = np.diff(self.times, axis=1)[:, :, None]
        c2 = self.accelerations[:, :-1] * h**2 / 2
        c3 = np.diff(self.accelerations, axis=1) * h**2 / 6
        pieces = np.stack([self.positions[:, :-1], self.velocities[:, :-1] * h, c2, c3], axis=2)
        return pieces.reshape(3 * count, 4, dof)

    def curves(self) -> Array:
        """Return (2 N, 4, dof) the same positions as two curves each: the last two cubics are one straight line.

        From the end of the first, the joints lose their velocities in the same proportion.
        """
        curves = self.cubics().reshape(len(self.times), 3, 4, -1)[:, :2].copy()
        curves[:, 1, 1] = self.positions[:, 3] - self.positions[:, 1]
        curves[:, 1, 2:] = 0.0
        return curves.reshape(-1, *curves.shape[2:])


def braked(q: Array, dq: Array, braking: Array, step: float) -> tuple[Array, NDArray[np.int64]]:
    """Return positions (M, dof) along stops from states (N, dof), and the state of each.

    Each joint brakes on its own with its deceleration limit (dof,) [rad/s^2], and they stop at different times.
    Positions of a stop are about `step` [rad] apart.
    """
    durations = np.abs(dq) / braking
    last = durations.max(axis=1)
    counts = np.maximum(1, np.ceil((np.abs(dq) * durations).max(axis=1) / (2 * step)).astype(int))
    owners = np.repeat(np.arange(len(q)), counts)
    number = np.arange(len(owners)) - np.repeat(np.cumsum(counts) - counts, counts) + 1
    share = 1 - np.sqrt(1 - number / counts[owners])  # of the time at which the slowest has covered an equal part
    t = np.minimum((share * last[owners])[:, None], durations[owners])
    return q[owners] + dq[owners] * t - np.sign(dq[owners]) * braking * t**2 / 2, owners


def stops_from(q: Array, dq: Array, ddq: Array, acceleration: Array, jerk: Array) -> Stops:
    """Return motions to rest from states (N, dof), in which all joints stop at the same time.

    Each joint's acceleration changes linearly to a deceleration, stays, and changes linearly to 0, so an arm without an
    acceleration at the state stops on a straight line in joint space.

    Args:
        q, dq, ddq: states; acceleration, jerk: limits (dof,), which the duration is chosen for.
    """
    inner = 1 - _RAMP
    same = np.where(dq * ddq > 0, np.minimum(np.abs(ddq), acceleration), 0.0)
    T = (np.abs(dq) / (acceleration * inner - same * _RAMP / 2)).max(axis=1)
    T = np.maximum(T, _SHORTEST_STOP)[:, None]
    for _ in range(6):
        level = -(dq + ddq * _RAMP * T / 2) / (inner * T)
        slopes = np.maximum(np.abs(level - ddq), np.abs(level)) / (_RAMP * T)
        over = (slopes / jerk).max(axis=1, keepdims=True)
        if (over <= 1.0).all():
            break
        T = np.where(over > 1.0, T * np.minimum(over, 2.0) * 1.01, T)
    level = -(dq + ddq * _RAMP * T / 2) / (inner * T)
    h = np.concatenate([_RAMP * T, (1 - 2 * _RAMP) * T, _RAMP * T], axis=1)
    accelerations = np.stack([ddq, level, level, np.zeros_like(level)], axis=1)
    positions, velocities = [q], [dq]
    for k in range(3):
        step, a0, a1 = h[:, k, None], accelerations[:, k], accelerations[:, k + 1]
        positions.append(positions[-1] + step * velocities[-1] + step**2 * (2 * a0 + a1) / 6)
        velocities.append(velocities[-1] + step * (a0 + a1) / 2)
    velocities[-1] = np.zeros_like(dq)
    times = np.concatenate([np.zeros((len(q), 1)), np.cumsum(h, axis=1)], axis=1)
    return Stops(times, np.stack(positions, axis=1), np.stack(velocities, axis=1), accelerations)


@dataclass(frozen=True)
class Excess:
    """The first limit that cubics exceed: index of the cubic, joint, kind, and by how much the motion is too fast."""

    piece: int
    joint: int
    cause: Cause
    slowing: float


def first_excess(
    spans: Array, pieces: Array, limits: Limits, acceleration: Array, lower: Array, upper: Array
) -> Excess | None:
    """Return the first limit that cubics exceed anywhere, None for none.

    `slowing` is the factor by which the complete motion would have to be slower: 1 if that does not help.

    Args:
        spans: (N,) durations [s]; pieces: (N, 4, dof) as `cubics`.
        limits: velocity and jerk; acceleration: (dof,) [rad/s^2]; lower, upper: (dof,) [rad].
    """
    h = spans[:, None]
    _, c1, c2, c3 = pieces.transpose(1, 0, 2)
    v0, v1 = c1, c1 + 2 * c2 + 3 * c3
    a0, a1 = 2 * c2, 2 * c2 + 6 * c3
    with np.errstate(divide="ignore", invalid="ignore"):
        between = np.where(a0 * a1 < 0, np.abs(c1 - c2**2 / (3 * c3)), 0.0)
    speed = np.maximum(np.maximum(np.abs(v0), np.abs(v1)), between) / h / limits.velocity
    strength = np.maximum(np.abs(a0), np.abs(a1)) / h**2 / acceleration
    jerk = 6 * np.abs(c3) / h**3 / limits.jerks
    outside = _outside(pieces, lower, upper)
    most = 1 + ROUNDING
    bad = outside | ~((speed <= most) & (strength <= most) & (jerk <= most))  # also where one is NaN
    if not bad.any():
        return None
    piece, joint = (int(i) for i in np.argwhere(bad)[0])
    slowing = max(float(speed.max()), float(np.sqrt(strength.max())), float(np.cbrt(jerk.max())), 1.0)
    causes: tuple[tuple[Cause, bool], ...] = (
        ("position", bool(outside[piece, joint])), ("velocity", bool(speed[piece, joint] > most)),
        ("acceleration", bool(strength[piece, joint] > most)), ("jerk", True),
    )
    return Excess(piece, joint, next(cause for cause, holds in causes if holds), slowing)


def _outside(pieces: Array, lower: Array, upper: Array) -> NDArray[np.bool_]:
    """Return (N, dof) which cubics leave a position limit anywhere."""
    low, high = lower - ROUNDING, upper + ROUNDING
    c0, c1, c2, c3 = pieces.transpose(1, 0, 2)
    hull = np.stack([c0, c0 + c1 / 3, c0 + (2 * c1 + c2) / 3, c0 + c1 + c2 + c3])
    found = ((hull < low) | (hull > high)).any(axis=0)
    if not found.any():
        return np.asarray(found)
    with np.errstate(divide="ignore", invalid="ignore"):
        root = np.sqrt(c2**2 - 3 * c3 * c1)
        m = -(c2 + np.where(c2 < 0, -root, root))  # both roots of c1 + 2 c2 r + 3 c3 r^2, without cancellation
        turns = np.stack([m / (3 * c3), c1 / m])
    r = np.concatenate([np.zeros_like(turns[:1]), np.ones_like(turns[:1]), turns])
    r = np.where((r > 0) & (r < 1), r, np.array([0.0, 1.0, 0.0, 0.0])[:, None, None])
    q = c0 + r * (c1 + r * (c2 + r * c3))
    return np.asarray(((q < low) | (q > high)).any(axis=0))


def excess_of(
    path: TimedPath, limits: Limits, acceleration: Array, lower: Array, upper: Array
) -> Excess | None:
    """Return the first limit that a spline exceeds, as `first_excess`; `piece` is the knot before it."""
    return first_excess(np.diff(path.times), cubics(path), limits, acceleration, lower, upper)


def slowed_times(times: Array, factor: float, ramp: float, first: float) -> Array:
    """Return times (n,) [s] at which a motion that becomes slower by a factor is at rows of these times.

    Args:
        times: (n,) [s] of the rows; factor: how much slower the motion is after a time `ramp` [s].
        first: share of its speed that it has at time 0, from where it changes linearly.
    """
    gain = (1 / factor - first) / ramp
    within = 2 * times / (first + np.sqrt(np.maximum(first**2 + 2 * gain * times, 1e-12)))
    covered = ramp * (first + 1 / factor) / 2
    return np.asarray(np.where(times < covered, within, ramp + (times - covered) * factor))
