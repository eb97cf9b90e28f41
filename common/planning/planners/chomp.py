"""Covariant gradient descent: a smooth path pushed away from obstacles, after CHOMP.

Ratliff, Zucker, Bagnell, Srinivasa: "CHOMP: Gradient Optimization Techniques for Efficient Motion Planning" (ICRA
2009). It finds a path near its first guess or none, so it tries a few guesses.

Differences from the paper:

- Distances are those between convex hulls, to the nearest obstacle of each link, instead of a distance field and
  spheres; links of the robot push each other apart in the same way.
- The cost of obstacles is summed over waypoints, not integrated over the path of each point: its gradient has neither
  the speed of the point as a factor, nor the projection across the path, nor the curvature term.
- Smoothness is the squared accelerations alone. Joint limits clip an update instead of bending the complete path, and
  no joint moves by more than 0.1 rad in an iteration.
- The first guess is a quintic instead of a straight line. The descent ends as soon as the complete path is free, by the
  same check as for every other planner, or after its iterations: the path is free, not optimal.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from common.config import Parameters
from common.planning.joint_goals import joint_goals
from common.planning.joint_paths import check_path, evenly_spaced, first_success, quintic, with_restarts
from common.planning.problem import Cancel, Problem, Result
from common.planning.proximity import NearPairs, Proximity

Array = NDArray[np.float64]

_OWN_CLEARANCE = 0.03  # [m] between links of the robot, which are always close to each other somewhere
_CHECK_EVERY = 5  # iterations, once the waypoints alone are free
_LARGEST_UPDATE = 0.1  # [rad] of a joint in one iteration


class Options(Parameters):
    """Weights and limits of the descent."""

    iterations: int = Field(200, ge=1, le=10000, description="limit of iterations")
    smoothness: float = Field(0.1, ge=0, le=1000, description="weight of the squared accelerations")
    obstacle: float = Field(1.0, gt=0, le=1000, description="weight of proximity to obstacles")
    learning_rate: float = Field(0.01, gt=0, le=10, description="share of the covariant gradient in a step")
    clearance: float = Field(0.2, gt=0, le=1, description="distance within which obstacles push [m]")
    waypoints: int = Field(30, ge=5, le=200, description="of the path that is optimised")
    restarts: int = Field(2, ge=0, le=100, description="other first guesses, tried when the straight edge fails")
    goals: int = Field(4, ge=1, le=100, description="IK solutions of a pose goal to choose from")


def plan(problem: Problem, options: Options, cancel: Cancel) -> Result:
    """Return a path that the descent made free of collision, or what still collides after its iterations."""
    goals = joint_goals(problem, cancel, wanted=options.goals)
    if isinstance(goals, Result):
        return goals
    own = min(_OWN_CLEARANCE, options.clearance)
    proximity = Proximity(problem.world, options.clearance, own_reach=own, nearest=True)

    def attempt(goal: Array) -> Result:
        path = quintic(problem.start, goal, options.waypoints)
        if problem.world.edge_free(problem.start, goal):  # nothing is smoother
            return Result(waypoints=evenly_spaced(path), dense=True, fraction=1.0)
        from_guess = partial(_descend, problem, options, proximity, cancel)
        return with_restarts(problem, path, options.restarts, from_guess)

    return first_success(goals, attempt, cancel, problem)


def _descend(problem: Problem, options: Options, proximity: Proximity, cancel: Cancel, guess: Array) -> Result:
    """Return the path that the descent makes of a first guess (N, dof) [rad], or its collision."""
    path = guess.copy()
    A = accelerations(len(path))
    inverse = np.linalg.inv(A[1:-1, 1:-1])
    scale = float(inverse.max())  # so that a learning rate means the same for any number of waypoints
    lower, upper = problem.robot.lower, problem.robot.upper
    proximity.forget()
    failure = Result(error="collision", message="")
    next_check = 0
    for iteration in range(options.iterations + 1):
        stop = cancel.reason(problem)
        if stop:
            return Result(error=stop, message=f"planning ended after {iteration} iterations")
        near = proximity.measure(path)
        last = iteration == options.iterations
        if last or (iteration >= next_check and (near.distance > 0).all()):
            next_check = iteration + _CHECK_EVERY
            even = evenly_spaced(path)
            hit = check_path(problem, even)
            if hit is None:
                return Result(waypoints=even, dense=True, fraction=1.0)
            failure = hit
        if last:
            break
        smooth = options.smoothness * (A @ path)[1:-1] * scale
        pushed = options.obstacle * obstacle_gradient(near, len(path))[1:-1]
        update = -options.learning_rate * (inverse / scale) @ (smooth + pushed)
        largest = np.abs(update).max(axis=0)
        update *= np.minimum(1.0, _LARGEST_UPDATE / np.maximum(largest, 1e-12))
        path[1:-1] = np.clip(path[1:-1] + update, lower, upper)
    message = f"{failure.message} after {options.iterations} iterations"
    return replace(failure, message=message)


def accelerations(count: int) -> Array:
    """Return (count, count) A with path^T A path = the sum of squared accelerations of a path at rest at its ends."""
    K = np.zeros((count, count))
    for i in range(count):
        K[i, i] -= 2
        K[i, max(i - 1, 0)] += 1
        K[i, min(i + 1, count - 1)] += 1
    return np.asarray(K.T @ K)


def obstacle_gradient(near: NearPairs, count: int) -> Array:
    """Return (count, dof) the gradient of the sum over waypoints of each pair's cost (3) of the paper.

    -d + e/2 within an obstacle, (d - e)^2 / 2e within the clearance e about it.
    """
    slope = np.where(near.distance < 0, -1.0, (near.distance - near.reach) / near.reach)
    gradient = np.zeros((count, near.gradient.shape[1]))
    np.add.at(gradient, near.position, slope[:, None] * near.gradient)
    return gradient
