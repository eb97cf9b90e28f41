"""A path through joint space by the compiled kernel's RRT-Connect, every edge of it proved free."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from common.config import Parameters
from common.messages import PlanAttempt
from common.planning.goal_sampling import min_travel_time
from common.planning.joint_goals import joint_goals
from common.planning.joint_paths import straight_edge
from common.planning.kernel.solvers import SearchResult, find_path
from common.planning.kernel.world import KernelWorld
from common.planning.problem import NOT_APPLICABLE, Cancel, Problem, Result
from common.time_source import monotonic

Array = NDArray[np.float64]


_MANY = 200  # samples after which a tree that has not grown explains a failure


class Options(Parameters):
    """How far the trees reach, how long paths are shortened, and how many goals there are to choose from."""

    reach: float = Field(1.0, gt=0, le=10, description="longest edge of the trees [rad]")
    shortcuts: int = Field(300, ge=0, le=100_000, description="tries to shorten a path")
    patience: int = Field(60, ge=1, le=100_000, description="tries in a row without success that end the shortening")
    good_enough: float = Field(
        0.05, ge=0, le=10, description="a path that takes longer than the straight edge by a smaller share is accepted"
    )
    goals: int = Field(6, ge=1, le=100, description="IK solutions of a pose goal to choose from")
    goal_tries: int = Field(40, ge=1, le=1000, description="poses and seeds tried to find them")


def plan(problem: Problem, options: Options, cancel: Cancel) -> Result:
    """Return the straight edge where it is free, else the best of several attempts, to a joint or pose goal."""
    if problem.world.kernel is None:
        return Result(error=NOT_APPLICABLE, message="the planning kernel is not built")
    goals = joint_goals(problem, cancel, wanted=options.goals, tries=options.goal_tries)
    if isinstance(goals, Result):
        return goals
    straight = straight_edge(problem, goals, "rrt_connect")
    return straight or _best(problem, options, cancel, problem.world.kernel, np.array(goals))


def _best(problem: Problem, options: Options, cancel: Cancel, kernel: KernelWorld, goals: Array) -> Result:
    """Return the quickest path of several attempts, or the last failure."""
    best: Array | None = None
    least = np.inf
    attempts: list[PlanAttempt] = []
    enough = (1 + options.good_enough) * min(min_travel_time(problem.start, goal, problem.velocity) for goal in goals)
    for _ in range(problem.attempts):
        began = monotonic()
        seed = int(problem.rng.integers(1, 2**62))
        found = find_path(
            kernel, problem.start, goals, seed=seed, seconds=max(0.0, problem.seconds_left), reach=options.reach,
            shortcuts=options.shortcuts, patience=options.patience, cancel=cancel.word,
        )
        seconds = monotonic() - began
        path = found.waypoints
        if path is None:
            error = cancel.reason(problem) or found.error
            failure = "found no path" if cancel.is_set else _no_path(problem, goals, found)
            attempts.append(PlanAttempt(planner="rrt_connect", seconds=seconds, error=error, message=failure))
        else:
            time = sum(min_travel_time(a, b, problem.velocity) for a, b in pairwise(path))
            message = f"{len(path)} waypoints, {time:.2f} s at least, {found.nodes} nodes"
            attempts.append(PlanAttempt(planner="rrt_connect", seconds=seconds, message=message, fraction=1.0))
            if time < least:
                best, least = path, time
        if cancel.reason(problem) or least <= enough:
            break
    if best is None or cancel.is_set:
        error = "cancelled" if cancel.is_set else attempts[-1].error or "no_path"
        failures = [attempt.message for attempt in attempts if attempt.error]
        message = f"RRT-Connect {failures[-1] if failures else 'ended early'}"
        return Result(error=error, message=message, attempts=attempts)
    return Result(waypoints=best, fraction=1.0, attempts=attempts)


def _no_path(problem: Problem, goals: Array, found: SearchResult) -> str:
    """Return why a search failed: where it got stuck, and what obstructs the straight edge to the nearest goal."""
    constraints = problem.world.constraints
    message = "found no path" + (" that satisfies the constraints" if constraints and constraints.has_bounds else "")
    if found.samples >= _MANY and found.from_start == 1:
        message += "; no motion away from the start is free"
    elif found.samples >= _MANY and found.nodes - found.from_start == len(goals):
        message += "; no motion towards the goal is free"
    return f"{message}; on the straight edge, {problem.world.obstruction(problem.start, goals[0], 0.01).message}"
