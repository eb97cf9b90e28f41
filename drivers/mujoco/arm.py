"""The arm and gripper of the physics world behind the hardware interface, driven by servos."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import mujoco
import numpy as np

from common.config import GripperConfig
from common.hardware.interface import Gripper, GripperReading, HardwareFault, Vector
from common.hardware.mock import SimulatedFingers
from common.robot.finger_joints import driven_position, finger_positions, width_at
from common.robot.model import RobotModel
from drivers.mujoco.cup import PhysicsCup, Seal
from drivers.mujoco.model import FORCE_SENSOR, CellModel, prefix
from drivers.mujoco.robot import FINGER_ARMATURE

ENCODER = 6  # decimals of measured [rad], [rad/s]
MAX_AGE = 0.1  # [s] to which a set-point is extrapolated


class PhysicsArm:
    """An arm moved by servos: reading it, or another one of its world, advances the world."""

    def __init__(
        self, name: str, robot: RobotModel, start: Vector, advance: Callable[[float], None], seal: Seal
    ) -> None:
        """Start at rest at `start` (dof,) [rad]; `advance` advances the world to a time [s]; `seal` is of a cup."""
        config, self._prefix = robot.config.gripper, prefix(name)
        self.fingers = PhysicsFingers(config, self._prefix) if config is not None and config.joints else None
        self.cup = PhysicsCup(config, seal, self._prefix) if config is not None and config.cup is not None else None
        self._tool = self.fingers or self.cup
        self.gripper: Gripper | None = self._tool
        self.known_payload = None  # the sensor measures all that is beyond the flange
        self._wrenches: list[Vector] = []  # of the steps before the last reading of the joints
        self._newer: list[Vector] = []  # of those since
        self._names = [self._prefix + name for name in robot.joint_names]
        self._advance = advance
        self._q, self._dq, self._written = start.copy(), np.zeros(len(start)), -np.inf

    def attach(self, cell: CellModel, data: mujoco.MjData) -> None:
        """Drive the joints of this model."""
        self._data = data
        self._qpos = [cell.joints[name] for name in self._names]
        self._dofs = [cell.dofs[name] for name in self._names]
        self._actuators = [cell.actuators[name] for name in self._names]
        self._sensor = np.concatenate([range(at := int(cell.model.sensor(self._prefix + name).adr[0]), at + 3)
                                       for name in FORCE_SENSOR])
        if self._tool is not None:
            self._tool.attach(cell, data)

    def read(self, now: float) -> tuple[Vector, Vector]:
        """Return measured positions (dof,) [rad] and velocities (dof,) [rad/s]; time must not decrease."""
        self._advance(now)
        if self._newer:
            self._wrenches, self._newer = self._newer, []
        q, dq = self._data.qpos[self._qpos], self._data.qvel[self._dofs]
        return np.round(q, ENCODER) + 0.0, np.round(dq, ENCODER) + 0.0  # no negative zeros: readings at rest are equal

    def write(self, positions: Vector, velocities: Vector, now: float) -> None:
        """Move to the set-points, which are extrapolated with their velocities until the next ones."""
        self._q, self._dq, self._written = positions.copy(), velocities.copy(), now

    def drive(self, now: float) -> None:
        """Set the servo targets before a step."""
        age = now - self._written
        if age <= MAX_AGE:
            self._data.ctrl[self._actuators] = self._q + (LEAD + max(age, 0.0)) * self._dq
        else:
            extrapolated = MAX_AGE if np.isfinite(self._written) else 0.0
            self._data.ctrl[self._actuators] = self._q + extrapolated * self._dq
        if self._tool is not None:
            self._tool.drive(now)

    def measure(self) -> None:
        """Read the force sensor after a step. MuJoCo's is what the arm exerts on the flange: of the other sign."""
        self._newer.append(-self._data.sensordata[self._sensor])

    def wrench(self) -> Vector | None:
        """Return the mean (6,) over the steps of the last reading; before the first step None.

        Raises:
            HardwareFault: a cup pulls: the sensor contains what presses on its lip, but not what it pulls with.
        """
        if self.cup is not None and self.cup.pulls:
            raise HardwareFault("MuJoCo measures no force at a cup that pulls")
        return np.asarray(np.mean(self._wrenches, axis=0)) if self._wrenches else None

    def sense(self, now: float) -> None:
        """Update the state of fingers or cup after steps."""
        if self._tool is not None:
            self._tool.sense(now)

    def close(self) -> None:
        """Do nothing: there is no resource to release."""


# Servo gains: tuned to the inertia of each joint, so that any robot can be driven.
#
# A joint with inertia M (diagonal of the joint-space inertia at home, including the rotor) is a critically damped
# spring of natural frequency w: kp = M w^2, kv = 2 M w. MuJoCo's position servo applies kp (ctrl - q) - kv dq, so
# ctrl = q + (kv / kp) dq tracks a moving set-point without lag; the remaining error is about ddq / w^2.

FREQUENCY = 60.0  # [rad/s] natural frequency of arm joints
LEAD = 2.0 / FREQUENCY  # [s] kv / kp
FINGER_STIFFNESS = 2000.0  # [N/m] with respect to the width
FINGER_DAMPING = 40.0  # [N s/m] with respect to the width
FINGER_LEAD = FINGER_DAMPING / FINGER_STIFFNESS  # [s]
_STEP = 1e-4


def tune(cell: CellModel, robots: Mapping[str, RobotModel]) -> None:
    """Write servo gains and force limits into the model; limits are the URDF's efforts, if any."""
    model, data = cell.model, mujoco.MjData(cell.model)
    data.qpos[:] = cell.start
    mujoco.mj_forward(model, data)
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    for arm, robot in robots.items():
        _tune_arm(cell, robot, prefix(arm), inertia)


def _tune_arm(cell: CellModel, robot: RobotModel, before: str, inertia: Vector) -> None:
    model = cell.model
    for index, joint in enumerate(robot.joint_names):
        name = before + joint
        inertia_here = float(inertia[cell.dofs[name], cell.dofs[name]])
        effort = float(robot.model.effortLimit[index])
        _set(model, cell.actuators[name], inertia_here * FREQUENCY**2, 2 * inertia_here * FREQUENCY,
             effort if 0 < effort < math.inf else math.inf)
    gripper = robot.config.gripper
    if gripper is not None and gripper.joints:
        name = before + gripper.joints[0]
        slope = width_slope(gripper, gripper.max_width / 2)
        model.dof_armature[cell.dofs[name]] = FINGER_ARMATURE * slope**2
        _set(model, cell.actuators[name], FINGER_STIFFNESS * slope**2, FINGER_DAMPING * slope**2,
             gripper.max_effort * abs(slope))


def width_slope(gripper: GripperConfig, position: float) -> float:
    """Derivative of the width by the driven joint's position [m/m or m/rad].

    By virtual work, a gripping force F needs F times this at the driven joint.
    """
    return (width_at(gripper, position + _STEP) - width_at(gripper, position - _STEP)) / (2 * _STEP)


def _set(model: mujoco.MjModel, actuator: int, kp: float, kv: float, force: float) -> None:
    model.actuator_gainprm[actuator, 0] = kp
    model.actuator_biasprm[actuator, :3] = 0.0, -kp, -kv
    limit_force(model, actuator, force)


def limit_force(model: mujoco.MjModel, actuator: int, force: float) -> None:
    """Limit the force of a servo [N or Nm]."""
    model.actuator_forcelimited[actuator] = math.isfinite(force)
    model.actuator_forcerange[actuator] = (-force, force) if math.isfinite(force) else (0.0, 0.0)


# Fingers: driven along a jerk-limited width profile with limited force

FINGER_ENCODER = 5  # decimals of measured [m], [m/s]
STILL = 2e-3  # [m/s] threshold of standstill
SHORT = 3e-3  # [m] tolerance of the commanded width
STALLS = 0.05  # [s] of standstill short of the target: they press on something
SLIPS, SLID = 0.03, 1e-3  # [s] and [m] of motion: they no longer press; less is a push against what they hold


class PhysicsFingers:
    """The gripper of the physics world. Joint and servo determine whether it holds something."""

    def __init__(self, config: GripperConfig, before: str) -> None:
        """Start open, with full force; names of its joints in the model have `before` in front."""
        self._config, self._joints = config, [before + joint for joint in config.joints]
        self._profile = SimulatedFingers(config, config.max_width)  # motion without an object between them
        self._target, self._effort = config.max_width, config.max_effort
        self._placed = False  # they press since before a restart
        self._still_since = math.inf  # [s] start of standstill short of the target
        self._moving_since = math.inf
        self._rest = config.max_width  # width at the latest standstill [m]
        self._holds = False
        self._width, self._rate, self._force = config.max_width, 0.0, 0.0
        self._moves = False

    def attach(self, cell: CellModel, data: mujoco.MjData) -> None:
        """Drive the fingers of this model."""
        name = self._joints[0]
        self._cell, self._data = cell, data
        self._slope = width_slope(self._config, float(data.qpos[cell.joints[name]]))
        self._qpos, self._dof, self._actuator = cell.joints[name], cell.dofs[name], cell.actuators[name]

    def command(self, width: float, now: float, effort: float) -> None:
        """Start to move to a width [m]; press with an effort [N] on an obstruction."""
        self._target, self._effort = min(max(width, 0.0), self._config.max_width), effort
        self._placed = self._placed and self._target < self._width - SHORT
        self._holds = self._holds and self._target < self._width - SHORT
        self._still_since = self._moving_since = math.inf
        self._profile.place(self._width if self._holds or self._placed else self._profile.read(now).width)
        self._profile.command(self._target, now, effort)
        self._moves = True

    def read(self, now: float) -> GripperReading:
        """Return the measurement after the last step."""
        width, rate = round(self._width, FINGER_ENCODER), round(self._rate, FINGER_ENCODER)
        return GripperReading(width, rate, self._moves, self._holds, round(self._force, 1) if self._holds else 0.0)

    def place(self, width: float) -> None:
        """Set a width [m] immediately."""
        width = min(max(width, 0.0), self._config.max_width)
        self._profile.place(width)
        self._target, self._width, self._rate, self._placed = width, width, 0.0, True
        for joint, position in zip(self._joints, finger_positions(self._config, width), strict=True):
            self._data.qpos[self._cell.joints[joint]] = position
            self._data.qvel[self._cell.dofs[joint]] = 0.0
        mujoco.mj_forward(self._cell.model, self._data)

    def drive(self, now: float) -> None:
        """Set the servo target before a step."""
        if self._target >= self._width - SHORT:  # they reached the placed width and press on nothing
            self._placed = False
        profile = self._profile.read(now)
        width, rate = (self._target, 0.0) if self._placed else (profile.width, profile.velocity)
        slope = self._slope
        limit_force(self._cell.model, self._actuator, self._effort * abs(slope))
        self._data.ctrl[self._actuator] = driven_position(self._config, width) + FINGER_LEAD * rate / slope

    def sense(self, now: float) -> None:
        """Read the joint after steps: update motion and grasp state."""
        position = float(self._data.qpos[self._qpos])
        self._slope = slope = width_slope(self._config, position)
        self._width = min(max(width_at(self._config, position), 0.0), self._config.max_width)
        self._rate = slope * float(self._data.qvel[self._dof])
        self._force = abs(float(self._data.actuator_force[self._actuator]) / slope)
        is_still, is_short = abs(self._rate) < STILL, self._width > self._target + SHORT
        blocked = self._placed or self._profile.read(now).width < self._width - SHORT / 2
        self._still_since = min(self._still_since, now) if is_still and is_short and blocked else math.inf
        self._moving_since = math.inf if is_still else min(self._moving_since, now)
        self._rest = self._width if is_still else self._rest
        if self._holds:
            slid = now - self._moving_since >= SLIPS and abs(self._width - self._rest) > SLID
            self._holds = is_short and not slid
        else:
            self._holds = now - self._still_since >= STALLS
        self._moves = not self._holds and (self._profile.read(now).moving or not is_still
                                           or (is_short and now - self._still_since < STALLS))
