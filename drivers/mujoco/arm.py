"""The arm in the world with physics, behind the seam of hardware backends: read, write set-points, gripper."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np

from common.hardware.interface import Gripper, Vector
from common.robot.model import RobotModel
from drivers.mujoco.gripper import PhysicsFingers
from drivers.mujoco.model import CellModel
from drivers.mujoco.servo import LEAD

ENCODER = 6  # decimals of what is measured [rad], [rad/s]
GOES_ON = 0.1  # [s] a set-point that is older stands still


class PhysicsArm:
    """An arm whose joints are moved by servos: time passes in its world when it is read."""

    def __init__(self, robot: RobotModel, start: Vector, advance: Callable[[float], None]) -> None:
        """Begin at rest at `start` (dof,) [rad]; `advance` lets the world go on to a time [s]."""
        config = robot.config.gripper
        self.fingers = PhysicsFingers(config) if config is not None and config.joints else None
        self.gripper: Gripper | None = self.fingers
        self._names = robot.joint_names
        self._advance = advance
        self._q, self._dq, self._written = start.copy(), np.zeros(len(start)), -np.inf

    def attach(self, cell: CellModel, data: mujoco.MjData) -> None:
        """Drive the joints of this model from here on."""
        self._data = data
        self._qpos = [cell.joints[name] for name in self._names]
        self._dofs = [cell.dofs[name] for name in self._names]
        self._actuators = [cell.actuators[name] for name in self._names]
        if self.fingers is not None:
            self.fingers.attach(cell, data)

    def read(self, now: float) -> tuple[Vector, Vector]:
        """Measured positions (dof,) [rad] and velocities (dof,) [rad/s] at a time that does not go back."""
        self._advance(now)
        q, dq = self._data.qpos[self._qpos], self._data.qvel[self._dofs]
        return np.round(q, ENCODER) + 0.0, np.round(dq, ENCODER) + 0.0  # no negative zeros: at rest nothing changes

    def write(self, positions: Vector, velocities: Vector, now: float) -> None:
        """Head for the set-points, which go on with their velocities until there are new ones."""
        self._q, self._dq, self._written = positions.copy(), velocities.copy(), now

    def drive(self, now: float) -> None:
        """Give the servos their set-points before a step."""
        age = now - self._written
        if age <= GOES_ON:
            self._data.ctrl[self._actuators] = self._q + (LEAD + max(age, 0.0)) * self._dq
        else:
            going_on = GOES_ON if np.isfinite(self._written) else 0.0
            self._data.ctrl[self._actuators] = self._q + going_on * self._dq
        if self.fingers is not None:
            self.fingers.drive(now)

    def sense(self, now: float) -> None:
        """Take note of where the fingers are after steps."""
        if self.fingers is not None:
            self.fingers.sense(now)

    def close(self) -> None:
        """Nothing to let go of."""
