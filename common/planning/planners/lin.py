"""A straight line of the tool with a trapezoidal profile of its speed, as in an industrial controller."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from pydantic import Field

from common.planning.ik import controls_full_pose
from common.planning.planners import cartesian
from common.planning.problem import NOT_APPLICABLE, Cancel, GoalChoice, Problem, Region, Result, timing_failure
from common.planning.retiming import RetimingFailed
from common.planning.trajectory import TooLong
from common.planning.waypoint_timing import ToolLimits, ToolWaypoints, time_tool_path

Array = NDArray[np.float64]


class Options(ToolLimits):
    """Limits of the tool, and how finely the line is followed."""

    step: float = Field(0.005, gt=0, le=0.2, description="travel of the tool between IK solutions [m]")
    rotation_step: float = Field(0.05, gt=0, le=1, description="turn of the tool between IK solutions [rad]")
    jump_threshold: float = Field(0.35, gt=0, le=3.2, description="a joint that moves more in a step has jumped [rad]")


def plan(problem: Problem, options: Options, cancel: Cancel) -> Result:
    """Return a trajectory along the complete line to a pose goal, or what ends the line."""

    def timed(region: Region) -> Result:
        found = line_waypoints(problem, region, options, cancel)
        if isinstance(found, Result):
            return found
        try:
            return Result(trajectory=time_tool_path(problem, found, options), fraction=1.0)
        except (RetimingFailed, TooLong) as error:
            return timing_failure(error)

    if isinstance(problem.goal, Region):
        return timed(problem.goal)
    if isinstance(problem.goal, GoalChoice) and problem.straight:
        return cartesian.shortest_line(problem, problem.goal, timed)
    return Result(error=NOT_APPLICABLE, message="a straight line of the tool needs a pose goal")


def line_waypoints(problem: Problem, goal: Region, options: Options, cancel: Cancel) -> ToolWaypoints | Result:
    """Return evenly spaced waypoints of the line, or what ends it."""
    following = cartesian.Options(
        step=options.step, rotation_step=options.rotation_step, jump_threshold=options.jump_threshold, min_fraction=1.0
    )
    result = cartesian.plan(replace(problem, goal=goal), following, cancel)
    if result.waypoints is None:
        return result
    T_end = goal.T_world_tcp if controls_full_pose(problem.robot) else problem.robot.fk(result.waypoints[-1])
    shares = np.linspace(0, 1, len(result.waypoints))[:, None]
    return ToolWaypoints(result.waypoints, shares * line_travel(problem.robot.fk(problem.start), T_end))


def line_travel(T_from: Array, T_to: Array) -> Array:
    """Return (2,) distance [m] and turn [rad] between two poses (4, 4)."""
    turn = pin.log3(T_from[:3, :3].T @ T_to[:3, :3])
    return np.array([math.dist(T_from[:3, 3], T_to[:3, 3]), float(np.linalg.norm(turn))])
