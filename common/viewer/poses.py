"""Poses and colours as viser takes them: quaternions w, x, y, z, colours 0 to 255."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from common.messages import Color, Pose, Quaternion, Vector3
from common.robot.transforms import matrix_to_quaternion

Position = tuple[float, float, float]
Wxyz = tuple[float, float, float, float]
Rgb = tuple[int, int, int]

_DARKEST = 36


def position_of(pose: Pose) -> Position:
    """Position x, y, z [m]."""
    return pose.position.x, pose.position.y, pose.position.z


def wxyz_of(pose: Pose) -> Wxyz:
    """Quaternion w, x, y, z of a pose message."""
    o = pose.orientation
    return o.w, o.x, o.y, o.z


def matrix_wxyz(T: NDArray[np.float64]) -> Wxyz:
    """Quaternion w, x, y, z of a (4, 4) pose."""
    x, y, z, w = matrix_to_quaternion(T[:3, :3])
    return w, x, y, z


def pose_from(position: NDArray[np.float64], wxyz: NDArray[np.float64]) -> Pose:
    """The pose message of a node of the scene."""
    x, y, z = (float(value) for value in position)
    qw, qx, qy, qz = (float(value) for value in wxyz / np.linalg.norm(wxyz))
    return Pose(position=Vector3(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))


def rgb_of(color: Color) -> Rgb:
    """Red, green, blue of a colour message; black is a dark grey, so as to be seen before a dark background."""
    return _seen(color.r), _seen(color.g), _seen(color.b)


def _seen(value: float) -> int:
    return max(_DARKEST, round(255 * value))
