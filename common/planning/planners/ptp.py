"""Point to point as an industrial controller does it: synchronised trapezoidal profiles of all joints."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from common.config import Parameters
from common.planning.joint_goals import blocked_edge, first_success, joint_goals
from common.planning.problem import Cancel, Problem, Result
from common.planning.timing import LIMIT_SHARE
from common.planning.trapezoid import synchronised

Array = NDArray[np.float64]


class Options(Parameters):
    """How hard the joints brake, and how many goals they may choose from."""

    deceleration: float = Field(1.0, gt=0, le=1, description="as a share of the acceleration limits")
    goals: int = Field(4, ge=1, le=100, description="IK solutions of a pose goal to choose from")
    steps: int = Field(40, ge=1, le=10000, description="waypoints by which a collision is named")


def plan(problem: Problem, options: Options, cancel: Cancel) -> Result:
    """A trajectory to the nearest goal to which the straight edge in joint space is free, or what is in the way."""
    goals = joint_goals(problem, cancel, wanted=options.goals)
    if isinstance(goals, Result):
        return goals
    velocity, acceleration = LIMIT_SHARE * problem.velocity, LIMIT_SHARE * problem.acceleration

    def attempt(goal: Array) -> Result:
        hit = blocked_edge(problem, goal, options.steps)
        if hit:
            return hit
        timed = synchronised(problem.start, goal, velocity, acceleration, options.deceleration * acceleration)
        return Result(trajectory=timed, fraction=1.0)

    return first_success(goals, attempt, cancel, problem)
