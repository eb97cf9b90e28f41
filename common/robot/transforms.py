"""Poses as 4x4 matrices, named T_frame_thing, and as messages. Quaternions are x, y, z, w.

Pinocchio has most of these functions, up to three times as fast. But cameras, tasks and clients use this module without
a robot model, and importing pinocchio costs each such process 0.14 s and 48 MB.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from common.messages import Pose

Array = NDArray[np.float64]

_IDENTITY = np.eye(4)


def quaternion_to_matrix(x: float, y: float, z: float, w: float) -> Array:
    """Return the (3, 3) rotation of a quaternion x, y, z, w, which is normalised first."""
    return np.array(_rotation_rows(x, y, z, w))


def _rotation_rows(x: float, y: float, z: float, w: float) -> tuple[list[float], list[float], list[float]]:
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    x, y, z, w = x / norm, y / norm, z / norm, w / norm
    return (
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    )


def matrix_to_quaternion(rotation: Array) -> tuple[float, float, float, float]:
    """Return the unit quaternion x, y, z, w (w >= 0) of a (3, 3) rotation.

    Shepperd's method: divides by the largest of the four components, so it is exact near half turns, too.
    """
    m = rotation.tolist()  # many times as fast as indexing an array
    trace = m[0][0] + m[1][1] + m[2][2]
    squares = (m[0][0], m[1][1], m[2][2], trace)
    largest = squares.index(max(squares))
    if largest == 3:
        q = [m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1], 1 + trace]
    else:
        i, j, k = largest, (largest + 1) % 3, (largest + 2) % 3
        q = [0.0, 0.0, 0.0, m[k][j] - m[j][k]]
        q[i] = 1 + m[i][i] - m[j][j] - m[k][k]
        q[j] = m[i][j] + m[j][i]
        q[k] = m[k][i] + m[i][k]
    norm = math.copysign(math.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2), q[3])
    return q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm


def pose_to_matrix(pose: Pose) -> Array:
    """Return the (4, 4) matrix of a pose message."""
    o, p = pose.orientation, pose.position
    a, b, c = _rotation_rows(o.x, o.y, o.z, o.w)
    return np.array([[*a, p.x], [*b, p.y], [*c, p.z], [0.0, 0.0, 0.0, 1.0]])


def matrix_to_pose(T: Array) -> Pose:
    """Return the pose message of a (4, 4) matrix."""
    return Pose.model_validate(pose_fields(T))


def pose_fields(T: Array) -> dict[str, dict[str, float]]:
    """Return the fields of a pose message, for messages of many poses that are validated at once."""
    x, y, z, w = matrix_to_quaternion(T[:3, :3])
    px, py, pz = T[:3, 3].tolist()
    return {"position": {"x": px, "y": py, "z": pz}, "orientation": {"x": x, "y": y, "z": z, "w": w}}


def rpy_to_matrix(roll: float, pitch: float, yaw: float) -> Array:
    """Return the (3, 3) rotation Rz(yaw) Ry(pitch) Rx(roll), as in URDF, angles in [rad]."""
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
    """Return roll, pitch, yaw [rad] of a (3, 3) rotation, as for `rpy_to_matrix`; yaw is 0 at a pitch of 90 deg."""
    m = rotation
    level = math.hypot(m[0, 0], m[1, 0])
    pitch = math.atan2(-m[2, 0], level)
    if level < 1e-9:
        return math.atan2(-m[1, 2], m[1, 1]), pitch, 0.0
    return math.atan2(m[2, 1], m[2, 2]), pitch, math.atan2(m[1, 0], m[0, 0])


def transform(rotation: Array, translation: Array | tuple[float, float, float]) -> Array:
    """Return the (4, 4) matrix of a (3, 3) rotation and a translation [m]."""
    T = _IDENTITY.copy()
    T[:3, :3] = rotation
    T[:3, 3] = translation
    return T


def invert(T: Array) -> Array:
    """Return the inverse of a rigid (4, 4) transform: T_b_a for T_a_b."""
    back = T[:3, :3].T
    return transform(back, -(back @ T[:3, 3]))


def tool_down(x: float, y: float, z: float, yaw: float = 0.0) -> Array:
    """Return (4, 4) T_world_tcp at a point [m] with the tool's z axis along -z of world, turned by yaw [rad] about +z.

    At yaw 0 the tool's x axis is that of world and its y axis (along which the gripper closes) is -y of world.
    """
    return transform(rpy_to_matrix(math.pi, 0.0, yaw), (x, y, z))
