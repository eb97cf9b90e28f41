"""Joint positions that a planner in joint space may end at, for either kind of goal."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from common.planning.goal_sampling import sample_goals
from common.planning.problem import NOT_APPLICABLE, Cancel, Problem, Region, Result

Array = NDArray[np.float64]


def joint_goals(problem: Problem, cancel: Cancel, *, wanted: int, tries: int = 40) -> list[Array] | Result:
    """Free goal positions (dof,) [rad], nearest to the start first; or why there is none.

    Args:
        problem: with a joint goal or a region; other goals, and straight lines of the tool, do not apply.
        cancel: ends the search for IK solutions.
        wanted: how many solutions of a pose to look for.
        tries: seeds and poses tried to find them.
    """
    if problem.straight:
        return Result(error=NOT_APPLICABLE, message="a path through joint space is no straight line of the tool")
    if isinstance(problem.goal, np.ndarray):
        return [problem.goal]
    if not isinstance(problem.goal, Region):
        return Result(error=NOT_APPLICABLE, message="a path through joint space needs a joint goal or a pose goal")
    samples = sample_goals(problem, problem.goal, cancel, wanted=wanted, tries=tries)
    if samples.goals:
        return samples.goals
    return samples.failure(cancel.reason(problem))


def first_success(goals: list[Array], attempt: Callable[[Array], Result], cancel: Cancel, problem: Problem) -> Result:
    """The result for the nearest goal with which the attempt succeeds; else for the one that got furthest."""
    best: Result | None = None
    for goal in goals:
        stop = cancel.reason(problem)
        if stop:
            return Result(error=stop, message="planning was ended")
        result = attempt(goal)
        if not result.error:
            return result
        if best is None or result.fraction > best.fraction:
            best = result
    assert best is not None  # there is at least one goal
    return best


def blocked(problem: Problem, waypoints: Array) -> Result | None:
    """What collides first along straight edges between waypoints (N, dof) [rad]; None where all of it is free."""
    count = len(waypoints) - 1
    for i in range(1, count + 1):
        if problem.world.edge_free(waypoints[i - 1], waypoints[i]):
            continue
        hit = problem.world.edge_collision(waypoints[i - 1], waypoints[i], 0.002)
        pair = hit.pair if hit else ("robot", "scene")
        message = f"waypoint {i} of {count}: {pair[0]} collides with {pair[1]}"
        return Result(
            error="collision", message=message, waypoint=i, colliding=pair, fraction=(i - 1) / count
        )
    return None


def blocked_edge(problem: Problem, goal: Array, steps: int) -> Result | None:
    """What collides first on the straight edge from the start to a goal (dof,) [rad], as waypoint of so many steps."""
    if problem.world.edge_free(problem.start, goal):
        return None
    return blocked(problem, line(problem.start, goal, steps))


def line(start: Array, goal: Array, steps: int) -> Array:
    """(steps + 1, dof) evenly spaced positions [rad] from start to goal."""
    waypoints: Array = start + np.linspace(0, 1, steps + 1)[:, None] * (goal - start)
    waypoints[-1] = goal
    return waypoints
