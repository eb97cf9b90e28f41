"""Joint positions that a planner in joint space may end at, for either kind of goal."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from common.messages import PlanAttempt
from common.planning.free_axes import why_not_in
from common.planning.goal_sampling import sample_goals
from common.planning.problem import NOT_APPLICABLE, Cancel, GoalChoice, Problem, Region, Result
from common.planning.resolving import quicker_goals
from common.time_source import monotonic

Array = NDArray[np.float64]

_LEAST_TRIES = 4  # to find one of the solutions of each of many poses
_TOLD = 4  # goals of a set of which a message says why they fail


def joint_goals(problem: Problem, cancel: Cancel, *, wanted: int, tries: int = 40) -> list[Array] | Result:
    """Free goal positions (dof,) [rad], those that take least time first; or why there is none.

    Args:
        problem: with a joint goal, a region, or several of these to choose from; other goals, and straight lines of the
            tool, do not apply.
        cancel: ends the search for IK solutions.
        wanted: how many solutions of a pose to look for; of several poses together, but at least one of each.
        tries: seeds and poses tried to find them.
    """
    if problem.straight:
        return Result(error=NOT_APPLICABLE, message="a path through joint space is no straight line of the tool")
    if isinstance(problem.goal, np.ndarray):
        return [problem.goal]  # the request's checks found it free
    if not isinstance(problem.goal, Region | GoalChoice):
        return Result(error=NOT_APPLICABLE, message="a path through joint space needs a joint goal or a pose goal")
    choices = problem.goal.goals if isinstance(problem.goal, GoalChoice) else (problem.goal,)
    wanted, tries = math.ceil(wanted / len(choices)), max(_LEAST_TRIES, tries // len(choices))
    found: list[Array] = []
    failures: dict[int, Result] = {}
    for number, goal in enumerate(choices, 1):
        samples = sample_goals(problem, goal, cancel, wanted=wanted, tries=tries)
        found += samples.goals
        if not samples.goals:
            failures[number] = samples.failure(cancel.reason(problem))
    if found:
        return quicker_goals(problem, found)
    if (stop := cancel.reason(problem)) and len(choices) > 1:  # the others may not be looked at yet
        return Result(error=stop, message=f"planning was ended while {len(choices)} goals were sampled")
    for number in list(failures)[:_TOLD]:
        failures[number] = _explained(problem, choices[number - 1], failures[number])
    return failures[1] if isinstance(problem.goal, Region) else none_of(failures)


def _explained(problem: Problem, goal: Array | Region, failure: Result) -> Result:
    """The failure of a goal, with what keeps the arm from it."""
    if failure.error != "no_ik" or not isinstance(goal, Region):
        return failure
    return replace(failure, message=f"{failure.message}: {why_not_in(problem.robot, goal, problem.start)}")


def none_of(failures: Mapping[int, Result]) -> Result:
    """Why none of several goals can be reached, by their numbers: the failure that got furthest, and what each is."""
    best = max(failures.values(), key=lambda failure: (failure.fraction, failure.colliding is not None))
    told = [f"goal {number}: {failures[number].message}" for number in sorted(failures)[:_TOLD]]
    if len(failures) > _TOLD:
        told.append(f"and {len(failures) - _TOLD} more")
    return replace(best, message=f"none of {len(failures)} goals; {'; '.join(told)}", goal=None)


def straight_edge(problem: Problem, goals: list[Array], planner: str) -> Result | None:
    """The straight edge to the first goal to which it is free: so it is for most pairs, and nothing is shorter."""
    began = monotonic()
    for goal in goals:
        if problem.world.edge_free(problem.start, goal):
            attempt = PlanAttempt(
                planner=planner, seconds=monotonic() - began, fraction=1.0, message="straight edge in joint space"
            )
            return Result(waypoints=np.array([problem.start, goal]), fraction=1.0, attempts=[attempt])
    return None


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
        found = problem.world.obstruction(waypoints[i - 1], waypoints[i], 0.002)
        message = f"waypoint {i} of {count}: {found.message}"
        return Result(
            error=found.error, message=message, waypoint=i, colliding=found.colliding, fraction=(i - 1) / count
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
