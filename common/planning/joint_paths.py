"""Steps that planners in joint space share: straight edges, first guesses, even spacing and collision checks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from common.messages import PlanAttempt
from common.planning.path import dense_path, distinct
from common.planning.problem import Cancel, Problem, Result
from common.time_source import monotonic

Array = NDArray[np.float64]

_BEND = 0.5  # [rad] standard deviation of each joint
_BEND_TRIES = 50
_SPACING = 0.1  # [rad] between waypoints of an optimised path


def straight_edge(problem: Problem, goals: list[Array], planner: str) -> Result | None:
    """Return the straight edge to the first goal that it is free to, or None; nothing is shorter."""
    began = monotonic()
    for goal in goals:
        if problem.world.edge_free(problem.start, goal):
            attempt = PlanAttempt(
                planner=planner, seconds=monotonic() - began, fraction=1.0, message="straight edge in joint space"
            )
            return Result(waypoints=np.array([problem.start, goal]), fraction=1.0, attempts=[attempt])
    return None


def first_success(goals: list[Array], attempt: Callable[[Array], Result], cancel: Cancel, problem: Problem) -> Result:
    """Return the result of the first goal for which the attempt succeeds, else the failure that got furthest."""
    best: Result | None = None
    for goal in goals:
        stop = cancel.reason(problem)
        if stop:
            return Result(error=stop, message="planning ended early")
        result = attempt(goal)
        if not result.error:
            return result
        if best is None or result.fraction > best.fraction:
            best = result
    assert best is not None  # there is at least one goal
    return best


def line(start: Array, goal: Array, steps: int) -> Array:
    """Return (steps + 1, dof) evenly spaced positions [rad] from start to goal."""
    waypoints: Array = start + np.linspace(0, 1, steps + 1)[:, None] * (goal - start)
    waypoints[-1] = goal
    return waypoints


def blocked(problem: Problem, waypoints: Array) -> Result | None:
    """Return the first collision along straight edges between waypoints (N, dof) [rad], or None if all are free."""
    count = len(waypoints) - 1
    for i in range(1, count + 1):
        if problem.world.edge_free(waypoints[i - 1], waypoints[i]):
            continue
        found = problem.world.obstruction(waypoints[i - 1], waypoints[i], 0.002)
        message = f"waypoint {i} of {count}: {found.message}"
        return Result(
            error=found.error, message=message, waypoint=i, colliding=found.colliding, fraction=(i - 1) / count
        )
    return None


def blocked_edge(problem: Problem, goal: Array, steps: int) -> Result | None:
    """Return the first collision on the straight edge to a goal (dof,) [rad], counted in steps, or None."""
    if problem.world.edge_free(problem.start, goal):
        return None
    return blocked(problem, line(problem.start, goal, steps))


def quintic(start: Array, goal: Array, count: int) -> Array:
    """Return (count, dof) positions [rad] at even times of the straight edge with a quintic profile, rest to rest."""
    t = np.linspace(0, 1, count)[:, None]
    path: Array = start + t**3 * (10 - 15 * t + 6 * t**2) * (goal - start)
    path[-1] = goal
    return path


def bent(problem: Problem, path: Array) -> Array:
    """Return the path (N, dof) [rad] bent so that its middle is at a random free position nearby."""
    robot, middle = problem.robot, path[len(path) // 2]
    bump = np.sin(np.pi * np.linspace(0, 1, len(path)))[:, None] ** 2
    for _ in range(_BEND_TRIES):
        place = np.clip(middle + problem.rng.normal(0.0, _BEND, robot.dof), robot.lower, robot.upper)
        if not problem.world.collides(place):
            break
    return np.asarray(np.clip(path + bump * (place - middle), robot.lower, robot.upper))


def with_restarts(problem: Problem, path: Array, restarts: int, attempt: Callable[[Array], Result]) -> Result:
    """Return the first success among attempts from the path itself and from bent ones, else the first failure."""
    first = attempt(path)
    if first.error != "collision" or not restarts:
        return first
    for _ in range(restarts):
        result = attempt(bent(problem, path))
        if result.error != "collision":
            return result
    return replace(first, message=f"{first.message}; {restarts} other first guesses also collide")


def evenly_spaced(path: Array, spacing: float = _SPACING) -> Array:
    """Return (N, dof) positions along a path (M, dof), at equal joint-space distances [rad] of about `spacing`."""
    points = distinct(path)
    if len(points) < 3:
        return path[[0, -1]]
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    places = np.linspace(0, way[-1], max(2, round(way[-1] / spacing)) + 1)
    return np.stack([np.interp(places, way, column) for column in points.T], axis=1)


def check_path(problem: Problem, waypoints: Array) -> Result | None:
    """Return the first collision along a path as it will be smoothed (edges and spline), or None if it is free."""
    hit = blocked(problem, waypoints)
    if hit:
        return hit
    points = distinct(waypoints)
    if len(points) < 3:
        return None
    spline = dense_path(points).positions(0.01)
    found = problem.world.first_collision(spline)
    if found is None:
        return None
    waypoint = int(np.abs(waypoints - found.q).max(axis=1).argmin())
    count = len(waypoints) - 1
    message = f"waypoint {waypoint} of {count}: {found.pair[0]} collides with {found.pair[1]}"
    return Result(
        error="collision", message=message, waypoint=waypoint, colliding=found.pair, fraction=waypoint / count
    )
