"""The arm in the world with physics, behind the seam of hardware backends: read, write set-points, gripper."""

from __future__ import annotations

import math
from collections.abc import Callable

import mujoco
import numpy as np

from common.config import GripperConfig
from common.hardware.interface import Gripper, GripperReading, Vector
from common.hardware.mock import SimulatedFingers
from common.robot.finger_joints import driven_position, finger_positions, width_at
from common.robot.model import RobotModel
from drivers.mujoco.model import CellModel
from drivers.mujoco.robot import FINGER_ARMATURE

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


# How stiff the servos of a model are. They are tuned to what they move, so that any robot can be driven.

FREQUENCY = 60.0  # [rad/s] of the arm's joints
LEAD = 2.0 / FREQUENCY  # [s] kv / kp
FINGER_STIFFNESS = 2000.0  # [N/m] of the width
FINGER_DAMPING = 40.0  # [N s/m] of the width
FINGER_LEAD = FINGER_DAMPING / FINGER_STIFFNESS  # [s]
_STEP = 1e-4


def tune(cell: CellModel, robot: RobotModel) -> None:
    """Write gains and limits of force into the model, by the URDF's limits of effort where it has some."""
    model, data = cell.model, mujoco.MjData(cell.model)
    data.qpos[:] = cell.start
    mujoco.mj_forward(model, data)
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    for index, name in enumerate(robot.joint_names):
        moved = float(inertia[cell.dofs[name], cell.dofs[name]])
        effort = float(robot.model.effortLimit[index])
        _set(model, cell.actuators[name], moved * FREQUENCY**2, 2 * moved * FREQUENCY,
             effort if 0 < effort < math.inf else math.inf)
    gripper = robot.config.gripper
    if gripper is not None and gripper.joints:
        name = gripper.joints[0]
        slope = width_slope(gripper, gripper.max_width / 2)
        model.dof_armature[cell.dofs[name]] = FINGER_ARMATURE * slope**2
        _set(model, cell.actuators[name], FINGER_STIFFNESS * slope**2, FINGER_DAMPING * slope**2,
             gripper.max_effort * abs(slope))


def width_slope(gripper: GripperConfig, position: float) -> float:
    """By how much the width changes with the driven joint there [m/m or m/rad].

    Fingers that press with a force F need F times that at the driven joint, by the work that both do.
    """
    return (width_at(gripper, position + _STEP) - width_at(gripper, position - _STEP)) / (2 * _STEP)


def _set(model: mujoco.MjModel, actuator: int, kp: float, kv: float, force: float) -> None:
    model.actuator_gainprm[actuator, 0] = kp
    model.actuator_biasprm[actuator, :3] = 0.0, -kp, -kv
    limit_force(model, actuator, force)


def limit_force(model: mujoco.MjModel, actuator: int, force: float) -> None:
    """Let a servo pull no harder than that [N or Nm]."""
    model.actuator_forcelimited[actuator] = math.isfinite(force)
    model.actuator_forcerange[actuator] = (-force, force) if math.isfinite(force) else (0.0, 0.0)


# Fingers in the world with physics: driven along a jerk-limited width, with no more force than they were told.

FINGER_ENCODER = 5  # decimals of what is measured [m], [m/s]
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
        width, rate = round(self._width, FINGER_ENCODER), round(self._rate, FINGER_ENCODER)
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
