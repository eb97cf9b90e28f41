"""A sequence of goals as one path: positions that are quick to pass, joined by any planners, corners rounded off."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from common.config import Parameters
from common.planning.planners import Plan
from common.planning.problem import NOT_APPLICABLE, Arc, Cancel, Problem, Result
from common.planning.resolving import Chain, chains
from common.planning.timing import BLENDS

Array = NDArray[np.float64]

Planners = Mapping[str, tuple[Plan, Parameters]]

LEGS = "legs"
_CHAINS = 3  # to which ways are planned
_SAME = 1e-6  # [rad]
_STRAIGHT = 1e-5  # [rad] so far from a line is on it


class NoOptions(Parameters):
    """There is nothing to set."""


def join_legs(
    problem: Problem, options: Parameters, cancel: Cancel, *, planners: Planners
) -> Result:
    """One path through all goals of a sequence without lines and arcs, or why none was found.

    Args:
        problem: with a sequence goal.
        options: none.
        cancel: ends the search.
        planners: with their options, by their names, in the order in which they are asked for each leg.
    """
    parts = problem.sequence
    if parts is None or any(part.straight or isinstance(part.goal, Arc) for part in parts):
        return Result(error=NOT_APPLICABLE, message="lines and arcs in a sequence need a planner for these")
    found = chains(problem, parts, cancel)
    if isinstance(found, Result):
        return found
    worst = Result(error="no_path", message="no chain of positions can be timed")
    for chain in found[:_CHAINS]:
        result = _joined(problem, chain, planners, cancel)
        if not result.error:
            return result
        worst = result
        if cancel.reason(problem):
            break
    return worst


def _joined(problem: Problem, chain: Chain, planners: Planners, cancel: Cancel) -> Result:
    points, cuts, attempts, by = [chain.positions[0]], [0.0], [], ""
    count = len(chain.positions) - 1
    for number, (a, b) in enumerate(pairwise(chain.positions), 1):
        result = _asked(replace(problem, start=a, goal=b), planners, cancel)
        attempts += result.attempts
        if result.error:
            message = f"item {number} of {count}: {result.message}"
            return replace(result, message=message, fraction=(number - 1) / count, attempts=attempts)
        assert result.waypoints is not None
        way = _corners(result.waypoints)
        by = result.planner if len(way) > 2 or not by else by
        points += list(way[1:])
        cuts += [BLENDS[0]] * (len(way) - 2) + [float(chain.cuts[number])]
    kept = [0] + [i for i in range(1, len(points)) if np.abs(points[i] - points[i - 1]).max() > _SAME]
    if len(kept) == 1:
        kept.append(len(points) - 1)
    return Result(
        waypoints=np.array(points)[kept], cuts=np.array(cuts)[kept], fraction=1.0, planner=by, attempts=attempts)


def _asked(problem: Problem, planners: Planners, cancel: Cancel) -> Result:
    """The waypoints of the first planner that has some, or the failure of that which got furthest."""
    best = Result(error=NOT_APPLICABLE, message="no planner finds ways through joint space")
    for name, (plan, options) in planners.items():
        result = plan(problem, options, cancel)
        if not result.error:
            if result.waypoints is None:
                assert result.trajectory is not None
                result = replace(result, waypoints=result.trajectory.positions)
            return replace(result, planner=name)
        if result.error != NOT_APPLICABLE and (best.error == NOT_APPLICABLE or result.fraction >= best.fraction):
            best = result
    return best


def _corners(way: Array) -> Array:
    """The waypoints (N, dof) [rad] without those that lie on the straight line between their neighbours."""
    kept = [way[0]]
    for here, following in pairwise(way[1:]):
        edge, whole = here - kept[-1], following - kept[-1]
        length = float(whole @ whole)
        if length > _SAME**2 and np.abs(edge - (edge @ whole) / length * whole).max() > _STRAIGHT:
            kept.append(here)
    return np.array([*kept, way[-1]])
