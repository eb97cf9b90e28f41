"""Sequential convex optimisation: the shortest path that keeps a clearance, after TrajOpt.

Schulman, Duan, Ho, Lee, Awwal, Bradlow, Pan, Patil, Goldberg, Abbeel: "Motion planning with sequential convex
optimization and convex collision checking" (IJRR 2014), algorithm 1: distances are linearised, violations of the
clearance are penalised, and a quadratic program is solved within a trust region about the last path. Distances are
those at the waypoints and the middles of the edges. Once these are free and an edge still is not, distances of the
links' hulls at both ends of an edge are added, as in the paper: they take several times as long. The programs are dense
and small; daqp, an active-set solver, solves them in milliseconds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import daqp
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from common.config import Parameters
from common.planning.joint_goals import joint_goals
from common.planning.joint_paths import check_path, evenly_spaced, first_success, line, with_restarts
from common.planning.problem import Cancel, Problem, Result
from common.planning.proximity import NearPairs, Proximity, SweptEdges, concatenated

Array = NDArray[np.float64]

_OWN_CLEARANCE = 0.01  # [m] between links of the robot
_BEYOND = 0.05  # [m] beyond the clearance, within which a step could bring a pair too close
_ACCEPTED = 0.25  # share of the expected improvement that a step must bring
_SHRINK, _GROW = 0.3, 1.5  # of the trust region
_SMALLEST_TRUST = 1e-3  # [rad]
_CONVERGED = 1e-3  # of the merit: a smaller expected improvement counts as none
_STRICTER = 10.0  # factor of the penalty when the path has converged and still collides
_STRICTEST = 1e4
_UNBOUNDED = 1e30
_SLACK = 1e-4  # curvature of the penalty, so that the program is strictly convex


class Options(Parameters):
    """Size of the problem and limits of the optimisation."""

    steps: int = Field(20, ge=3, le=100, description="edges of the path that is optimised")
    iterations: int = Field(100, ge=1, le=10000, description="limit of quadratic programs")
    trust_region: float = Field(0.1, gt=0, le=3, description="of each joint in the first iteration [rad]")
    merit: float = Field(10.0, gt=0, le=1e4, description="penalty per metre of violated clearance")
    clearance: float = Field(0.02, ge=0, le=0.5, description="distance to keep from everything [m]")
    restarts: int = Field(2, ge=0, le=100, description="other first guesses, tried when the straight edge fails")
    goals: int = Field(4, ge=1, le=100, description="IK solutions of a pose goal to choose from")


@dataclass(frozen=True)
class _Chain:
    """How the checked positions follow from the waypoints that may move.

    Attributes:
        spread: (P, M) so that spread @ waypoints + ends are waypoints and the middles of the edges, in order.
        ends: (P, dof) what the fixed ends contribute.
        H: (M, M), pull: (M, dof) so that sum(waypoints H waypoints) / 2 + sum(pull waypoints) is half the sum of the
            squared edges but for a constant.
    """

    spread: Array
    ends: Array
    H: Array
    pull: Array

    def positions(self, waypoints: Array) -> Array:
        """(P, dof) [rad]."""
        return np.asarray(self.spread @ waypoints + self.ends)

    def cost(self, waypoints: Array) -> float:
        """Half the sum of the squared edges [rad^2], but for a constant."""
        return float(0.5 * (waypoints * (self.H @ waypoints)).sum() + (self.pull * waypoints).sum())


def plan(problem: Problem, options: Options, cancel: Cancel) -> Result:
    """Return a path that the optimisation made free of collision, or what still collides at its end."""
    goals = joint_goals(problem, cancel, wanted=options.goals)
    if isinstance(goals, Result):
        return goals
    proximity = Proximity(problem.world, options.clearance + _BEYOND, own_reach=_OWN_CLEARANCE + _BEYOND, nearest=True)
    swept = SweptEdges(problem.world, options.clearance)

    def attempt(goal: Array) -> Result:
        path = line(problem.start, goal, options.steps)
        if problem.world.edge_free(problem.start, goal):  # nothing is shorter
            return Result(waypoints=evenly_spaced(path), dense=True, fraction=1.0)
        from_guess = partial(_optimise, problem, options, proximity, swept, cancel)
        return with_restarts(problem, path, options.restarts, from_guess)

    return first_success(goals, attempt, cancel, problem)


def _optimise(
    problem: Problem, options: Options, proximity: Proximity, swept: SweptEdges, cancel: Cancel, path: Array
) -> Result:
    """Return the path that the optimisation makes of a first guess (steps + 1, dof) [rad], or its collision."""
    chain = _chain(path[0], path[-1], options.steps)
    waypoints = path[1:-1]
    trust, merit = options.trust_region, options.merit
    proximity.forget()

    def measured(waypoints: Array, sweeping: bool) -> NearPairs:
        positions = chain.positions(waypoints)
        states = proximity.measure(positions)
        return concatenated(states, swept.measure(positions[::2])) if sweeping else states

    near = measured(waypoints, False)
    sweeping = bool((near.distance > 0).all())
    if sweeping:
        near = measured(waypoints, True)
    for iteration in range(options.iterations):
        stop = cancel.reason(problem)
        if stop:
            return Result(error=stop, message=f"planning ended after {iteration} iterations")
        following, expected = _step(problem, chain, waypoints, near, trust, merit, options.clearance)
        now = chain.cost(waypoints) + merit * _violation(near, options.clearance)
        if now - expected < _CONVERGED * max(abs(now), 1.0) or trust < _SMALLEST_TRUST:
            if merit >= _STRICTEST:
                break
            merit, trust = merit * _STRICTER, options.trust_region
            continue
        near_then = measured(following, sweeping)
        then = chain.cost(following) + merit * _violation(near_then, options.clearance)
        if now - then < _ACCEPTED * (now - expected):
            trust *= _SHRINK
            continue
        waypoints, near, trust = following, near_then, trust * _GROW
        if (near.distance > 0).all():
            even = evenly_spaced(np.concatenate([path[:1], waypoints, path[-1:]]))
            if check_path(problem, even) is None:
                return Result(waypoints=even, dense=True, fraction=1.0)
            if not sweeping:
                near, sweeping, trust = measured(waypoints, True), True, options.trust_region
    even = evenly_spaced(np.concatenate([path[:1], waypoints, path[-1:]]))
    failure = check_path(problem, even)
    if failure is None:
        return Result(waypoints=even, dense=True, fraction=1.0)
    return replace(failure, message=f"{failure.message} after {iteration + 1} iterations")


def _chain(start: Array, goal: Array, steps: int) -> _Chain:
    count = steps + 1
    all_points = np.zeros((2 * steps + 1, count))
    all_points[::2] = np.eye(count)
    all_points[1::2] = 0.5 * (np.eye(count)[:-1] + np.eye(count)[1:])
    fixed = np.stack([start, goal])
    differences = np.diff(np.eye(count), axis=0)
    square = differences.T @ differences
    return _Chain(
        all_points[:, 1:-1],
        all_points[:, [0, -1]] @ fixed,
        square[1:-1, 1:-1],
        square[1:-1][:, [0, -1]] @ fixed,
    )


def _violation(near: NearPairs, clearance: float) -> float:
    """Return the sum [m] over the positions of the largest violation of a clearance."""
    worst = np.zeros(int(near.position.max(initial=0)) + 1)
    np.maximum.at(worst, near.position, _clearances(near, clearance) - near.distance)
    return float(worst.sum())


def _clearances(near: NearPairs, clearance: float) -> Array:
    """Return (K,) required distances [m]; links of the robot may be closer to each other."""
    return np.minimum(clearance, near.reach - _BEYOND)


def _step(
    problem: Problem, chain: _Chain, waypoints: Array, near: NearPairs, trust: float, merit: float, clearance: float
) -> tuple[Array, float]:
    """Return the best waypoints (M, dof) within the trust region by the linearised distances, and their merit.

    min x (H x I) x / 2 + pull x + merit sum(t) with t >= 0 and distance + gradient (x - waypoints) + t >= clearance,
    where all pairs at a position share its t.
    """
    count, dof = waypoints.shape
    clearances = _clearances(near, clearance)
    influence = chain.spread[near.position]  # (K, M)
    farthest = trust * np.abs(near.gradient).sum(axis=1) * influence.sum(axis=1)
    use = (near.distance - farthest < clearances) & (influence.sum(axis=1) > 0)
    rows = (influence[use][:, :, None] * near.gradient[use][:, None, :]).reshape(-1, count * dof)
    places, owner = np.unique(near.position[use], return_inverse=True)
    slacks, pairs = len(places), len(rows)
    size = count * dof + slacks
    H = np.zeros((size, size))
    H[: count * dof, : count * dof] = np.kron(chain.H, np.eye(dof))
    H[count * dof :, count * dof :] = _SLACK * np.eye(slacks)
    f = np.concatenate([chain.pull.ravel(), np.full(slacks, merit)])
    A = np.hstack([rows, np.eye(slacks)[owner]])
    flat = waypoints.ravel()
    least = clearances[use] - near.distance[use] + rows @ flat
    lower = np.maximum(np.tile(problem.robot.lower, count), flat - trust)
    upper = np.minimum(np.tile(problem.robot.upper, count), flat + trust)
    x, _, outcome, _ = daqp.solve(
        H,
        f,
        np.ascontiguousarray(A),
        np.concatenate([upper, np.full(slacks + pairs, _UNBOUNDED)]),
        np.concatenate([lower, np.zeros(slacks), least]),
    )
    if outcome < 1:  # the program always has a solution: bad numbers spoil this step only
        return waypoints, np.inf
    following = np.asarray(x[: count * dof]).reshape(count, dof)
    linear = replace(near, distance=near.distance + (influence * _dot(near, following - waypoints)).sum(axis=1))
    return following, chain.cost(following) + merit * _violation(linear, clearance)


def _dot(near: NearPairs, change: Array) -> Array:
    """Return (K, M) the effect of a change of each waypoint (M, dof) [rad] on each distance [m]."""
    return np.asarray(near.gradient @ change.T)
