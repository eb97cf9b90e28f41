"""Checks of a plan request before planning, and the last check of a trajectory: limits, continuity and collisions."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from common.errors import UnknownName, ZencellError
from common.messages import (
    AnyGoal,
    ArcGoal,
    GoalSet,
    JointGoal,
    MovingGoal,
    PathGoal,
    PlanningScene,
    PlanRequest,
    Pose,
    PoseGoal,
    SequenceGoal,
)
from common.planning.collision import CollisionWorld, interpolate
from common.planning.constraints import ToolConstraints
from common.planning.contact_rules import Pair
from common.planning.problem import Arc, Goal, GoalChoice, GoalSequence, Moving, Region, SequenceItem, ToolPath
from common.planning.trajectory import TimedPath, cubics, end_accelerations, sample
from common.robot.model import RobotModel
from common.robot.transforms import invert, pose_to_matrix

Array = NDArray[np.float64]

TOLERANCE = 0.02  # of velocity and acceleration limits
_CLOSE = 1e-4  # [rad]


@dataclass(frozen=True)
class Fault:
    """Why a trajectory may not be executed: code for programs, message for people."""

    code: str
    message: str
    waypoint: int | None = None
    colliding: Pair | None = None


def validate(
    trajectory: TimedPath,
    robot: RobotModel,
    world: CollisionWorld,
    *,
    start: ArrayLike,
    velocity: ArrayLike,
    acceleration: ArrayLike,
    step: float,
) -> Fault | None:
    """Return the first fault of a trajectory, or None. The kernel proves all of it free where it can.

    Args:
        trajectory: states (N, dof).
        robot: the model, for position limits and names.
        world: obstacles; its rule for contact at the start applies here as well.
        start: (dof,) [rad] where the robot is.
        velocity, acceleration: limits (dof,) [rad/s], [rad/s^2].
        step: largest joint step [rad] between states that are checked for collision where the kernel proves nothing.
    """
    fault = check_numbers(trajectory, robot, start=start, velocity=velocity, acceleration=acceleration)
    if fault is not None:
        return fault
    proved, hit = world.check_cubics(cubics(trajectory))
    if proved:
        return None
    if hit is not None:
        waypoint = hit.index
    else:
        path, owners = fine_samples(trajectory, step)
        hit = world.first_collision(path)
        if hit is None:
            return None
        waypoint = int(owners[hit.index])
    message = f"waypoint {waypoint} of {len(trajectory.times)}: {hit.pair[0]} collides with {hit.pair[1]}"
    return Fault("collision", message, waypoint, hit.pair)


def fine_samples(trajectory: TimedPath, step: float) -> tuple[Array, NDArray[np.int64]]:
    """Return (N, dof) positions along a trajectory at most `step` [rad] apart, and the interval of each."""
    spans = np.diff(trajectory.times)
    speeds = np.abs(trajectory.velocities).max(axis=1)
    moves = np.maximum(
        np.abs(np.diff(trajectory.positions, axis=0)).max(axis=1), np.maximum(speeds[:-1], speeds[1:]) * spans
    )
    counts = np.maximum(1, np.ceil(moves / step).astype(int))
    owners = np.repeat(np.arange(len(counts)), counts)
    number = np.arange(len(owners)) - np.repeat(np.cumsum(counts) - counts, counts)
    times = trajectory.times[owners] + number * (spans / counts)[owners]
    path = np.concatenate([sample(trajectory, times), trajectory.positions[-1:]])
    return path, np.append(owners, len(counts))


def _outwards(q: Array, lower: Array, upper: Array) -> Array:
    """Return (N, dof) [rad] how far positions exceed a limit and the position before; 0 or less for none."""
    before = np.concatenate([q[:1], q[:-1]])
    excess: Array = np.maximum(np.minimum(lower - 1e-6, before) - q, q - np.maximum(upper + 1e-6, before))
    return excess


def check_numbers(
    trajectory: TimedPath, robot: RobotModel, *, start: ArrayLike, velocity: ArrayLike, acceleration: ArrayLike
) -> Fault | None:
    """Return the first fault of a trajectory's numbers: finite, times, start, rest, limits, consistency; or None."""
    times, q, dq, ddq = trajectory.times, trajectory.positions, trajectory.velocities, trajectory.accelerations
    limit_v, limit_a = np.asarray(velocity, dtype=float), np.asarray(acceleration, dtype=float)
    if len(times) < 2 or not (len(times) == len(q) == len(dq) == len(ddq)) or q.shape[1] != robot.dof:
        return Fault("bad_trajectory", f"has {len(times)} points of {q.shape[1]} joints")
    if not all(np.isfinite(values).all() for values in (times, q, dq, ddq)):
        return Fault("not_finite", "holds a number that is not finite")
    spans = np.diff(times)
    if times[0] != 0 or (spans <= 0).any():
        return Fault("bad_times", f"times do not increase strictly from 0 at waypoint {int(np.argmin(spans)) + 1}")
    away = np.abs(q[0] - np.asarray(start, dtype=float))
    if (away > _CLOSE).any():
        joint = int(np.argmax(away))
        return Fault("start_mismatch", f"starts {away[joint]:.4f} rad away from {robot.joint_names[joint]}'s start", 0)
    if max(np.abs(dq[0]).max(), np.abs(dq[-1]).max()) > 1e-6:
        return Fault("not_at_rest", "does not start and end at rest")
    h = spans[:, None]
    ahead = np.diff(q, axis=0) / h
    peak = 1.5 * ahead - 0.25 * (dq[:-1] + dq[1:])  # velocity in the middle of the cubic
    begin, finish = end_accelerations(trajectory)
    checks: list[tuple[str, Array, Callable[[int], str]]] = [
        ("position_limit", _outwards(q, robot.lower, robot.upper), lambda j: "its position limit"),
        ("velocity_limit", np.abs(dq) - (1 + TOLERANCE) * limit_v, lambda j: f"{limit_v[j]:.3f} rad/s"),
        ("velocity_limit", np.abs(peak) - (1 + TOLERANCE) * limit_v, lambda j: f"{limit_v[j]:.3f} rad/s"),
        ("acceleration_limit", np.abs(ddq) - (1 + TOLERANCE) * limit_a, lambda j: f"{limit_a[j]:.3f} rad/s^2"),
        ("inconsistent", np.abs(begin) - (1 + TOLERANCE) * limit_a - 1e-6 / h, lambda j: "the limit between states"),
        ("inconsistent", np.abs(finish) - (1 + TOLERANCE) * limit_a - 1e-6 / h, lambda j: "the limit between states"),
    ]
    for code, excess, limit in checks:
        if (excess > 0).any():
            waypoint, joint = divmod(int(np.argmax(excess)), robot.dof)
            message = f"waypoint {waypoint} of {len(times)}: {robot.joint_names[joint]} exceeds {limit(joint)}"
            return Fault(code, message, waypoint)
    return None


_MEASURED = 1e-4  # [rad] a measured state may be this far outside its limit
_INWARDS = 2e-3  # [rad] steps in which the path back to a limit is checked
_MAX_LEAD = 30.0  # [s]
_FAR = 2.0  # times the reach; for nearer goals the planners report how far they get
_AT_FIRST = (0.002, 0.02)  # [m], [rad] a path starts this close to where the robot is


class BadRequest(ZencellError):
    """A request that no planner could serve: code for programs, message for people, the colliding pair if any."""

    def __init__(self, code: str, message: str, colliding: Pair | None = None) -> None:
        super().__init__(message)
        self.code = code
        self.colliding = colliding


@dataclass(frozen=True)
class CheckedRequest:
    """Start (dof,) [rad] and goal, such as joint positions or a region, of a request whose numbers fit the robot.

    `outside_start` (dof,) [rad] is where the robot is, if that is outside a limit and `start` is within.
    """

    start: Array
    goal: Goal
    outside_start: Array | None = None


def check_request(
    robot: RobotModel, request: PlanRequest, scene: PlanningScene, current: Array | None, tolerance: float = _MEASURED
) -> CheckedRequest:
    """Return start and goal of a request; the start may be outside a limit by the tolerance [rad].

    Raises:
        BadRequest: start or goal do not fit the robot, unknown names, a scene in another frame.
    """
    frame = scene.header.frame_id
    if frame not in robot.world_frames:
        raise BadRequest("bad_scene", f"planning scene is in frame {frame!r}, not in world")
    if request.attach and request.release:
        raise BadRequest("bad_request", f"attach {request.attach!r} and release contradict each other")
    gripper, width = robot.config.gripper, request.gripper_width
    if width is not None and gripper is not None and width > gripper.max_width:
        message = f"gripper_width {width:g} m is more than the fingers open ({gripper.max_width:g} m)"
        raise BadRequest("bad_request", message)
    if request.start:
        start = _positions(robot, request.start, "start", "bad_start")
    elif current is None:
        raise BadRequest("no_state", "the request has no start and no joint state was received yet")
    else:
        start = _positions(robot, list(current), "current state", "bad_start")
    actual, start = start, _within_limits(robot, start, "start", "start_out_of_limits", max(tolerance, _MEASURED))
    outside_start = actual if np.abs(actual - start).max() > _MEASURED else None
    return CheckedRequest(start, _goal(robot, request.goal, start), outside_start)


def _goal(robot: RobotModel, goal: AnyGoal, start: Array) -> Goal:
    if isinstance(goal, PathGoal):
        return _tool_path(robot, start, goal)
    if isinstance(goal, MovingGoal):
        return _moving(robot, goal)
    if isinstance(goal, SequenceGoal):
        items = [SequenceItem(_item_goal(robot, item.goal), item.straight, item.blend_radius) for item in goal.items]
        return GoalSequence(tuple(items))
    return _item_goal(robot, goal)


def _moving(robot: RobotModel, goal: MovingGoal) -> Moving:
    _require_near(robot, goal.pose, "moving goal")
    v, lead = np.array([goal.velocity.x, goal.velocity.y, goal.velocity.z]), (goal.begin - goal.stamp) * 1e-9
    if not 0 <= lead <= _MAX_LEAD:
        message = f"the moving goal was observed {lead:.3g} s before the start, not 0 to {_MAX_LEAD:g} s"
        raise BadRequest("bad_goal", message)
    T = pose_to_matrix(goal.pose)
    T[:3, 3] += lead * v
    return Moving(T, v, goal.begin * 1e-9, lead, goal.approach, goal.dwell, goal.travel)


def _item_goal(robot: RobotModel, goal: JointGoal | PoseGoal | ArcGoal | GoalSet) -> Array | Region | Arc | GoalChoice:
    return GoalChoice(tuple(_goals_of(robot, goal))) if isinstance(goal, GoalSet) else _single_goal(robot, goal)


def _goals_of(robot: RobotModel, choice: GoalSet) -> Iterator[Array | Region]:
    for number, goal in enumerate(choice.goals, 1):
        try:
            yield _joint_goal(robot, goal) if isinstance(goal, JointGoal) else _region(robot, goal)
        except BadRequest as error:
            raise BadRequest(error.code, f"goal {number} of {len(choice.goals)}: {error}") from None


def _single_goal(robot: RobotModel, goal: JointGoal | PoseGoal | ArcGoal) -> Array | Region | Arc:
    if isinstance(goal, JointGoal):
        return _joint_goal(robot, goal)
    if isinstance(goal, ArcGoal):
        _require_near(robot, goal.pose, "goal")
        if goal.via is not None:
            _require_near(robot, Pose(position=goal.via), "via point")
        via, center = (None if p is None else np.array([p.x, p.y, p.z]) for p in (goal.via, goal.center))
        return Arc(pose_to_matrix(goal.pose), via, center)
    return _region(robot, goal)


def _region(robot: RobotModel, goal: PoseGoal) -> Region:
    _require_near(robot, goal.pose, "goal")
    tolerance = goal.position_tolerance
    sides = np.array([tolerance.x, tolerance.y, tolerance.z])
    if (sides < 0).any():
        raise BadRequest("bad_goal", f"goal has a negative position tolerance {float(sides.min()):g} m")
    return Region(pose_to_matrix(goal.pose), sides / 2, goal.tilt_tolerance, goal.yaw_tolerance)


def check_constraints(robot: RobotModel, request: PlanRequest, checked: CheckedRequest) -> ToolConstraints | None:
    """Return the constraints of a request; its start satisfies them, and its goal as far as it is known.

    Raises:
        BadRequest: start_violates_constraint, goal_violates_constraint, with the value and the limit.
    """
    if request.constraints is None:
        return None
    constraints = ToolConstraints(robot, request.constraints, checked.start)
    for what, code, T, turn, travel in _known_poses(robot, checked):
        if violation := constraints.pose_violation(T, turn, travel):
            raise BadRequest(f"{code}_violates_constraint", f"{what}: {violation}")
    return constraints


def _known_poses(robot: RobotModel, checked: CheckedRequest) -> Iterator[tuple[str, str, Array, float, float]]:
    """Yield name, whether start or goal, pose (4, 4), and the tolerance as turn [rad] and travel [m]."""
    for q in (checked.start, checked.outside_start):
        if q is not None:
            yield "start", "start", robot.fk(q), 0.0, 0.0
    goal = checked.goal
    goals: list[tuple[str, object]] = [("goal", goal)]
    if isinstance(goal, ToolPath):
        goals = [(f"point {number} of {len(goal.poses)}", T) for number, T in enumerate(goal.poses, 1)]
    elif isinstance(goal, GoalSequence):
        goals = [(f"item {number} of {len(goal.items)}", item.goal) for number, item in enumerate(goal.items, 1)]
    for what, each in goals:
        if isinstance(each, Region):
            yield what, "goal", each.T_world_tcp, each.tilt + each.yaw, float(np.linalg.norm(each.half_sides))
        elif isinstance(each, Arc):
            yield what, "goal", each.T_world_tcp, 0.0, 0.0
        elif isinstance(each, np.ndarray):
            yield what, "goal", robot.fk(each) if each.ndim == 1 else each, 0.0, 0.0


def check_collisions(world: CollisionWorld, checked: CheckedRequest) -> None:
    """Return if start and joint goal are free.

    Raises:
        BadRequest: start_in_collision or goal_in_collision with the pair.
    """
    ends = [("start", checked.start)]
    if checked.outside_start is not None:
        ends += [("start", q) for q in interpolate([checked.outside_start, checked.start], _INWARDS)]
    if isinstance(checked.goal, np.ndarray):
        ends.append(("goal", checked.goal))
    for what, q in ends:
        pair = world.colliding_pair(q)
        if pair:
            raise BadRequest(f"{what}_in_collision", f"{what} is in collision: {pair[0]} with {pair[1]}", pair)


def _joint_goal(robot: RobotModel, goal: JointGoal) -> Array:
    if goal.positions:
        positions = _positions(robot, goal.positions, "goal", "bad_goal")
    elif goal.named:
        try:
            positions = robot.named(goal.named)
        except UnknownName as error:
            raise BadRequest("unknown_pose", str(error)) from None
    else:
        raise BadRequest("bad_goal", "joint goal has neither positions nor the name of a pose")
    return _within_limits(robot, positions, "goal", "goal_out_of_limits")


def _require_near(robot: RobotModel, pose: Pose, what: str) -> None:
    """Return if a pose is near enough that a search for a path to it makes sense.

    Raises:
        BadRequest: out_of_reach.
    """
    place = pose.position
    away, reach = math.dist((place.x, place.y, place.z), robot.foot), robot.reach
    if away > _FAR * reach:
        where = f"({place.x:g}, {place.y:g}, {place.z:g})"
        message = f"{what} at {where} is {away:.3g} m away from the robot, which reaches {reach:.2f} m"
        raise BadRequest("out_of_reach", message)


def _tool_path(robot: RobotModel, start: Array, goal: PathGoal) -> ToolPath:
    for number, pose in enumerate(goal.waypoints, 1):
        _require_near(robot, pose, f"point {number} of {len(goal.waypoints)}")
    poses = np.array([pose_to_matrix(pose) for pose in goal.waypoints])
    T_tcp_first = invert(robot.fk(start)) @ poses[0]
    away = float(np.linalg.norm(T_tcp_first[:3, 3]))
    turned = float(np.arccos(np.clip((np.trace(T_tcp_first[:3, :3]) - 1) / 2, -1, 1)))
    if away > _AT_FIRST[0] or turned > _AT_FIRST[1]:
        raise BadRequest(
            "start_mismatch", f"start is {1e3 * away:.1f} mm and {turned:.3f} rad away from the path's first pose"
        )
    return ToolPath(poses, goal.step, goal.min_fraction, goal.tool_speed)


def _positions(robot: RobotModel, values: list[float], what: str, code: str) -> Array:
    if len(values) != robot.dof:
        raise BadRequest(code, f"{what} has {len(values)} positions for {robot.dof} joints")
    return np.array(values, dtype=float)


def _within_limits(robot: RobotModel, q: Array, what: str, code: str, tolerance: float = _MEASURED) -> Array:
    """Return q clipped to limits that it may exceed by the tolerance [rad]."""
    excess = np.maximum(robot.lower - q, q - robot.upper)
    joint = int(np.argmax(excess))
    if excess[joint] > tolerance:
        raise BadRequest(
            code,
            f"{what} puts {robot.joint_names[joint]} at {q[joint]:.4f} rad, "
            f"not within {robot.lower[joint]:.4f} to {robot.upper[joint]:.4f}",
        )
    return np.clip(q, robot.lower, robot.upper)
