"""A circular arc of the tool, with a trapezoidal profile of its speed along the arc."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from common.planning.arcs import NoArc, arc_poses, circle_about, circle_through
from common.planning.planners import cartesian, lin
from common.planning.problem import NOT_APPLICABLE, Arc, Cancel, Problem, Result, ToolPath, too_fine
from common.planning.timing import ToolWaypoints, follow_in_time

Array = NDArray[np.float64]

_BOW = 0.001  # [m] that the tool may leave the arc between two IK solutions


class Options(lin.Options):
    """Limits of the tool, and how finely the arc is followed."""


def plan(problem: Problem, options: Options, cancel: Cancel) -> Result:
    """A trajectory along the whole arc, or what ends it."""
    if not isinstance(problem.goal, Arc):
        return Result(error=NOT_APPLICABLE, message="a circular arc needs an arc goal")
    found = arc_waypoints(problem, problem.goal, options, cancel)
    if isinstance(found, Result):
        return found
    return Result(trajectory=follow_in_time(problem, found, options), fraction=1.0)


def arc_waypoints(problem: Problem, arc: Arc, options: Options, cancel: Cancel) -> ToolWaypoints | Result:
    """Evenly spaced waypoints of the arc, or what ends it."""
    T_start, T_goal = problem.robot.fk(problem.start), arc.T_world_tcp
    start, goal = T_start[:3, 3], T_goal[:3, 3]
    try:
        if arc.via is not None:
            circle = circle_through(start, arc.via, goal)
        else:
            assert arc.center is not None  # the message makes sure of one of them
            circle = circle_about(start, arc.center, goal)
    except NoArc as error:
        return Result(error="bad_goal", message=f"no arc: {error}")
    if refusal := too_fine(circle.length / options.step):
        return refusal
    poses = arc_poses(circle, T_start, T_goal, options.step, options.rotation_step)
    following = cartesian.Options(
        step=0.2,  # the poses are as close together as they should be
        rotation_step=1.0,
        jump_threshold=options.jump_threshold,
        path_tolerance=_BOW,
        min_fraction=1.0,
    )
    result = cartesian.plan(replace(problem, goal=ToolPath(poses)), following, cancel)
    if result.waypoints is None:
        return result
    turn = lin.line_ways(T_start, T_goal)[1]
    ways = np.linspace(0, 1, len(poses))[:, None] * np.array([circle.length, turn])
    return ToolWaypoints(result.waypoints, ways)
