"""From a planner's waypoints to a trajectory: smoothed where that is free of collision, then timed."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from common.config import Parameters
from common.planning.collision import CollisionWorld
from common.planning.path import SmoothPath, blended_path, dense_path, distinct
from common.planning.problem import Problem, Result
from common.planning.retiming import RetimingFailed, limited_jerk, parametrise
from common.planning.trajectory import TimedPath, at_rest, join, moving_samples, stretch
from common.robot.model import RobotModel

Array = NDArray[np.float64]

LIMIT_SHARE = 0.985  # of the limits: between two states the controller's cubic may exceed them a little
# [rad] taken from both edges at a corner, where that is free. A blend that barely misses an obstacle may be found free
# here and not by validation, which checks other positions: then smaller blends are tried, and none in the end.
BLENDS = (0.25, 0.06, 0.0)
_PEAK_STEP = 0.005  # [rad] between positions at which the tool's speed is computed; it peaks between them, so
_BELOW = 0.999  # of the computed speed is allowed
_BLEND_STEP = 0.003  # [rad] step that checks blends without the kernel
_SMALLEST_BLEND = 0.02  # [rad] below it the robot stops at the corner


def retime(problem: Problem, result: Result, blend: float = BLENDS[0], tool_speed: float = math.inf) -> TimedPath:
    """Return the time-optimal trajectory of a planner's path, at rest at both ends, its jerk limited.

    Args:
        problem: limits and the collision world.
        result: a planner's waypoints.
        blend: length [rad] taken at most from both edges at a corner of a path that is not dense.
        tool_speed: limit of the TCP [m/s], which it may exceed slightly between states.

    Raises:
        RetimingFailed: the path cannot be followed.
    """
    assert result.waypoints is not None
    waypoints = distinct(result.waypoints)
    if len(waypoints) == 1:  # the robot is there already
        return at_rest(waypoints[0])
    velocity, acceleration = LIMIT_SHARE * problem.velocity, LIMIT_SHARE * problem.acceleration
    deadline = problem.latest
    if (travel := result.tool_travel) is not None:
        if not np.abs(np.diff(result.waypoints, axis=0)).max(axis=1).all():
            raise RetimingFailed("two waypoints are the same: the steps are finer than IK resolves joint positions")
        paths = blended_path(result.waypoints, travel.cuts, travel.lengths)
        speed = min(travel.speed or math.inf, tool_speed)
        parts = [parametrise(path, velocity, acceleration, speed=speed, deadline=deadline) for path in paths]
        return limited_jerk(join(parts), problem.jerk)
    most_cut = blend if result.cuts is None else result.cuts * (blend / BLENDS[0])
    paths = [dense_path(waypoints)] if result.dense else _free_blends(waypoints, problem.world, most_cut)
    most = math.inf if math.isinf(tool_speed) else partial(_path_speeds, problem.robot, tool_speed)
    parts = [parametrise(path, velocity, acceleration, speed=most, deadline=deadline) for path in paths]
    return limited_jerk(join(parts), problem.jerk)


def _path_speeds(robot: RobotModel, tool_speed: float, path: SmoothPath) -> Array:
    """Return (P + 1,) ds/dt at which the TCP moves with a speed [m/s] where the pieces of a path meet."""
    slopes = np.concatenate([path.d0, path.d1[-1:]])
    places = np.concatenate([path.starts, path.end[None, :]])
    return tool_speed / np.maximum([robot.tool_speed(q, dq) for q, dq in zip(places, slopes, strict=True)], 1e-9)


def limit_tool_speed(robot: RobotModel, trajectory: TimedPath, tool_speed: float) -> TimedPath:
    """Return the trajectory stretched in time so that the TCP never moves faster than a speed [m/s]."""
    if math.isinf(tool_speed):
        return trajectory
    peak = max(robot.tool_speed(q, dq) for q, dq in zip(*moving_samples(trajectory, _PEAK_STEP), strict=True))
    return trajectory if peak <= tool_speed else stretch(trajectory, _BELOW * tool_speed / peak)


def _free_blends(waypoints: Array, world: CollisionWorld, blend: float | Array) -> list[SmoothPath]:
    """Return blended paths with free corners: a blend that collides is halved until the robot stops at the corner."""
    blends = np.array(np.broadcast_to(blend, len(waypoints)))
    for i in range(1, len(waypoints) - 1):
        a, b, c = waypoints[i - 1 : i + 2]
        half = 0.5 * min(float(np.linalg.norm(b - a)), float(np.linalg.norm(c - b)))
        blends[i] = min(blends[i], half)
        while blends[i] > 0:
            corner = blended_path(np.array([a, b, c]), np.array([0.0, blends[i], 0.0]))
            if len(corner) > 1 or world.blends_free(corner[0], _BLEND_STEP):
                break
            blends[i] = blends[i] / 2 if blends[i] / 2 >= _SMALLEST_BLEND else 0.0
    return blended_path(waypoints, blends)


@dataclass(frozen=True)
class ToolWaypoints:
    """Waypoints (N, dof) [rad] that lie close together, and the tool's travel up to each.

    `travel` (N, 2) is the path length [m] and the turn [rad] from the first; constant where the tool's own limits do
    not apply.
    """

    positions: Array
    travel: Array


class ToolLimits(Parameters):
    """Limits of the tool; a request scales them as it scales those of the joints.

    Rotation accelerates and brakes in the same proportion: in the time that the tool takes to its speed and to rest.
    """

    speed: float = Field(1.0, gt=0, le=10, description="of the tool [m/s]")
    acceleration: float = Field(2.25, gt=0, le=100, description="of the tool [m/s^2]")
    deceleration: float = Field(5.0, gt=0, le=100, description="of the tool [m/s^2]")
    rotation_speed: float = Field(1.57, gt=0, le=10, description="of the tool [rad/s]")


def time_tool_path(problem: Problem, path: ToolWaypoints, limits: ToolLimits) -> TimedPath:
    """Return the fastest trajectory through waypoints that lie close together, from rest to rest.

    The tool's travel and turn are retimed as two more joints with limits of their own. Where the tool's limits are
    the lower ones, its speed has a trapezoidal profile; where a joint's limits are lower, it is slower just there.

    Args:
        problem: the joint limits, already scaled.
        path: waypoints and travel.
        limits: of the tool.

    Raises:
        RetimingFailed: the path cannot be followed.
    """
    robot = problem.robot
    scale_v = float((problem.velocity / robot.velocity).max())
    scale_a = float((problem.acceleration / robot.acceleration).max())
    turning = limits.rotation_speed / limits.speed
    tool_v = scale_v * np.array([limits.speed, limits.rotation_speed])
    if problem.tool_speed < tool_v[0]:
        tool_v *= problem.tool_speed / tool_v[0]
    tool_a = scale_a * limits.acceleration * np.array([1.0, turning])
    tool_b = scale_a * limits.deceleration * np.array([1.0, turning])
    velocity, acceleration = LIMIT_SHARE * problem.velocity, LIMIT_SHARE * problem.acceleration
    waypoints = path.positions
    if np.abs(waypoints - waypoints[0]).max() < 1e-9:
        return at_rest(waypoints[0])
    timed = parametrise(
        dense_path(np.hstack([waypoints, path.travel])),
        np.concatenate([velocity, tool_v]),
        np.concatenate([acceleration, tool_a]),
        braking=np.concatenate([acceleration, tool_b]),
        deadline=problem.latest,
    )
    dof = robot.dof
    return TimedPath(timed.times, timed.positions[:, :dof], timed.velocities[:, :dof], timed.accelerations[:, :dof])
