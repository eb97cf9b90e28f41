"""What planners that optimise a whole path share: the first guess, even spacing, and the check at the end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from common.planning.joint_goals import blocked
from common.planning.path import dense_path, distinct
from common.planning.problem import Problem, Result

Array = NDArray[np.float64]

_BEND = 0.5  # [rad] standard deviation of each joint
_BEND_TRIES = 50
_SPACING = 0.1  # [rad] between waypoints of a path that is handed on


def quintic(start: Array, goal: Array, count: int) -> Array:
    """(count, dof) positions [rad] at even times of the straight edge with a quintic profile from rest to rest."""
    t = np.linspace(0, 1, count)[:, None]
    path: Array = start + t**3 * (10 - 15 * t + 6 * t**2) * (goal - start)
    path[-1] = goal
    return path


def bent(problem: Problem, path: Array) -> Array:
    """Another first guess: the path (N, dof) [rad] bent so that its middle is at some free position not far away."""
    robot, middle = problem.robot, path[len(path) // 2]
    bump = np.sin(np.pi * np.linspace(0, 1, len(path)))[:, None] ** 2
    for _ in range(_BEND_TRIES):
        place = np.clip(middle + problem.rng.normal(0.0, _BEND, robot.dof), robot.lower, robot.upper)
        if not problem.world.collides(place):
            break
    return np.asarray(np.clip(path + bump * (place - middle), robot.lower, robot.upper))


def with_restarts(
    problem: Problem, path: Array, restarts: int, attempt: Callable[[Array], Result]
) -> Result:
    """The result of the first attempt that succeeds, from the path itself and then from bent ones; else the first."""
    first = attempt(path)
    if first.error != "collision" or not restarts:
        return first
    for _ in range(restarts):
        result = attempt(bent(problem, path))
        if result.error != "collision":
            return result
    return replace(first, message=f"{first.message}, nor is the way free from {restarts} other guesses")


def evenly_spaced(path: Array, spacing: float = _SPACING) -> Array:
    """(N, dof) positions along a path (M, dof), at equal distances in joint space [rad] of about `spacing`."""
    points = distinct(path)
    if len(points) < 3:
        return path[[0, -1]]
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    places = np.linspace(0, way[-1], max(2, round(way[-1] / spacing)) + 1)
    return np.stack([np.interp(places, way, column) for column in points.T], axis=1)


def check_path(problem: Problem, waypoints: Array) -> Result | None:
    """What collides first along a path as it will be smoothed (edges and spline), as waypoint and pair; or None."""
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
