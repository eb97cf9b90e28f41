"""Point to point in joint space along the straight edge, with limited jerk: for joint goals whose way is free."""

from __future__ import annotations

import numpy as np
import ruckig
from numpy.typing import NDArray

from common.config import Parameters
from common.planning.problem import NOT_APPLICABLE, Cancel, Problem, Result
from common.planning.retiming import TimedPath

Array = NDArray[np.float64]

_MARGIN = 0.98  # of the limits
_SHORTEST = 1e-6  # [s] between two states


class Options(Parameters):
    """Joint moves have no options."""


def plan(problem: Problem, options: Options, cancel: Cancel) -> Result:
    """A trajectory along the straight edge to a joint goal, or what stands in its way.

    All joints move in proportion, so one profile along the edge (ruckig, state to state) times them all, and the states
    at its phases' ends give cubics between them exactly.
    """
    if not isinstance(problem.goal, np.ndarray) or problem.straight:
        return Result(error=NOT_APPLICABLE, message="joint moves need a joint goal and no straight line of the tool")
    if not problem.world.edge_free(problem.start, problem.goal):
        found = problem.world.obstruction(problem.start, problem.goal, 0.005)
        return Result(error=found.error, message=found.message, colliding=found.colliding)
    trajectory = straight_profile(problem.start, problem.goal, problem.velocity, problem.acceleration, problem.jerk)
    return Result(trajectory=trajectory, fraction=1.0)


def straight_profile(start: Array, goal: Array, velocity: Array, acceleration: Array, jerk: Array) -> TimedPath:
    """The fastest jerk-limited trajectory along the straight edge between two positions (dof,) [rad].

    Raises:
        ValueError: ruckig finds no profile, which only limits that are not positive bring about.
    """
    span = goal - start
    moving = np.abs(span) > 1e-9
    if not moving.any():
        still = np.zeros((2, len(start)))
        return TimedPath(np.array([0.0, 0.01]), np.array([start, start]), still, still)
    # The share s of the edge moves with limits at which the first joint meets its own.
    share = [_MARGIN * float((limit[moving] / np.abs(span[moving])).min()) for limit in (velocity, acceleration, jerk)]
    given = ruckig.InputParameter(1)
    given.current_position, given.target_position = [0.0], [1.0]
    given.max_velocity, given.max_acceleration, given.max_jerk = [share[0]], [share[1]], [share[2]]
    found = ruckig.Trajectory(1)
    outcome = ruckig.Ruckig(1).calculate(given, found)
    if outcome != ruckig.Result.Working:
        raise ValueError(f"ruckig finds no profile: {outcome}")
    phases = np.cumsum(found.profiles[0][0].t)
    times = [0.0]
    for time in [*phases, found.duration]:
        if times[-1] + _SHORTEST < time <= found.duration:
            times.append(float(time))
    states = np.array([[value[0] for value in found.at_time(time)[:3]] for time in times])
    states[0], states[-1] = (0, 0, 0), (1, 0, 0)
    s, ds, dds = (column[:, None] for column in states.T)
    return TimedPath(np.array(times), start + s * span, ds * span, dds * span)
