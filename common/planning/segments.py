"""A sequence of goals as one path: joint positions that are quick to pass, segments by any planner, round corners."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from common.config import Parameters
from common.planning.joint_goals import JointChain, joint_chains
from common.planning.planners import Plan
from common.planning.problem import NOT_APPLICABLE, Arc, Cancel, Problem, Result
from common.planning.waypoint_timing import BLENDS

Array = NDArray[np.float64]

Planners = Mapping[str, tuple[Plan, Parameters]]

SEGMENTS = "legs"  # name in a response, as clients know it
_MAX_CHAINS = 3  # through which paths are planned
_SAME = 1e-6  # [rad]
_STRAIGHT = 1e-5  # [rad] a waypoint this close to a line is on it


class NoOptions(Parameters):
    """No options."""


def join_segments(problem: Problem, options: Parameters, cancel: Cancel, *, planners: Planners) -> Result:
    """Return one path through all goals of a sequence without lines and arcs, or why none was found.

    Args:
        problem: with a sequence goal.
        options: none.
        cancel: ends the search.
        planners: with their options, by name, in the order in which they are tried for each segment.
    """
    items = problem.sequence
    if items is None or any(item.straight or isinstance(item.goal, Arc) for item in items):
        return Result(error=NOT_APPLICABLE, message="lines and arcs in a sequence need a planner for these")
    found = joint_chains(problem, items, cancel)
    if isinstance(found, Result):
        return found
    worst = Result(error="no_path", message="no chain of joint positions can be timed")
    for chain in found[:_MAX_CHAINS]:
        result = _joined(problem, chain, planners, cancel)
        if not result.error:
            return result
        worst = result
        if cancel.reason(problem):
            break
    return worst


def _joined(problem: Problem, chain: JointChain, planners: Planners, cancel: Cancel) -> Result:
    """Return the path through a chain of joint positions, or the failure of its first segment without a path."""
    points, cuts, attempts, planner = [chain.positions[0]], [0.0], [], ""
    count = len(chain.positions) - 1
    for number, (a, b) in enumerate(pairwise(chain.positions), 1):
        result = _plan_segment(replace(problem, start=a, goal=b), planners, cancel)
        attempts += result.attempts
        if result.error:
            message = f"item {number} of {count}: {result.message}"
            return replace(result, message=message, fraction=(number - 1) / count, attempts=attempts)
        assert result.waypoints is not None
        path = _corners(result.waypoints)
        planner = result.planner if len(path) > 2 or not planner else planner
        points += list(path[1:])
        cuts += [BLENDS[0]] * (len(path) - 2) + [float(chain.cuts[number])]
    distinct = [0] + [i for i in range(1, len(points)) if np.abs(points[i] - points[i - 1]).max() > _SAME]
    if len(distinct) == 1:
        distinct.append(len(points) - 1)
    return Result(waypoints=np.array(points)[distinct], cuts=np.array(cuts)[distinct], fraction=1.0, planner=planner,
                  attempts=attempts)


def _plan_segment(problem: Problem, planners: Planners, cancel: Cancel) -> Result:
    """Return the waypoints of the first planner that succeeds, or the failure that got furthest."""
    best = Result(error=NOT_APPLICABLE, message="no planner of the pipeline finds paths through joint space")
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


def _corners(path: Array) -> Array:
    """Return the waypoints (N, dof) [rad] without those on the straight line between their neighbours."""
    corners = [path[0]]
    for here, following in pairwise(path[1:]):
        edge, span = here - corners[-1], following - corners[-1]
        length = float(span @ span)
        if length > _SAME**2 and np.abs(edge - (edge @ span) / length * span).max() > _STRAIGHT:
            corners.append(here)
    return np.array([*corners, path[-1]])
