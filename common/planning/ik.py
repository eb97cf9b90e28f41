"""Inverse kinematics by damped least squares: to a pose, or into a region for arms of fewer than six joints.

An arm with fewer than six joints cannot choose the full pose of its tool: at a given position it takes the tilt and yaw
that are left there. For such an arm only those bounds of a region that are not met yet are equations of the search.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from weakref import WeakKeyDictionary

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from common.planning.kernel.library import library
from common.planning.kernel.solvers import KernelArm
from common.planning.kernel.world import KernelUnavailable
from common.planning.problem import Region
from common.robot.model import RobotModel
from common.robot.transforms import tool_down

Array = NDArray[np.float64]

POSITION_TOLERANCE = 1e-5  # [m]
ROTATION_TOLERANCE = 1e-4  # [rad]
FULL_POSE_DOF = 6  # joints with which an arm chooses position, tilt and yaw
_MAX_RESTARTS = 20  # random starts without the kernel: each takes a millisecond
_LARGEST_STEP = 1.0  # [rad] in one joint and iteration: beyond it the linearisation means nothing
_EYE = np.eye(6)
_FULL_TURN = 2 * np.pi
_DIAGNOSIS_STEPS = 40  # iterations from each seed of a search that explains a failure
_DIAGNOSIS_SEEDS = 4
_INNER_SHARE = 0.02  # of a bound: the search aims this far inside, or rounding would leave it outside
_NO_AXIS = 1e-9  # sine of a tilt below which its axis is undefined
_BISECTIONS = 6  # of a bound in the search for the least tilt or yaw

_ARMS: WeakKeyDictionary[RobotModel, KernelArm | None] = WeakKeyDictionary()


def _kernel_arm(robot: RobotModel) -> KernelArm | None:
    """Return the robot in the compiled kernel, or None where the kernel is unavailable."""
    if library() is None:
        return None
    if robot not in _ARMS:
        try:
            _ARMS[robot] = KernelArm(robot.model, robot.tcp_frame, POSITION_TOLERANCE, ROTATION_TOLERANCE)
        except KernelUnavailable:
            _ARMS[robot] = None
    return _ARMS[robot]


def controls_full_pose(robot: RobotModel) -> bool:
    """Return whether the arm has enough joints to choose yaw and tilt at any position of the tool."""
    return robot.dof >= FULL_POSE_DOF


def solve_ik(
    robot: RobotModel,
    T_world_tcp: ArrayLike,
    seed: ArrayLike,
    *,
    rng: np.random.Generator | None = None,
    restarts: int = 200,
    iterations: int = 15,
) -> Array | None:
    """Return joint positions (dof,) [rad] within the limits that put the TCP at a pose, or None if none was found.

    The result is within 0.01 mm and 0.1 mrad of the pose. It is near the seed if the seed's branch reaches the pose.

    Args:
        robot: the model.
        T_world_tcp: (4, 4) pose of the TCP in the base frame.
        seed: (dof,) [rad] from which the search starts; clipped to the limits.
        rng: source of the restarts; without it they are the same each time.
        restarts: random starts after the seed failed, fewer without the kernel; 0 stays on the seed's branch.
        iterations: steps from the seed.
    """
    arm = _kernel_arm(robot)
    if arm is not None:
        random = int(rng.integers(2**63)) if rng is not None and restarts else 0
        return arm.solve(T_world_tcp, seed, restarts=restarts, iterations=iterations, random=random)
    target = pin.SE3(np.asarray(T_world_tcp, dtype=float))
    q = converge(robot, target, np.asarray(seed, dtype=float), iterations)
    if q is not None or restarts == 0:
        return q
    generator = rng if rng is not None else np.random.default_rng(0)
    for _ in range(min(restarts, _MAX_RESTARTS)):
        q = converge(robot, target, generator.uniform(robot.lower, robot.upper), iterations)
        if q is not None:
            return q
    return None


def converge(robot: RobotModel, target: pin.SE3, seed: Array, iterations: int) -> Array | None:
    """Return joint positions (dof,) [rad] with the TCP at the target, searched from the seed alone; None if stuck.

    Levenberg-Marquardt damping after Sugihara (2011): the damping follows the error, so steps are short far from the
    target and near singularities, and Newton-like at the end. A joint that would leave its limits is taken out of the
    step instead of being clipped afterwards. Uses the compiled kernel where it is available.
    """
    arm = _kernel_arm(robot)
    if arm is not None:
        return arm.solve(target.homogeneous, seed, restarts=0, iterations=iterations)
    model, data, frame = robot.model, robot.data, robot.tcp_frame
    lower, upper = robot.lower, robot.upper
    q = np.clip(seed, lower, upper)
    for _ in range(iterations):
        pin.computeJointJacobians(model, data, q)
        error = pin.log6(pin.updateFramePlacement(model, data, frame).actInv(target)).vector
        if error[:3] @ error[:3] < POSITION_TOLERANCE**2 and error[3:] @ error[3:] < ROTATION_TOLERANCE**2:
            return q
        jacobian = pin.getFrameJacobian(model, data, frame, pin.ReferenceFrame.LOCAL)
        damping = (0.05 * min(1.0, float(error @ error)) + 1e-7) * _EYE
        following = q + damped_step(jacobian, error, damping)
        if (following < lower).any() or (following > upper).any():
            following = damped_step_within(q, jacobian, error, damping, lower, upper)
        q = following
    return None


def damped_step(jacobian: Array, error: Array, damping: Array) -> Array:
    """Return the step (dof,) [rad] that reduces an error (m,) with Jacobian (m, dof) and damping (m, m)."""
    step = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + damping, error)
    largest = float(np.abs(step).max())
    return np.asarray(step * (_LARGEST_STEP / largest)) if largest > _LARGEST_STEP else np.asarray(step)


def damped_step_within(q: Array, jacobian: Array, error: Array, damping: Array, lower: Array, upper: Array) -> Array:
    """Return the next position within the limits; joints that press against a limit do not take part in the step."""
    free = np.ones(len(q))
    step = np.zeros(len(q))
    for _ in range(3):
        step = damped_step(jacobian * free, error, damping)
        blocked = ((q + step < lower) & (q <= lower)) | ((q + step > upper) & (q >= upper))
        if not (blocked & (free > 0)).any():
            break
        free[blocked] = 0.0
    return np.asarray(np.clip(q + step * free, lower, upper))


def explain_ik_failure(robot: RobotModel, T_world_tcp: Array, seed: Array) -> str:
    """Return why no joint positions put the TCP at a pose (4, 4): it is too far away, or a limit prevents it.

    Searches beyond the limits from the seed (dof,) [rad] and a few random ones, and reports the nearest solution.
    """
    if message := _out_of_reach(robot, T_world_tcp):
        return message
    rng = np.random.default_rng(0)
    nearest: tuple[float, str] | None = None
    for number in range(_DIAGNOSIS_SEEDS):
        start = seed if number == 0 else rng.uniform(robot.lower, robot.upper)
        q = _converge_beyond_limits(robot, pin.SE3(T_world_tcp), start)
        if q is None:
            continue
        excess = np.maximum(robot.lower - q, q - robot.upper)
        joint = int(np.argmax(excess))
        if nearest is None or excess[joint] < nearest[0]:
            limits = f"{robot.lower[joint]:.2f} to {robot.upper[joint]:.2f} rad"
            nearest = float(excess[joint]), f"{robot.joint_names[joint]} would be at {q[joint]:.2f}, not in {limits}"
    return nearest[1] if nearest is not None and nearest[0] > 0 else "the arm cannot reach it"


def _out_of_reach(robot: RobotModel, T_world_tcp: Array) -> str:
    distance = float(np.linalg.norm(T_world_tcp[:3, 3] - robot.foot))
    if distance <= robot.reach:
        return ""
    return f"it is {distance:.2f} m from the first joint; the arm reaches {robot.reach:.2f} m"


def _converge_beyond_limits(robot: RobotModel, target: pin.SE3, seed: Array) -> Array | None:
    """Return joint positions with the TCP at the target regardless of limits, less full turns away from them."""
    model, data, frame = robot.model, robot.data, robot.tcp_frame
    turns = np.array([not joint.shortname().startswith("JointModelP") for joint in model.joints[1:]])
    middle = (robot.lower + robot.upper) / 2
    q = seed
    for _ in range(_DIAGNOSIS_STEPS):
        pin.computeJointJacobians(model, data, q)
        error = pin.log6(pin.updateFramePlacement(model, data, frame).actInv(target)).vector
        if np.abs(error).max() < ROTATION_TOLERANCE:
            return np.asarray(np.where(turns, middle + (q - middle + np.pi) % _FULL_TURN - np.pi, q))
        jacobian = pin.getFrameJacobian(model, data, frame, pin.ReferenceFrame.LOCAL)
        q = q + damped_step(jacobian, error, (0.05 * min(1.0, float(error @ error)) + 1e-7) * _EYE)
    return None


def solve_region_ik(
    robot: RobotModel, region: Region, seed: Array, *, rng: np.random.Generator | None = None, restarts: int = 0,
    iterations: int = 30, upright: bool = True,
) -> Array | None:
    """Return joint positions (dof,) [rad] with the TCP in a region, or None if none was found.

    Args:
        robot: the model.
        region: allowed poses of the TCP.
        seed: (dof,) [rad] from which the search starts.
        rng: source of the restarts; without it they are the same each time.
        restarts: random starts after the seed failed.
        iterations: steps from each start.
        upright: try without any tilt first; otherwise accept the tilt nearest to the seed.
    """
    generator = rng if rng is not None else np.random.default_rng(0)
    straight = Region(region.T_world_tcp, region.half_sides, 0.0, region.yaw)
    for number in range(restarts + 1):
        start = seed if number == 0 else generator.uniform(robot.lower, robot.upper)
        for tried in (straight, region) if region.tilt and upright else (region,):
            if (q := converge_to_region(robot, tried, start, iterations)) is not None:
                return q
    return None


def solve_tool_down_ik(
    robot: RobotModel, place: tuple[float, float, float], yaw: float, seed: Array, *, tilt: float = 0.0,
    rng: np.random.Generator | None = None, restarts: int = 0, iterations: int = 30, upright: bool = True,
) -> Array | None:
    """Return joint positions (dof,) [rad] with the tool pointing down at a position, or None if none was found.

    Args:
        robot: the model.
        place: (x, y, z) [m] of the TCP, world.
        yaw: of the tool [rad]; an arm that cannot choose its yaw takes any.
        seed: (dof,) [rad] from which the search starts.
        tilt: allowed deviation of the tool axis [rad].
        rng, restarts, upright: as of `solve_region_ik`.
        iterations: steps from the seed.
    """
    T = tool_down(*place, yaw)
    if controls_full_pose(robot) and tilt == 0.0:
        return solve_ik(robot, T, seed, rng=rng, restarts=restarts, iterations=iterations)
    region = pose_region(robot, T, tilt)
    return solve_region_ik(robot, region, seed, rng=rng, restarts=restarts, iterations=2 * iterations, upright=upright)


def pose_region(robot: RobotModel, T_world_tcp: Array, tilt: float) -> Region:
    """Return the region at a pose (4, 4) within a tilt [rad]; its yaw is free if the arm cannot choose it."""
    return Region(T_world_tcp, np.zeros(3), tilt, 0.0 if controls_full_pose(robot) else math.pi)


def converge_to_region(robot: RobotModel, region: Region, seed: Array, iterations: int) -> Array | None:
    """Return joint positions (dof,) [rad] within the limits with the TCP in a region, from a seed; None if stuck.

    Damped least squares as in `converge`, with one row for each bound that is not met: position along the axes of
    world, tilt, and yaw. A bound that is met has no row, so joints are free to move within it.
    """
    model, data, frame = robot.model, robot.data, robot.tcp_frame
    lower, upper = robot.lower, robot.upper
    q = np.clip(seed, lower, upper)
    for _ in range(iterations):
        pin.computeJointJacobians(model, data, q)
        T = pin.updateFramePlacement(model, data, frame)
        moved = pin.getFrameJacobian(model, data, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
        rows = list(_unmet_bounds(region, np.asarray(T.rotation), np.asarray(T.translation)))
        if not rows:
            return np.asarray(q)
        jacobian = np.array([row @ moved for row, _ in rows])
        error = np.array([value for _, value in rows])
        damping = (0.05 * min(1.0, float(error @ error)) + 1e-7) * np.eye(len(rows))
        following = q + damped_step(jacobian, error, damping)
        if (following < lower).any() or (following > upper).any():
            following = damped_step_within(q, jacobian, error, damping, lower, upper)
        q = following
    return None


def _unmet_bounds(region: Region, R: Array, p: Array) -> Iterator[tuple[Array, float]]:
    """Yield each bound of a region that a pose violates: the twist component (6,), world, and its missing amount."""
    target = region.T_world_tcp
    away = target[:3, 3] - p
    beyond = np.sign(away) * np.maximum(np.abs(away) - region.half_sides, 0.0)
    place = [(_EYE[axis], float(beyond[axis])) for axis in range(3)]
    point = [row for axis, row in enumerate(place) if region.half_sides[axis] == 0.0 or row[1] != 0.0]
    in_place = float(np.abs(beyond).max()) < POSITION_TOLERANCE

    turned = target[:3, :3].T @ R
    tilt = math.acos(min(max(float(turned[2, 2]), -1.0), 1.0))
    axis = _cross(R[:, 2], target[:3, 2])
    length = math.sqrt(axis @ axis)
    axis = axis / length if length > _NO_AXIS else np.asarray(R[:, 0])
    # The yaw is the turn that remains after the shortest rotation has aligned the tool axes.
    yaw = math.atan2(turned[1, 0] - turned[0, 1], turned[0, 0] + turned[1, 1])
    upright = tilt - region.tilt < ROTATION_TOLERANCE
    facing = abs(yaw) - region.yaw < ROTATION_TOLERANCE
    if in_place and upright and facing:
        return
    yield from point
    if region.tilt == 0.0:
        for across in (target[:3, 0], target[:3, 1]):
            yield _rotation_about(across), tilt * float(axis @ across)
    elif tilt > region.tilt * (1 - _INNER_SHARE):
        yield _rotation_about(axis), tilt - region.tilt * (1 - _INNER_SHARE)
    if not facing or region.yaw == 0.0:
        missing = -math.copysign(max(abs(yaw) - region.yaw * (1 - _INNER_SHARE), 0.0), yaw)
        yield _rotation_about(target[:3, 2]), missing


def _cross(a: Array, b: Array) -> Array:
    """Return the product of two vectors (3,), as `np.cross` does, which is slow for one pair."""
    (a0, a1, a2), (b0, b1, b2) = a.tolist(), b.tolist()
    return np.array([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0])


def _rotation_about(axis: Array) -> Array:
    return np.concatenate([np.zeros(3), axis])


def explain_region_unreachable(robot: RobotModel, region: Region, seed: Array) -> str:
    """Return why no joint positions put the TCP into a region: the distance, the limit, or the yaw or tilt."""
    if controls_full_pose(robot):
        return explain_ik_failure(robot, region.T_world_tcp, seed)
    if _search_region(robot, region, seed) is not None:
        return "the arm reaches it in another posture"
    T, sides = region.T_world_tcp, region.half_sides
    any_yaw, any_rotation = (Region(T, sides, tilt, math.pi) for tilt in (region.tilt, math.pi))
    for what, wider, allowed in (("yaw", any_yaw, region.yaw), ("tilt", any_rotation, region.tilt)):
        if (q := _search_region(robot, wider, seed)) is not None:
            nearest = _least_angle(robot, region, q, what)
            return (f"with {robot.dof} joints the arm cannot choose {what} there: nearest is "
                    f"{math.degrees(nearest):.0f} deg, {math.degrees(allowed):.0f} deg are allowed")
    return _out_of_reach(robot, T) or "the arm cannot reach it with any orientation of the tool"


def _search_region(robot: RobotModel, region: Region, seed: Array) -> Array | None:
    rng = np.random.default_rng(0)
    starts = [seed, *(rng.uniform(robot.lower, robot.upper) for _ in range(_DIAGNOSIS_SEEDS - 1))]
    return next((q for start in starts if (q := converge_to_region(robot, region, start, 40)) is not None), None)


def _least_angle(robot: RobotModel, region: Region, q: Array, what: str) -> float:
    """Return the least tilt, or the least yaw within the region's tilt, by bisection from positions q (dof,) [rad]."""
    low, high = (region.tilt, math.pi) if what == "tilt" else (region.yaw, math.pi)
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        tried = Region(region.T_world_tcp, region.half_sides, *(
            (middle, math.pi) if what == "tilt" else (region.tilt, middle)))
        found = converge_to_region(robot, tried, q, 40)
        low, high, q = (low, middle, found) if found is not None else (middle, high, q)
    return high
