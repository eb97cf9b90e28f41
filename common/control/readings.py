"""What a backend measures, as plain numbers: whatever else it answers with is a fault of the device."""

from __future__ import annotations

import numpy as np

from common.control.faults import asked
from common.hardware.interface import Gripper, GripperReading, Hardware, HardwareFault, Vector

MOST = 1e9  # [rad], [rad/s], [m], [N]: nothing that moves measures more


def read_joints(hardware: Hardware, count: int, now: float) -> tuple[Vector, Vector]:
    """Positions [rad] and velocities [rad/s] of the joints (count,) at a time [s].

    Raises:
        HardwareFault: the arm does not work, or what it says are no numbers.
    """
    return asked("reading joints", _joints, hardware, count, now)


def read_fingers(gripper: Gripper, now: float) -> GripperReading:
    """The state of the fingers at a time [s].

    Raises:
        HardwareFault: they do not work, or what they say are no numbers.
    """
    return asked("reading the gripper", _fingers, gripper, now)


def _joints(hardware: Hardware, count: int, now: float) -> tuple[Vector, Vector]:
    q, dq = (np.asarray(values, dtype=float) for values in hardware.read(now))
    for what, values in (("positions", q), ("velocities", dq)):
        if np.shape(values) != (count,) or not (np.abs(values) < MOST).all():
            raise HardwareFault(f"reading joints: {what} are not {count} finite numbers: {values}")
    return q, dq


def _fingers(gripper: Gripper, now: float) -> GripperReading:
    said = gripper.read(now)
    reading = GripperReading(
        float(said.width), float(said.velocity), bool(said.moving), bool(said.holding), float(said.effort))
    for what in ("width", "velocity", "effort"):
        if not abs(value := getattr(reading, what)) < MOST:
            raise HardwareFault(f"reading the gripper: {what} is no finite number: {value}")
    return reading
