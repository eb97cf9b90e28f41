"""A straight line of the TCP: IK at every centimetre from the step before, each step checked for collision."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from pydantic import Field

from common.config import Parameters
from common.planning.problem import NOT_APPLICABLE, Cancel, Problem, Region, Result
from common.robot.ik import converge

Array = NDArray[np.float64]

_SAME = 1e-5  # [m], [rad] a goal this close to the start needs no motion


class Options(Parameters):
    """How finely the line is followed and how much of it must be possible."""

    step: float = Field(0.01, gt=0, le=0.2, description="way of the TCP between IK solutions [m]")
    rotation_step: float = Field(0.1, gt=0, le=1, description="turn of the TCP between IK solutions [rad]")
    min_fraction: float = Field(0.95, gt=0, le=1, description="of the line that must be possible")
    goal_tolerance: float = Field(0.002, gt=0, le=0.1, description="a shortened line ends this close to its goal [m]")
    jump_threshold: float = Field(0.35, gt=0, le=3.2, description="a joint that moves more in a step has jumped [rad]")


def plan(problem: Problem, options: Options, cancel: Cancel) -> Result:
    """The joint path of a straight line to a pose goal, or how far the line goes and what ends it.

    Position moves linearly and orientation along the shortest turn, together.
    """
    if not isinstance(problem.goal, Region):
        return Result(error=NOT_APPLICABLE, message="a straight line needs a pose goal")
    robot = problem.robot
    T_start, T_goal = pin.SE3(robot.fk(problem.start)), pin.SE3(problem.goal.T_world_tcp)
    way = T_goal.translation - T_start.translation
    turn = pin.log3(T_start.rotation.T @ T_goal.rotation)
    distance, angle = float(np.linalg.norm(way)), float(np.linalg.norm(turn))
    if distance < _SAME and angle < _SAME:
        return Result(waypoints=np.array([problem.start, problem.start]), dense=True, tool_line=True, fraction=1.0)
    count = max(1, math.ceil(distance / options.step - 1e-6), math.ceil(angle / options.rotation_step - 1e-6))
    path, motion = [problem.start], np.zeros(robot.dof)
    failure: Result | None = None
    for i in range(1, count + 1):
        share = i / count
        target = pin.SE3(T_start.rotation @ pin.exp3(share * turn), T_start.translation + share * way)
        following = _step(problem, options, cancel, path[-1], motion, target, i)
        if isinstance(following, Result):
            failure = following
            break
        motion = following - path[-1]
        path.append(following)
    fraction = (len(path) - 1) / count
    left = (1 - fraction) * max(distance, angle * options.goal_tolerance)
    if failure and (fraction < options.min_fraction or left > options.goal_tolerance):
        message = f"waypoint {failure.waypoint} of {count}: {failure.message} (fraction {fraction:.2f})"
        return replace(failure, fraction=fraction, message=message)
    return Result(waypoints=np.array(path), dense=True, tool_line=True, fraction=fraction)


def _step(
    problem: Problem, options: Options, cancel: Cancel, q: Array, motion: Array, target: pin.SE3, i: int
) -> Array | Result:
    """The next position (dof,) [rad], or why there is none."""
    stop = cancel.reason(problem)
    if stop:
        return Result(error=stop, message="planning was ended", waypoint=i)
    robot = problem.robot
    # The step before, once more, is the best guess: one iteration less on a line.
    following = converge(robot, target, q + motion, 10)
    if following is None:
        following = converge(robot, target, q, 30)
    if following is None:
        return Result(error="no_ik", message="the arm does not reach it without leaving its joint limits", waypoint=i)
    jump = np.abs(following - q)
    if float(jump.max()) > options.jump_threshold:
        joint = int(np.argmax(jump))
        return Result(error="joint_jump", message=f"{robot.joint_names[joint]} jumps {jump[joint]:.2f} rad", waypoint=i)
    if not problem.world.edge_free(q, following):
        hit = problem.world.edge_collision(q, following, 0.002)
        pair = hit.pair if hit else ("robot", "scene")
        return Result(error="collision", message=f"{pair[0]} collides with {pair[1]}", waypoint=i, colliding=pair)
    return following
