"""Decode the actions of a policy into joint targets and widths of the gripper."""

from __future__ import annotations

from typing import get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from applications.policy.interface import Chunk, ChunkKind, Observation, PolicyFailed, Vector
from common.planning.ik import controls_full_pose, explain_ik_failure, solve_ik
from common.robot.model import RobotModel
from common.robot.transforms import quaternion_to_matrix, transform

Array = NDArray[np.float64]

KINDS: tuple[ChunkKind, ...] = get_args(ChunkKind)
MAX_ROWS = 1000
MAX_RATE = 1000.0  # [Hz]
LARGEST_TURN = 1.0  # [rad] of a joint between rows of TCP poses: beyond it the arm would change its posture
_ITERATIONS = 60  # of inverse kinematics for each row
_LARGEST = 100.0  # [m], [rad]: values of poses beyond it are no poses of an arm
_UNIT = 0.1  # by which the length of a quaternion may differ from 1


def columns(kind: ChunkKind, dof: int) -> int:
    """Return the number of columns of a chunk's values."""
    return {"joints": dof, "joint_steps": dof, "tcp": 7, "tcp_steps": 6}[kind]


def decode(chunk: Chunk, observation: Observation, robot: RobotModel) -> tuple[Array, Vector | None]:
    """Return joint targets (n, dof) [rad] and widths of the gripper (n,) [m], or None without widths.

    Rows of kind `joints` and `joint_steps` may hold anything, NaN too: the proof of the motion rejects them. Rows of
    TCP poses are solved by inverse kinematics, each from the joint positions of the row before it.

    Args:
        chunk: what the policy returned.
        observation: that it answers.
        robot: model of the arm.

    Raises:
        PolicyFailed: the shape, the rate or a width is wrong, or a TCP pose is not finite or out of reach.
    """
    if not isinstance(chunk.kind, str) or chunk.kind not in KINDS:
        raise PolicyFailed(f"chunk of kind {str(chunk.kind)[:40]!r}; choices: {', '.join(KINDS)}")
    if not (isinstance(chunk.rate, int | float | np.number) and 0 < chunk.rate <= MAX_RATE):
        raise PolicyFailed(f"rate of a chunk: {str(chunk.rate)[:40]} is not within 0 to {MAX_RATE:g} Hz")
    if not isinstance(chunk.stamp, int | np.integer) or chunk.stamp != observation.stamp:
        raise PolicyFailed(f"a chunk has the stamp {str(chunk.stamp)[:40]}; that of its observation is "
                           f"{observation.stamp}")
    values = _values(chunk.values, (None, columns(chunk.kind, robot.dof)), chunk.kind)
    widths = None
    if chunk.gripper is not None:
        widths = _values(chunk.gripper, (len(values),), "gripper")
        if not np.isfinite(widths).all():
            raise PolicyFailed(f"gripper: row {int(np.argmin(np.isfinite(widths)))} is not finite")
    if chunk.kind == "joints":
        return values, widths
    if chunk.kind == "joint_steps":
        return observation.positions + values, widths
    if not np.isfinite(values).all():
        raise PolicyFailed(f"{chunk.kind}: row {int(np.argmin(np.isfinite(values).all(axis=1)))} is not finite")
    if (large := (np.abs(values) > _LARGEST).any(axis=1)).any():
        raise PolicyFailed(f"{chunk.kind}: row {int(np.argmax(large))} has a value beyond {_LARGEST:g}")
    poses = absolute_poses(values) if chunk.kind == "tcp" else stepped_poses(values, observation.tcp)
    return _follow(robot, poses, observation.positions), widths


def _values(given: object, shape: tuple[int | None, ...], what: str) -> Array:
    """Return a copy as floats of an array of this shape; None: 1 to `MAX_ROWS`."""
    expected = f"({', '.join('n' if size is None else str(size) for size in shape)}{',' if len(shape) == 1 else ''})"
    try:
        array = np.asarray(given) if isinstance(given, np.ndarray | list | tuple) else None
    except ValueError:
        raise PolicyFailed(f"{what}: must be an array {expected}; its rows differ in length") from None
    if array is None or array.dtype.kind not in "fiu" or array.dtype.itemsize > 8:
        found = type(given).__name__ if array is None else f"an array of {array.dtype}"
        raise PolicyFailed(f"{what}: must be an array {expected} of numbers, not {found}")
    if array.ndim != len(shape) or any(size not in (None, have) for size, have in zip(shape, array.shape, strict=True)):
        raise PolicyFailed(f"{what}: must be of shape {expected}, not {array.shape}")
    if not 1 <= len(array) <= MAX_ROWS:
        raise PolicyFailed(f"{what}: must have 1 to {MAX_ROWS} rows, not {len(array)}")
    return array.astype(float)


def absolute_poses(values: Array) -> Array:
    """Return T_world_tcp (n, 4, 4) of rows x, y, z [m] and quaternion x, y, z, w.

    Raises:
        PolicyFailed: the length of a quaternion is not 1.
    """
    lengths = np.linalg.norm(values[:, 3:], axis=1)
    wrong = ~(np.abs(lengths - 1) <= _UNIT)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise PolicyFailed(f"tcp: quaternion of row {row} has length {lengths[row]:.3g}, not 1")
    return np.array([transform(quaternion_to_matrix(*row[3:]), row[:3]) for row in values])


def stepped_poses(values: Array, T_world_tcp: Array) -> Array:
    """Return T_world_tcp (n, 4, 4) of rows of translation [m] and rotation vector [rad] along the axes of world.

    Args:
        values: (n, 6), each relative to the same pose.
        T_world_tcp: (4, 4) pose that they are relative to.
    """
    return np.array([
        transform(np.asarray(cv2.Rodrigues(row[3:])[0]) @ T_world_tcp[:3, :3], T_world_tcp[:3, 3] + row[:3])
        for row in values])


def _follow(robot: RobotModel, poses: Array, start: Vector) -> Array:
    """Return joint positions (n, dof) [rad] at poses (n, 4, 4), continuous from the start (dof,)."""
    if not controls_full_pose(robot):
        raise PolicyFailed(f"the arm has {robot.dof} joints and cannot follow TCP poses: the policy must return joints")
    rows = []
    before = start
    for number, pose in enumerate(poses):
        q = solve_ik(robot, pose, before, restarts=0, iterations=_ITERATIONS)
        if q is None:
            raise PolicyFailed(f"TCP pose of row {number} is not reachable: {explain_ik_failure(robot, pose, before)}")
        turns = np.abs(q - before)
        if turns.max() > LARGEST_TURN:
            joint = int(np.argmax(turns))
            raise PolicyFailed(f"TCP pose of row {number} is not continuous with the one before it: "
                               f"{robot.joint_names[joint]} would turn by {turns[joint]:.2f} rad; the limit is "
                               f"{LARGEST_TURN:g} rad")
        rows.append(q)
        before = q
    return np.array(rows)
