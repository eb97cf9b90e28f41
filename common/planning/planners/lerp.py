"""A straight line through joint space in even steps: predictable and fast to compute."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from common.config import Parameters
from common.planning.joint_goals import joint_goals
from common.planning.joint_paths import blocked_edge, first_success, line
from common.planning.problem import Cancel, Problem, Result

Array = NDArray[np.float64]


class Options(Parameters):
    """How finely the line is divided, and how many goals it may choose from."""

    steps: int = Field(40, ge=1, le=10000, description="edges between the waypoints")
    goals: int = Field(4, ge=1, le=100, description="IK solutions of a pose goal to choose from")


def plan(problem: Problem, options: Options, cancel: Cancel) -> Result:
    """Return evenly spaced waypoints from the start to the first goal to which the line is free.

    A failure names the waypoint of the collision; of several goals, on the line that gets furthest.
    """
    goals = joint_goals(problem, cancel, wanted=options.goals)
    if isinstance(goals, Result):
        return goals

    def attempt(goal: Array) -> Result:
        hit = blocked_edge(problem, goal, options.steps)
        return hit or Result(waypoints=line(problem.start, goal, options.steps), dense=True, fraction=1.0)

    return first_success(goals, attempt, cancel, problem)
