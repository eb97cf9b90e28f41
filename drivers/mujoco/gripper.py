"""Fingers in the world with physics: driven along a jerk-limited width, with no more force than they were told."""

from __future__ import annotations

import math

import mujoco

from common.config import GripperConfig
from common.hardware.interface import GripperReading
from common.hardware.mock import SimulatedFingers
from common.robot.finger_joints import driven_position, finger_positions, width_at
from drivers.mujoco.model import CellModel
from drivers.mujoco.servo import FINGER_LEAD, limit_force, width_slope

ENCODER = 5  # decimals of what is measured [m], [m/s]
STILL = 2e-3  # [m/s] fingers that are slower stand
SHORT = 3e-3  # [m] from the width that they were told, or nearer: they are there
STALLS = 0.05  # [s] so long they stand short of it, and press then
SLIPS = 0.03  # [s] so long they move again, and press no more


class PhysicsFingers:
    """The gripper of the world with physics. Whether it holds something is what its joint and servo tell."""

    def __init__(self, config: GripperConfig) -> None:
        """Begin open, with all the force that there is."""
        self._config = config
        self._profile = SimulatedFingers(config, config.max_width)  # where they would be with nothing between them
        self._target, self._effort = config.max_width, config.max_effort
        self._at_once = False  # they press since before this process began
        self._standing_since = math.inf  # [s] short of the target
        self._moving_since = math.inf
        self._holds = False
        self._width, self._rate, self._force = config.max_width, 0.0, 0.0
        self._moves = False

    def attach(self, cell: CellModel, data: mujoco.MjData) -> None:
        """Drive the fingers of this model from here on."""
        name = self._config.joints[0]
        self._cell, self._data = cell, data
        self._slope = width_slope(self._config, float(data.qpos[cell.joints[name]]))
        self._qpos, self._dof, self._actuator = cell.joints[name], cell.dofs[name], cell.actuators[name]

    def command(self, width: float, now: float, effort: float) -> None:
        """Start to move to a width [m] and press with an effort [N] on what is in the way."""
        self._target, self._effort = min(max(width, 0.0), self._config.max_width), effort
        self._at_once = self._at_once and self._target < self._width - SHORT
        self._holds = self._holds and self._target < self._width - SHORT
        self._standing_since = self._moving_since = math.inf
        self._profile.place(self._width if self._holds or self._at_once else self._profile.read(now).width)
        self._profile.command(self._target, now, effort)
        self._moves = True

    def read(self, now: float) -> GripperReading:
        """As measured after the last step."""
        width, rate = round(self._width, ENCODER), round(self._rate, ENCODER)
        return GripperReading(width, rate, self._moves, self._holds, round(self._force, 1) if self._holds else 0.0)

    def place(self, width: float) -> None:
        """Stand at a width [m] at once."""
        width = min(max(width, 0.0), self._config.max_width)
        self._profile.place(width)
        self._target, self._width, self._rate, self._at_once = width, width, 0.0, True
        for joint, position in zip(self._config.joints, finger_positions(self._config, width), strict=True):
            self._data.qpos[self._cell.joints[joint]] = position
            self._data.qvel[self._cell.dofs[joint]] = 0.0
        mujoco.mj_forward(self._cell.model, self._data)

    def drive(self, now: float) -> None:
        """Give the servo its set-point before a step."""
        if self._target >= self._width - SHORT:  # where they were placed they stand, and press on nothing
            self._at_once = False
        wanted = self._profile.read(now)
        width, rate = (self._target, 0.0) if self._at_once else (wanted.width, wanted.velocity)
        slope = self._slope
        limit_force(self._cell.model, self._actuator, self._effort * abs(slope))
        self._data.ctrl[self._actuator] = driven_position(self._config, width) + FINGER_LEAD * rate / slope

    def sense(self, now: float) -> None:
        """Read the joint after steps: whether they move, and press on something."""
        position = float(self._data.qpos[self._qpos])
        self._slope = slope = width_slope(self._config, position)
        self._width = min(max(width_at(self._config, position), 0.0), self._config.max_width)
        self._rate = slope * float(self._data.qvel[self._dof])
        self._force = abs(float(self._data.actuator_force[self._actuator]) / slope)
        stands, short = abs(self._rate) < STILL, self._width > self._target + SHORT
        pushed = self._at_once or self._profile.read(now).width < self._width - SHORT / 2
        self._standing_since = min(self._standing_since, now) if stands and short and pushed else math.inf
        self._moving_since = math.inf if stands else min(self._moving_since, now)
        if self._holds:
            self._holds = short and now - self._moving_since < SLIPS
        else:
            self._holds = now - self._standing_since >= STALLS
        self._moves = not self._holds and (self._profile.read(now).moving or not stands
                                           or (short and now - self._standing_since < STALLS))
