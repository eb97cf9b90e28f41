"""Devices behind the hardware seam: checked readings, and faults that are states with a reason.

A device that fails is left alone for a while, longer each time, and the fault is logged once.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec, TypeVar

import numpy as np

from common.errors import Refused
from common.hardware.interface import (
    Gripper,
    GripperReading,
    Hardware,
    HardwareFault,
    Interrupted,
    Vector,
)
from common.messages.basics import clean

SHORTEST, LONGEST = 0.2, 5.0  # [s] cell time for which a failed device is left alone
CALM = 2.0  # [s] cell time without a fault, after which the next pause is the shortest again
MOST = 1e9  # [rad], [rad/s], [m], [N]: larger measurements are invalid

P = ParamSpec("P")
T = TypeVar("T")


def call_device(doing: str, call: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """Return the result of a call of a backend.

    Raises:
        HardwareFault: it raised an exception of any type.
    """
    try:
        return call(*args, **kwargs)
    except Exception as error:
        text = clean(str(error))  # the message of a device may contain anything
        if isinstance(error, HardwareFault) and text:
            raise (Interrupted if isinstance(error, Interrupted) else HardwareFault)(text) from error
        line = text.partition("\n")[0]
        raise HardwareFault(f"{doing}: {type(error).__name__}{': ' if line else ''}{line}") from error


def read_joints(hardware: Hardware, count: int, now: float) -> tuple[Vector, Vector]:
    """Return positions [rad] and velocities [rad/s] of the joints (count,) at a time [s].

    Raises:
        HardwareFault: the arm does not work, or returns no finite numbers.
    """
    return call_device("reading joints", _joints, hardware, count, now)


def read_gripper(gripper: Gripper, now: float) -> GripperReading:
    """Return the state of the fingers at a time [s].

    Raises:
        HardwareFault: they do not work, or return no finite numbers.
    """
    return call_device("reading the gripper", _fingers, gripper, now)


def _joints(hardware: Hardware, count: int, now: float) -> tuple[Vector, Vector]:
    q, dq = (np.asarray(values, dtype=float) for values in hardware.read(now))
    for what, values in (("positions", q), ("velocities", dq)):
        if np.shape(values) != (count,) or not (np.abs(values) < MOST).all():
            raise HardwareFault(f"reading joints: {what} are not {count} finite numbers: {values}")
    return q, dq


def _fingers(gripper: Gripper, now: float) -> GripperReading:
    raw = gripper.read(now)
    reading = GripperReading(
        float(raw.width), float(raw.velocity), bool(raw.moving), bool(raw.holding), float(raw.effort),
        str(getattr(raw, "message", "")))
    for what in ("width", "velocity", "effort"):
        if not abs(value := getattr(reading, what)) < MOST:
            raise HardwareFault(f"reading the gripper: {what} is no finite number: {value}")
    return reading


class DeviceFault:
    """Whether a device works; times are cell time [s].

    Attributes:
        reason: of the fault; empty while the device works.
    """

    def __init__(self, device: str) -> None:
        """Start with a working device of this name."""
        self.device, self.reason = device, ""
        self._pause_until = self._recovered_at = -float("inf")
        self._pause = 0.0
        self._noted = ""

    def is_paused(self, now: float) -> bool:
        """Return whether the device is to be left alone."""
        return bool(self.reason) and now < self._pause_until

    def set(self, reason: str, now: float) -> None:
        """Record a fault: leave the device alone, twice as long as the last time."""
        calm = not self.reason and now - self._recovered_at >= CALM
        self._pause = SHORTEST if calm else min(max(2 * self._pause, SHORTEST), LONGEST)
        self.reason, self._pause_until = reason, now + self._pause

    def clear(self, now: float) -> None:
        """Record that the device works."""
        if self.reason:
            self.reason, self._recovered_at = "", now

    def check(self) -> Refused | None:
        """Return why the device cannot be commanded, or None."""
        return Refused("hardware_fault", self.reason) if self.reason else None

    def pop_log_line(self) -> str:
        """Return a line for the log if the fault has changed since the last call; else ""."""
        if self.reason == self._noted:
            return ""
        before, self._noted = self._noted, self.reason
        return f"{self.device} does not work: {self.reason}" if self.reason else f"{self.device} works again ({before})"
