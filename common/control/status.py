"""What the executor publishes after a cycle: messages, and whether they differ from the last published ones."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from common.config import GripperConfig
from common.control.trajectory_controller import TrajectoryController
from common.hardware.interface import Vector
from common.messages import (
    ConveyorState,
    GripperState,
    Header,
    JointState,
    MotionOwner,
    MotionStatus,
    RobotStatus,
    SceneUpdate,
    WorldObjects,
    Wrench,
)
from common.robot.finger_joints import finger_positions, finger_velocities

PROGRESS_PERIOD = 0.1  # [s] cell time between reports of progress
FINGERS_PERIOD = 0.02  # [s] cell time between reports of moving fingers: tasks continue by their width


@dataclass
class Report:
    """Messages to publish after a cycle; None where nothing has changed. `notes` are lines for the log."""

    joints: JointState | None = None
    motion: MotionStatus | None = None
    gripper: GripperState | None = None
    objects: WorldObjects | None = None
    conveyors: ConveyorState | None = None
    updates: list[SceneUpdate] = field(default_factory=list)
    robot: RobotStatus | None = None
    owner: MotionOwner | None = None
    wrench: Wrench | None = None
    notes: list[str] = field(default_factory=list)


class ChangeDetector:
    """Remembers what was published last."""

    def __init__(self, arm: TrajectoryController) -> None:
        """Start with nothing published."""
        self._arm = arm
        self._motion: MotionStatus | None = None
        self._motion_key: tuple[object, ...] = ()
        self._gripper: GripperState | None = None
        self._robot: dict[str, Any] | None = None
        self._motion_at = self._gripper_at = -np.inf  # cell time [s]

    def motion(self, header: Header) -> MotionStatus | None:
        """Return the status of the motion if it has changed."""
        last, key, now = self._motion, self._arm.reports.key, header.stamp * 1e-9
        if last is not None and (
            last.progress == self._arm.reports.newest.progress or now - self._motion_at < PROGRESS_PERIOD
        ) and (key == self._motion_key or last.equals_except(self._arm.status, "progress", "path_time")):
            self._motion_key = key
            return None
        self._motion, self._motion_at, self._motion_key = self._arm.status, now, key
        return self._motion.model_copy(update={"header": header})

    def robot(self, header: Header, fields: dict[str, Any], late: float) -> RobotStatus | None:
        """Return the state of the arm if one of `fields` has changed."""
        if fields == self._robot:
            return None
        self._robot = fields
        return RobotStatus(**fields, late=late, header=header)

    def gripper(self, header: Header, state: GripperState) -> GripperState | None:
        """Return the state of the gripper if it has changed; of moving fingers every FINGERS_PERIOD."""
        last, now = self._gripper, header.stamp * 1e-9
        if last is state:
            return None
        if last is not None and last.equals_except(state, "width", "position") and (
            last.width == state.width or now - self._gripper_at < FINGERS_PERIOD
        ):
            return None
        self._gripper, self._gripper_at = state, now
        return state.model_copy(update={"header": header})


def joint_state(
    header: Header, names: tuple[str, ...], q: Vector, dq: Vector, gripper: GripperConfig | None, width: float,
    width_rate: float,
) -> JointState:
    """Return positions and velocities of the arm's joints (dof,) and of the fingers, `width` apart [m], [m/s]."""
    all_names, positions, velocities = list(names), q.tolist(), dq.tolist()
    if gripper is not None:
        all_names += gripper.joints
        positions += finger_positions(gripper, width)
        velocities += finger_velocities(gripper, width, width_rate)
    return JointState(header=header, name=all_names, position=positions, velocity=velocities, effort=[])
