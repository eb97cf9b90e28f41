"""A path through joint space by OMPL's sampling planners: for joint goals and for regions about a pose."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from ompl import base as ob
from ompl import geometric as og
from ompl import util as ou
from pydantic import Field

from common.config import Parameters
from common.messages import PlanAttempt
from common.planning.collision import CollisionWorld
from common.planning.goal_sampling import min_travel_time
from common.planning.joint_goals import joint_goals
from common.planning.joint_paths import straight_edge
from common.planning.problem import Cancel, Problem, Result
from common.robot.model import RobotModel
from common.time_source import monotonic

Array = NDArray[np.float64]

ou.setLogLevel(ou.LogLevel.LOG_NONE)  # errors are in the response

# PRM and PRM* are missing: they look for solutions in a thread of their own, which waits for Python forever.
# RRT* and Informed RRT* find no path around a wall within seconds.
# These improve their path until their time is up.
_IMPROVING = ("AORRTC", "BITstar")


class Options(Parameters):
    """Which of OMPL's planners, and how many goals it may choose from."""

    algorithm: Literal[
        "RRTConnect", "RRT", "KPIECE1", "BKPIECE1", "LBKPIECE1", "AORRTC", "BITstar"
    ] = "RRTConnect"
    goals: int = Field(6, ge=1, le=100, description="IK solutions of a pose goal to choose from")
    goal_tries: int = Field(40, ge=1, le=1000, description="poses and seeds tried to find them")
    improving_time: float = Field(
        1.0, gt=0, le=60, description="wall time of an attempt of planners that improve until it is up [s]"
    )


def plan(problem: Problem, options: Options, cancel: Cancel) -> Result:
    """Return the straight edge where it is free, else the best of several attempts, to a joint or pose goal."""
    goals = joint_goals(problem, cancel, wanted=options.goals, tries=options.goal_tries)
    if isinstance(goals, Result):
        return goals
    straight = straight_edge(problem, goals, "ompl")
    return straight or _best(problem, options, cancel, goals)


def _best(problem: Problem, options: Options, cancel: Cancel, goals: Sequence[Array]) -> Result:
    """Return the quickest path of several attempts, or the last failure."""
    best: Array | None = None
    attempts: list[PlanAttempt] = []
    for _ in range(problem.attempts):
        began = monotonic()
        stop = cancel.reason(problem)
        path = None if stop else _attempt(problem, options, cancel, goals)
        stop = stop or cancel.reason(problem)
        if path is None:
            error = stop or "no_path"
            message = f"{options.algorithm} found no path"
            attempts.append(
                PlanAttempt(planner="ompl", seconds=monotonic() - began, error=error, message=message)
            )
        else:
            message = f"{options.algorithm}: {len(path)} waypoints, {_cost(path, problem.velocity):.2f} s at least"
            attempts.append(
                PlanAttempt(planner="ompl", seconds=monotonic() - began, message=message, fraction=1.0)
            )
            if best is None or _cost(path, problem.velocity) < _cost(best, problem.velocity):
                best = path
        if stop:
            break
    if best is None or attempts[-1].error == "cancelled":
        last = attempts[-1]
        return Result(error=last.error, message=last.message, attempts=attempts)
    return Result(waypoints=best, fraction=1.0, attempts=attempts)


def _cost(path: Array, velocity: Array) -> float:
    return sum(min_travel_time(a, b, velocity) for a, b in pairwise(path))


class _EdgeValidator(ob.MotionValidator):  # type: ignore[misc]
    """Checks complete edges in the collision world, which proves them free with few checks."""

    def __init__(self, si: Any, world: CollisionWorld, dof: int, ended: Callable[[], bool]) -> None:
        super().__init__(si)
        self._world = world
        self._dof = dof
        self._ended = ended

    def checkMotion(self, a: Any, b: Any, *rest: Any) -> bool:  # noqa: N802 - OMPL's name
        """Return whether the edge between two states is free; false for all once planning has to end."""
        # OMPL's shortcuts have no time limit: without a free edge they end at once.
        return not self._ended() and self._world.edge_free(np.array(a[0 : self._dof]), np.array(b[0 : self._dof]))


def _space(robot: RobotModel) -> Any:
    space = ob.RealVectorStateSpace(robot.dof)
    bounds = ob.RealVectorBounds(robot.dof)
    for i, (low, high) in enumerate(zip(robot.lower, robot.upper, strict=True)):
        bounds.setLow(i, float(low))
        bounds.setHigh(i, float(high))
    space.setBounds(bounds)
    return space


def _attempt(problem: Problem, options: Options, cancel: Cancel, goals: Sequence[Array]) -> Array | None:
    """Return one shortened solution; all of OMPL's state is created again so that the seed decides it."""
    dof, world = problem.robot.dof, problem.world
    ou.RNG.setSeed(int(problem.rng.integers(1, 2**31 - 1)))
    space = _space(problem.robot)
    setup = og.SimpleSetup(space)
    si = setup.getSpaceInformation()
    setup.setStateValidityChecker(lambda state: not world.collides(np.array(state[0:dof])))
    end = problem.deadline
    if options.algorithm in _IMPROVING:
        end = min(end, monotonic() + options.improving_time)

    def searched_enough() -> bool:
        return cancel.is_set or monotonic() >= end

    validator = _EdgeValidator(si, world, dof, lambda: bool(cancel.reason(problem)))
    si.setMotionValidator(validator)
    setup.setPlanner(getattr(og, options.algorithm)(si))
    start = space.allocState()
    start[0:dof] = problem.start.tolist()
    setup.setStartState(start)
    region = ob.GoalStates(si)
    for goal in goals:
        state = space.allocState()
        state[0:dof] = goal.tolist()
        region.addState(state)
    setup.setGoal(region)
    if setup.solve(ob.PlannerTerminationCondition(searched_enough)).getStatus() != ob.PlannerStatus.EXACT_SOLUTION:
        return None
    path = setup.getSolutionPath()
    simplifier = og.PathSimplifier(si)  # simplifySolution takes several times as long for the same length
    simplifier.reduceVertices(path)
    simplifier.ropeShortcutPath(path)
    return np.array([state[0:dof] for state in path.getStates()])
