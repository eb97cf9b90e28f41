"""Point to point along the straight edge in joint space, with limited jerk: for joint goals whose edge is free."""

from __future__ import annotations

import numpy as np
import ruckig
from numpy.typing import NDArray

from common.config import Parameters
from common.planning.problem import NOT_APPLICABLE, Cancel, Problem, Result
from common.planning.trajectory import TimedPath, at_rest

Array = NDArray[np.float64]

_MARGIN = 0.98  # of the limits
_SHORTEST = 1e-6  # [s] between two states


class Options(Parameters):
    """Joint moves have no options."""


def plan(problem: Problem, options: Options, cancel: Cancel) -> Result:
    """Return a trajectory along the straight edge to a joint goal, or what obstructs it.

    All joints move in proportion, so one profile along the edge (ruckig, state to state) times them all. The states at
    the ends of its phases are joined by exact cubics.
    """
    if not isinstance(problem.goal, np.ndarray) or problem.straight:
        return Result(error=NOT_APPLICABLE, message="joint moves need a joint goal and no straight line of the tool")
    if not problem.world.edge_free(problem.start, problem.goal):
        found = problem.world.obstruction(problem.start, problem.goal, 0.005)
        return Result(error=found.error, message=found.message, colliding=found.colliding)
    trajectory = straight_profile(problem.start, problem.goal, problem.velocity, problem.acceleration, problem.jerk)
    return Result(trajectory=trajectory, fraction=1.0)


def straight_profile(start: Array, goal: Array, velocity: Array, acceleration: Array, jerk: Array) -> TimedPath:
    """Return the fastest jerk-limited trajectory along the straight edge between two positions (dof,) [rad].

    Raises:
        ValueError: ruckig finds no profile, which only limits that are not positive cause.
    """
    span = goal - start
    moving = np.abs(span) > 1e-9
    if not moving.any():
        return at_rest(start)
    # The limits of the share s of the edge are those at which the first joint reaches its own.
    share = [_MARGIN * float((limit[moving] / np.abs(span[moving])).min()) for limit in (velocity, acceleration, jerk)]
    profile = ruckig.InputParameter(1)
    profile.current_position, profile.target_position = [0.0], [1.0]
    profile.max_velocity, profile.max_acceleration, profile.max_jerk = [share[0]], [share[1]], [share[2]]
    found = ruckig.Trajectory(1)
    outcome = ruckig.Ruckig(1).calculate(profile, found)
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
