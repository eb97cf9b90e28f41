"""Straight lines of the TCP: IK in small steps, each from the one before and checked for collision."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from pydantic import Field

from common.config import Parameters
from common.planning.goal_sampling import nearest_pose_in, tilt_and_yaw_from
from common.planning.ik import controls_full_pose, converge, converge_to_region
from common.planning.joint_goals import no_goal_reachable
from common.planning.path import smoothed
from common.planning.problem import (
    NOT_APPLICABLE,
    Cancel,
    GoalChoice,
    Problem,
    Region,
    Result,
    ToolPath,
    ToolTravel,
    check_step_count,
)
from common.robot.model import RobotModel
from common.robot.transforms import transform

Array = NDArray[np.float64]

_SAME = 1e-5  # [m], [rad] a goal this close to the start needs no motion
_LENGTH_PER_TURN = 0.1  # [m/rad] a turn counts as this much travel
_SHARP = 0.5  # [rad] a corner of the path that is intended; a smaller turn may be smoothed
_SMOOTHED = 0.65  # of the tolerance; the rest is for rounding off
_SINGULAR = 0.03  # smallest singular value of the Jacobian [m, rad per rad] near a singularity


class Options(Parameters):
    """How finely lines are followed, and how much of them must be possible."""

    step: float = Field(0.01, gt=0, le=0.2, description="travel of the TCP between IK solutions [m]")
    rotation_step: float = Field(0.1, gt=0, le=1, description="turn of the TCP between IK solutions [rad]")
    min_fraction: float = Field(0.95, gt=0, le=1, description="of the line that must be possible")
    goal_tolerance: float = Field(0.002, gt=0, le=0.1, description="a shortened line ends this close to its goal [m]")
    jump_threshold: float = Field(0.35, gt=0, le=3.2, description="a joint that moves more in a step has jumped [rad]")
    path_tolerance: float = Field(
        9e-5, gt=2e-5, le=0.05, description="largest deviation by smoothing and rounding a path of several lines [m]"
    )


@dataclass(frozen=True)
class _Target:
    """A pose for the TCP, `length` [m] of travel after the one before; its turn alone counts as `turned` [m].

    `region` bounds the pose for an arm that cannot choose all of it.
    """

    pose: pin.SE3
    length: float
    turned: float
    point: int  # of the path that it leads to
    region: Region | None = None


def plan(problem: Problem, options: Options, cancel: Cancel) -> Result:
    """Return the joint path of straight lines through the poses of the goal, or how far they go and what ends them.

    Position moves linearly and orientation by the shortest turn, together. A path of several lines stays within
    `path_tolerance` of them.
    """
    goal = problem.goal
    if isinstance(goal, Region):
        return _line(problem, goal, options, cancel)
    if isinstance(goal, ToolPath):
        return _path(problem, goal, options, cancel)
    if isinstance(goal, GoalChoice) and problem.straight:
        return shortest_line(problem, goal, lambda region: _line(problem, region, options, cancel))
    return Result(error=NOT_APPLICABLE, message="a straight line needs a pose goal")


def shortest_line(problem: Problem, choice: GoalChoice, follow: Callable[[Region], Result]) -> Result:
    """Return the shortest line to one of several goals that can be followed to its end, or why none can."""
    T_start = pin.SE3(problem.robot.fk(problem.start))

    def travel(region: Region) -> float:
        distance, angle = _distance(T_start, pin.SE3(region.T_world_tcp))
        return distance + _LENGTH_PER_TURN * angle

    regions = {number: goal for number, goal in enumerate(choice.goals, 1) if isinstance(goal, Region)}
    if not regions:
        return Result(error=NOT_APPLICABLE, message="a straight line needs a pose goal")
    failures = dict(problem.failed_goals)
    for number in sorted(regions.keys() - failures.keys(), key=lambda number: (travel(regions[number]), number)):
        result = follow(regions[number])
        if not result.error:
            return replace(result, goal=number)
        if result.error in ("cancelled", "timeout"):
            return result
        failures[number] = result
    return no_goal_reachable(failures)


def _line(problem: Problem, goal: Region, options: Options, cancel: Cancel) -> Result:
    """Return one line to the pose of a goal region."""
    T_start = pin.SE3(problem.robot.fk(problem.start))
    T_end = pin.SE3(_end_of(problem.robot, goal, T_start.homogeneous))
    targets = _between(T_start, T_end, options.step, options.rotation_step, 1)
    if not controls_full_pose(problem.robot):
        targets = _with_regions(targets, goal, T_start.homogeneous)
    if not targets:
        return Result(waypoints=np.array([problem.start, problem.start]), dense=True, tool_line=True, fraction=1.0)
    waypoints, failure = _follow(problem, options, cancel, targets, None)
    count = len(targets)
    fraction = (len(waypoints) - 1) / count
    distance, angle = _distance(T_start, T_end)
    left = (1 - fraction) * max(distance, angle * options.goal_tolerance)
    if failure and (fraction < options.min_fraction or left > options.goal_tolerance):
        message = f"waypoint {failure.waypoint} of {count}: {failure.message} (fraction {fraction:.2f})"
        return replace(failure, fraction=fraction, message=message)
    return Result(waypoints=waypoints, dense=True, tool_line=True, fraction=fraction)


def _end_of(robot: RobotModel, goal: Region, T_start: Array) -> Array:
    """Return (4, 4) where a line to a goal ends; an arm that cannot choose the orientation keeps that of the start."""
    if controls_full_pose(robot):
        return goal.T_world_tcp
    return nearest_pose_in(replace(goal, half_sides=np.zeros(3)), T_start)


def _with_regions(targets: list[_Target], goal: Region, T_start: Array) -> list[_Target]:
    """Return targets of a line with the regions of their poses: from that of the start to that of the goal."""
    tilt, yaw = tilt_and_yaw_from(goal, T_start)
    found = []
    for number, target in enumerate(targets, 1):
        left = 1 - number / len(targets)
        T = transform(goal.T_world_tcp[:3, :3], target.pose.translation)
        region = Region(T, np.zeros(3), max(goal.tilt, left * tilt), max(goal.yaw, left * abs(yaw)))
        found.append(replace(target, region=region))
    return found


def _path(problem: Problem, goal: ToolPath, options: Options, cancel: Cancel) -> Result:
    """Return all lines of a path."""
    step = goal.step or options.step
    poses = [pin.SE3(T) for T in goal.poses]
    moves = [_distance(a, b) for a, b in pairwise(poses)]
    if refusal := check_step_count(sum(max(1, way / step, turn / options.rotation_step) for way, turn in moves)):
        return refusal
    targets: list[_Target] = []
    last = poses[0]
    for point, pose in enumerate(poses[1:], 1):
        between = _between(last, pose, step, options.rotation_step, point)
        targets += between
        last = pose if between else last
    if not targets:
        return Result(waypoints=np.array([problem.start, problem.start]), dense=True, fraction=1.0)
    targets, cuts = _smooth(poses[0], targets, options.path_tolerance)
    waypoints, failure = _follow(problem, options, cancel, targets, options.path_tolerance)
    lengths = np.array([target.length for target in targets])
    done = len(waypoints) - 1
    fraction = float(lengths[:done].sum() / lengths.sum()) if failure else 1.0
    if failure and (done == 0 or fraction < (goal.min_fraction or options.min_fraction)):
        target = targets[done]
        x, y, z = target.pose.translation
        message = (
            f"point {target.point + 1} of {len(poses)}, at ({x:.3f}, {y:.3f}, {z:.3f}): {failure.message}"
            f" (fraction {fraction:.2f})"
        )
        return replace(failure, fraction=fraction, message=message, waypoint=target.point)
    travel = ToolTravel(lengths[:done], cuts[: done + 1], goal.speed)
    return Result(waypoints=waypoints, tool_travel=travel, tool_line=goal.speed is None, fraction=fraction)


def _distance(a: pin.SE3, b: pin.SE3) -> tuple[float, float]:
    """Return distance [m] and turn [rad] between two poses."""
    turn = pin.log3(a.rotation.T @ b.rotation)
    return float(np.linalg.norm(b.translation - a.translation)), float(np.linalg.norm(turn))


def _between(a: pin.SE3, b: pin.SE3, step: float, rotation_step: float, point: int) -> list[_Target]:
    """Return targets on the line from a to b, without a and with b; none where the two are the same."""
    distance, angle = _distance(a, b)
    if distance < _SAME and angle < _SAME:
        return []
    way, turn = b.translation - a.translation, pin.log3(a.rotation.T @ b.rotation)
    count = max(1, math.ceil(distance / step - 1e-6), math.ceil(angle / rotation_step - 1e-6))
    turned = _LENGTH_PER_TURN * angle / count
    length = max(distance / count, turned)
    return [
        _Target(pin.SE3(a.rotation @ pin.exp3(share * turn), a.translation + share * way), length, turned, point)
        for share in (i / count for i in range(1, count + 1))
    ]


def _smooth(first: pin.SE3, targets: list[_Target], tolerance: float) -> tuple[list[_Target], Array]:
    """Return the targets smoothed within the tolerance, and (N,) how much to round off at each waypoint [m].

    A parabola that takes c from both sides of a corner passes it at a distance of c sin(turn / 2) / 2.
    """
    places = np.array([first.translation, *(target.pose.translation for target in targets)])
    sharp = np.concatenate([[0.0], 2 * np.arcsin(_half_turns(places)), [0.0]]) > _SHARP
    moved = smoothed(places, np.where(sharp, 0.0, _SMOOTHED * tolerance))
    away, ways = np.linalg.norm(moved - places, axis=1), np.linalg.norm(np.diff(moved, axis=0), axis=1)
    following = [
        _Target(pin.SE3(target.pose.rotation, place), max(float(way), target.turned), target.turned, target.point)
        for target, place, way in zip(targets, moved[1:], ways, strict=True)
    ]
    cuts = 2 * (tolerance - away[1:-1]) / np.maximum(_half_turns(moved), 1e-6)
    return following, np.concatenate([[0.0], cuts, [0.0]])


def _half_turns(places: Array) -> Array:
    """Return the sine of half the angle (N - 2,) by which the line through positions (N, 3) turns at each inner one."""
    edges = np.diff(places, axis=0)
    directions = edges / np.maximum(np.linalg.norm(edges, axis=1), 1e-12)[:, None]
    return np.asarray(np.minimum(np.linalg.norm(np.diff(directions, axis=0), axis=1) / 2, 1.0))


def _follow(
    problem: Problem, options: Options, cancel: Cancel, targets: list[_Target], tolerance: float | None
) -> tuple[Array, Result | None]:
    """Return waypoints (N, dof) [rad] as far as the targets can be followed, and what ends them."""
    path, motion, length = [problem.start], np.zeros(problem.robot.dof), 1.0
    for i, target in enumerate(targets, 1):
        guess = path[-1] + motion * (target.length / length)
        following = _step(problem, options, cancel, path[-1], guess, target, i)
        if isinstance(following, Result):
            return np.array(path), following
        if tolerance is not None and _deviation(problem.robot, path[-1], following) > tolerance:
            joint = int(np.argmax(np.abs(following - path[-1])))
            message = f"{problem.robot.joint_names[joint]} turns too fast for a straight line: near a singularity"
            return np.array(path), Result(error="joint_jump", message=message, waypoint=i)
        motion, length = following - path[-1], target.length
        path.append(following)
    return np.array(path), None


def _deviation(robot: RobotModel, a: Array, b: Array) -> float:
    """Return how far [m] the TCP is off the line between two positions (dof,) [rad], half way."""
    ends = robot.fk(a)[:3, 3] + robot.fk(b)[:3, 3]
    return float(np.linalg.norm(robot.fk((a + b) / 2)[:3, 3] - ends / 2))


def _step(
    problem: Problem, options: Options, cancel: Cancel, q: Array, guess: Array, target: _Target, i: int
) -> Array | Result:
    """Return the next position (dof,) [rad], or why there is none."""
    stop = cancel.reason(problem)
    if stop:
        return Result(error=stop, message="planning ended early", waypoint=i)
    robot = problem.robot
    # Repeating the last step is the best guess: one iteration less on a line.
    following = _converge(robot, target, guess, 10)
    if following is None:
        following = _converge(robot, target, q, 30)
    if following is None:
        return Result(error="no_ik", message=_explain(robot, q, target.pose), waypoint=i)
    jump = np.abs(following - q)
    if float(jump.max()) > options.jump_threshold:
        joint = int(np.argmax(jump))
        return Result(error="joint_jump", message=f"{robot.joint_names[joint]} jumps {jump[joint]:.2f} rad", waypoint=i)
    if not problem.world.edge_free(q, following):
        found = problem.world.obstruction(q, following, 0.002)
        return Result(error=found.error, message=found.message, waypoint=i, colliding=found.colliding)
    return following


def _converge(robot: RobotModel, target: _Target, seed: Array, iterations: int) -> Array | None:
    if target.region is not None:
        return converge_to_region(robot, target.region, seed, iterations)
    return converge(robot, target.pose, seed, iterations)


def _explain(robot: RobotModel, q: Array, target: pin.SE3) -> str:
    """Return why the arm at q (dof,) [rad] cannot reach a pose next to it."""
    jacobian = pin.computeFrameJacobian(robot.model, robot.data, q, robot.tcp_frame, pin.ReferenceFrame.LOCAL)
    if np.linalg.svd(jacobian, compute_uv=False)[-1] < _SINGULAR:
        return "the arm cannot reach it: it is at a singularity, such as stretched out"
    here = pin.SE3(robot.fk(q))
    needed = q + np.linalg.lstsq(jacobian, pin.log6(here.actInv(target)).vector, rcond=None)[0]
    beyond = np.maximum(robot.lower - needed, needed - robot.upper)
    joint = int(np.argmax(beyond))
    if beyond[joint] > 0:
        low, high = robot.lower[joint], robot.upper[joint]
        return f"{robot.joint_names[joint]} would leave its limits {low:.3f} to {high:.3f} rad"
    return "the arm cannot reach it without leaving its joint limits"
