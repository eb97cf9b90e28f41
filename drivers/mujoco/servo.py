"""How stiff the servos of a model are. They are tuned to what they move, so that any robot can be driven.

A joint that carries an inertia M (the diagonal of the joint-space inertia at home, with the rotor's) is a damped
spring of the natural frequency w: kp = M w^2, kv = 2 M w. MuJoCo's position servo pulls with kp (ctrl - q) - kv dq, so
ctrl = q + (kv / kp) dq has it follow a moving set-point without lag: what is left is about ddq / w^2.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np

from common.config import GripperConfig
from common.robot.finger_joints import width_at
from common.robot.model import RobotModel
from drivers.mujoco.model import CellModel
from drivers.mujoco.robot import FINGER_ARMATURE

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
