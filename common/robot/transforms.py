"""Poses as 4x4 matrices, named T_frame_thing, and as messages. Quaternions are x, y, z, w."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from common.messages import Pose, Quaternion, Vector3

Array = NDArray[np.float64]


def quaternion_to_matrix(x: float, y: float, z: float, w: float) -> Array:
    """(3, 3) rotation of a quaternion x, y, z, w, which is normalised first."""
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    x, y, z, w = x / norm, y / norm, z / norm, w / norm
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def matrix_to_quaternion(rotation: Array) -> tuple[float, float, float, float]:
    """Unit quaternion x, y, z, w (w >= 0) of a (3, 3) rotation.

    Shepperd's method: divides by the largest of the four components, so it is exact near half turns too.
    """
    m = rotation
    trace = float(m[0, 0] + m[1, 1] + m[2, 2])
    squares = (float(m[0, 0]), float(m[1, 1]), float(m[2, 2]), trace)
    largest = max(range(4), key=squares.__getitem__)
    if largest == 3:
        q = [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], 1 + trace]
    else:
        i, j, k = largest, (largest + 1) % 3, (largest + 2) % 3
        q = [0.0, 0.0, 0.0, m[k, j] - m[j, k]]
        q[i] = 1 + m[i, i] - m[j, j] - m[k, k]
        q[j] = m[i, j] + m[j, i]
        q[k] = m[k, i] + m[i, k]
    norm = math.copysign(math.sqrt(sum(float(v) ** 2 for v in q)), q[3])
    return float(q[0] / norm), float(q[1] / norm), float(q[2] / norm), float(q[3] / norm)


def pose_to_matrix(pose: Pose) -> Array:
    """(4, 4) matrix of a pose message."""
    T = np.eye(4)
    o, p = pose.orientation, pose.position
    T[:3, :3] = quaternion_to_matrix(o.x, o.y, o.z, o.w)
    T[:3, 3] = p.x, p.y, p.z
    return T


def matrix_to_pose(T: Array) -> Pose:
    """The pose message of a (4, 4) matrix."""
    x, y, z, w = matrix_to_quaternion(T[:3, :3])
    return Pose(
        position=Vector3(x=float(T[0, 3]), y=float(T[1, 3]), z=float(T[2, 3])),
        orientation=Quaternion(x=x, y=y, z=z, w=w),
    )


def rpy_to_matrix(roll: float, pitch: float, yaw: float) -> Array:
    """(3, 3) rotation Rz(yaw) Ry(pitch) Rx(roll): the URDF's convention, angles in [rad]."""
    cr, sr = math.cos(roll), math.sin(roll)
    cp, sp = math.cos(pitch), math.sin(pitch)
    cy, sy = math.cos(yaw), math.sin(yaw)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def matrix_to_rpy(rotation: Array) -> tuple[float, float, float]:
    """Roll, pitch, yaw [rad] of a (3, 3) rotation, as `rpy_to_matrix` takes them; yaw is 0 where pitch is upright."""
    m = rotation
    level = math.hypot(m[0, 0], m[1, 0])
    pitch = math.atan2(-m[2, 0], level)
    if level < 1e-9:
        return math.atan2(-m[1, 2], m[1, 1]), pitch, 0.0
    return math.atan2(m[2, 1], m[2, 2]), pitch, math.atan2(m[1, 0], m[0, 0])


def transform(rotation: Array, translation: Array | tuple[float, float, float]) -> Array:
    """(4, 4) matrix of a (3, 3) rotation and a translation [m]."""
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = translation
    return T


def invert(T: Array) -> Array:
    """Inverse of a rigid (4, 4) transform: T_b_a for T_a_b."""
    inverse = np.eye(4)
    inverse[:3, :3] = T[:3, :3].T
    inverse[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return inverse


def tool_down(x: float, y: float, z: float, yaw: float = 0.0) -> Array:
    """(4, 4) T_world_tcp at a point [m] with the tool's z axis pointing to -z of world, turned by yaw [rad] about +z.

    At yaw 0 the tool's x axis is that of world and its y axis (the Panda's finger axis) is -y of world.
    """
    return transform(rpy_to_matrix(math.pi, 0.0, yaw), (x, y, z))
