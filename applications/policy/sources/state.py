"""The state of an observation as one vector."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from applications.policy.interface import Observation
from applications.policy.sources.settings import StatePart
from common.robot.transforms import matrix_to_quaternion


def size_of(parts: Sequence[StatePart], dof: int) -> int:
    """Return the length of the vector of these parts."""
    return sum({"positions": dof, "velocities": dof, "gripper": 1, "tcp": 7, "tcp_vector": 6}[part] for part in parts)


def state_vector(observation: Observation, parts: Sequence[StatePart], gripper: float) -> NDArray[np.float64]:
    """Return parts of an observation in their order, with `gripper` for the gripper."""
    T = observation.tcp
    values = {
        "positions": observation.positions, "velocities": observation.velocities, "gripper": [gripper],
        "tcp": [*T[:3, 3], *matrix_to_quaternion(T[:3, :3])],
        "tcp_vector": [*T[:3, 3], *np.asarray(cv2.Rodrigues(T[:3, :3])[0]).ravel()],
    }
    return np.concatenate([np.zeros(0), *(np.asarray(values[part], np.float64) for part in parts)])
