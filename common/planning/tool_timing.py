"""Timing of paths along which the tool itself has limits: trapezoidal profiles, slower where joint limits bind."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from common.config import Parameters
from common.planning.path import dense_path
from common.planning.problem import Problem
from common.planning.retiming import TimedPath, parametrise
from common.planning.timing import LIMIT_SHARE

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ToolWaypoints:
    """Waypoints (N, dof) [rad] that lie close together, and the ways of the tool up to each.

    `ways` (N, 2) are way [m] and turn [rad] from the first; constant where the tool's own limits do not hold.
    """

    positions: Array
    ways: Array


class ToolLimits(Parameters):
    """Limits of the tool; a request scales them as it scales those of the joints.

    Rotation gains and loses speed in the same proportion: in as long as the tool takes to its speed and to rest.
    """

    speed: float = Field(1.0, gt=0, le=10, description="of the tool [m/s]")
    acceleration: float = Field(2.25, gt=0, le=100, description="of the tool [m/s^2]")
    deceleration: float = Field(5.0, gt=0, le=100, description="of the tool [m/s^2]")
    rotation_speed: float = Field(1.57, gt=0, le=10, description="of the tool [rad/s]")


def follow_in_time(problem: Problem, path: ToolWaypoints, limits: ToolLimits) -> TimedPath:
    """The fastest trajectory through waypoints that lie close together, from rest to rest.

    The ways of the tool are retimed as two more joints with limits of their own. Where the tool's limits are the lower
    ones the way or the turn has a trapezoidal profile; where a joint's are, it is slowed down just there.

    Args:
        problem: the joint limits, already scaled.
        path: waypoints and ways.
        limits: of the tool.

    Raises:
        RetimingFailed: the path can not be followed.
    """
    robot = problem.robot
    scale_v = float((problem.velocity / robot.velocity).max())
    scale_a = float((problem.acceleration / robot.acceleration).max())
    turning = limits.rotation_speed / limits.speed
    tool_v = scale_v * np.array([limits.speed, limits.rotation_speed])
    tool_a = scale_a * limits.acceleration * np.array([1.0, turning])
    tool_b = scale_a * limits.deceleration * np.array([1.0, turning])
    velocity, acceleration = LIMIT_SHARE * problem.velocity, LIMIT_SHARE * problem.acceleration
    waypoints = path.positions
    if np.abs(waypoints - waypoints[0]).max() < 1e-9:
        rest = np.zeros((2, robot.dof))
        return TimedPath(np.array([0.0, 0.01]), np.array([waypoints[0], waypoints[0]]), rest, rest)
    timed = parametrise(
        dense_path(np.hstack([waypoints, path.ways])),
        np.concatenate([velocity, tool_v]),
        np.concatenate([acceleration, tool_a]),
        braking=np.concatenate([acceleration, tool_b]),
    )
    dof = robot.dof
    return TimedPath(timed.times, timed.positions[:, :dof], timed.velocities[:, :dof], timed.accelerations[:, :dof])
