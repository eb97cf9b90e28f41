"""What an operator holds: a device that is read for velocities and pressed buttons."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

from common.errors import ZencellError

Action = Literal["gripper", "stop", "home", "control", "faster", "slower", "frame", "quit", "start", "success",
                 "failure", "discard"]
Axes = tuple[float, float, float, float, float, float]
"""Shares -1 to 1 of the full speed: along x, y, z of the frame, then about them. x is forward, y left, z up."""
REST: Axes = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Reading:
    """Requested velocities, and the actions of buttons that were pressed since the last reading."""

    axes: Axes = REST
    actions: tuple[Action, ...] = ()


class Device(Protocol):
    """A source of velocities, read 50 times a second. It requests rest unless the operator holds something."""

    help: str  # its controls, in one line

    def read(self, now: float) -> Reading:
        """Return the state at a monotonic time [s]; never blocks.

        Raises:
            DeviceLost: the device is gone.
        """


class DeviceLost(ZencellError):
    """A device was unplugged, or cannot be read any more."""

    exit_code = 1

    def __init__(self, device: str, why: str) -> None:
        super().__init__(f"{device} is gone ({why}): the arm was stopped")
