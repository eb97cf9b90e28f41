"""Inverse kinematics by damped least squares, with restarts from random seeds."""

from __future__ import annotations

from weakref import WeakKeyDictionary

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from common.planning.kernel.ik import KernelArm
from common.planning.kernel.world import NoKernel
from common.robot.model import RobotModel

Array = NDArray[np.float64]

POSITION_TOLERANCE = 1e-5  # [m]
ROTATION_TOLERANCE = 1e-4  # [rad]
_PATIENCE = 20  # random starts without the kernel: each takes a millisecond
_LARGEST_STEP = 1.0  # [rad] in one joint and iteration: beyond it the linearisation means nothing

_ARMS: WeakKeyDictionary[RobotModel, KernelArm | None] = WeakKeyDictionary()


def _arm(robot: RobotModel) -> KernelArm | None:
    """The robot in the compiled kernel; None where it cannot be used."""
    if robot not in _ARMS:
        try:
            _ARMS[robot] = KernelArm(robot.model, robot.tcp_frame, POSITION_TOLERANCE, ROTATION_TOLERANCE)
        except NoKernel:
            _ARMS[robot] = None
    return _ARMS[robot]


def converge(robot: RobotModel, target: pin.SE3, seed: Array, iterations: int) -> Array | None:
    """Joint positions (dof,) [rad] whose TCP is at the target, found from the seed alone; None where it gets stuck.

    Levenberg-Marquardt damping after Sugihara (2011): the damping follows the error, so that steps are short far from
    the target and near singularities, and Newton-like at the end. A joint that would leave its limits is taken out
    of the step instead of being clipped afterwards. The compiled kernel does it where it is there.
    """
    arm = _arm(robot)
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


_EYE = np.eye(6)


def damped_step(jacobian: Array, error: Array, damping: Array) -> Array:
    """The step (dof,) [rad] that lessens an error (m,) whose Jacobian is (m, dof), with a damping (m, m)."""
    step = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + damping, error)
    largest = float(np.abs(step).max())
    return np.asarray(step * (_LARGEST_STEP / largest)) if largest > _LARGEST_STEP else np.asarray(step)


def damped_step_within(q: Array, jacobian: Array, error: Array, damping: Array, lower: Array, upper: Array) -> Array:
    """The next position within the limits: joints that stand at a limit and would go on are left out of the step."""
    free = np.ones(len(q))
    step = np.zeros(len(q))
    for _ in range(3):
        step = damped_step(jacobian * free, error, damping)
        blocked = ((q + step < lower) & (q <= lower)) | ((q + step > upper) & (q >= upper))
        if not (blocked & (free > 0)).any():
            break
        free[blocked] = 0.0
    return np.asarray(np.clip(q + step * free, lower, upper))


_TURN = 2 * np.pi
_STEPS_BEYOND = 40
_SEEDS_BEYOND = 4


def why_no_ik(robot: RobotModel, T_world_tcp: Array, seed: Array) -> str:
    """Why no joint positions put the TCP at a pose (4, 4) for which none were found: too far away, or which limit.

    Looks for positions beyond the limits, from the seed (dof,) [rad] and a few others, and tells the nearest.
    """
    away = float(np.linalg.norm(T_world_tcp[:3, 3] - robot.foot))
    if away > robot.reach:
        return f"it is {away:.2f} m from the first joint, {robot.reach:.2f} m is the most"
    rng = np.random.default_rng(0)
    nearest: tuple[float, str] | None = None
    for number in range(_SEEDS_BEYOND):
        q = _beyond_limits(robot, pin.SE3(T_world_tcp), seed if number == 0 else rng.uniform(robot.lower, robot.upper))
        if q is None:
            continue
        excess = np.maximum(robot.lower - q, q - robot.upper)
        joint = int(np.argmax(excess))
        if nearest is None or excess[joint] < nearest[0]:
            limits = f"{robot.lower[joint]:.2f} to {robot.upper[joint]:.2f} rad"
            nearest = float(excess[joint]), f"{robot.joint_names[joint]} would be at {q[joint]:.2f}, not in {limits}"
    return nearest[1] if nearest is not None and nearest[0] > 0 else "the arm does not get there"


def _beyond_limits(robot: RobotModel, target: pin.SE3, seed: Array) -> Array | None:
    """Joint positions with the TCP at the target, whatever the limits, but turned back by full turns towards them."""
    model, data, frame = robot.model, robot.data, robot.tcp_frame
    turns = np.array([not joint.shortname().startswith("JointModelP") for joint in model.joints[1:]])
    middle = (robot.lower + robot.upper) / 2
    q = seed
    for _ in range(_STEPS_BEYOND):
        pin.computeJointJacobians(model, data, q)
        error = pin.log6(pin.updateFramePlacement(model, data, frame).actInv(target)).vector
        if np.abs(error).max() < ROTATION_TOLERANCE:
            return np.asarray(np.where(turns, middle + (q - middle + np.pi) % _TURN - np.pi, q))
        jacobian = pin.getFrameJacobian(model, data, frame, pin.ReferenceFrame.LOCAL)
        q = q + damped_step(jacobian, error, (0.05 * min(1.0, float(error @ error)) + 1e-7) * _EYE)
    return None


def solve_ik(
    robot: RobotModel,
    T_world_tcp: ArrayLike,
    seed: ArrayLike,
    *,
    rng: np.random.Generator | None = None,
    restarts: int = 200,
    iterations: int = 15,
) -> Array | None:
    """Joint positions (dof,) [rad] within the limits that put the TCP at a pose; None when none was found.

    The result is within 0.01 mm and 0.1 mrad of the pose and near the seed when the seed's branch reaches it.

    Args:
        robot: the model.
        T_world_tcp: (4, 4) pose of the TCP in the base frame.
        seed: (dof,) [rad] from which the search starts; clipped to the limits.
        rng: where restarts come from; the same sequence each time when not given.
        restarts: random starts after the seed failed, fewer without the kernel; 0 keeps to the seed's branch.
        iterations: steps from the seed.
    """
    arm = _arm(robot)
    if arm is not None:
        random = int(rng.integers(2**63)) if rng is not None and restarts else 0
        return arm.solve(T_world_tcp, seed, restarts=restarts, iterations=iterations, random=random)
    target = pin.SE3(np.asarray(T_world_tcp, dtype=float))
    q = converge(robot, target, np.asarray(seed, dtype=float), iterations)
    if q is not None or restarts == 0:
        return q
    generator = rng if rng is not None else np.random.default_rng(0)
    for _ in range(min(restarts, _PATIENCE)):
        q = converge(robot, target, generator.uniform(robot.lower, robot.upper), iterations)
        if q is not None:
            return q
    return None
