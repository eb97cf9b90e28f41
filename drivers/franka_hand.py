"""The Franka Hand by `pylibfranka`, from inside its driver's process. It has to be homed once, in Desk."""

from __future__ import annotations

from typing import Any

from common.config import GripperConfig
from common.hardware.driven_gripper import Fingers

ANY = 1.0  # [m] that what is grasped may be wider or narrower: the controller judges the width
HOMED = 0.01  # [m] that the fingers of one that is homed open at least
MET = 1e-3  # [m] no further apart, fingers have met: where any width will do, the hand takes that for a grasp as well
NARROWER = 5e-4  # [m] less than the fingers are apart, they are closed


def connect(options: dict[str, Any], config: GripperConfig) -> FrankaHand:
    """The hand; raises what the library raises when nobody answers."""
    return FrankaHand(options["host"], config.speed)


class FrankaHand:
    """The connection to the hand of an arm: one command at a time, each of which blocks until the fingers stop."""

    def __init__(self, host: str, speed: float) -> None:
        """Connect; nothing moves. `speed` is of the opening between the fingers [m/s]."""
        import pylibfranka

        self._failed = pylibfranka.CommandException
        self._gripper = pylibfranka.Gripper(host)
        self._speed = speed
        self._effort = 0.0
        self._width = 0.0
        if self._gripper.read_once().max_width < HOMED:
            raise RuntimeError("the hand is not homed: do that in Desk")

    def read(self) -> Fingers:
        """The newest state."""
        state = self._gripper.read_once()
        self._width = state.width
        holding = state.is_grasped and state.width > MET
        return Fingers(state.width, False, holding, self._effort if holding else 0.0)

    def move(self, width: float, effort: float) -> None:
        """Open to a width [m]; or close, on whatever is there, and press with an effort [N].

        Closing on nothing ends where the fingers meet: the hand has no motion that closes to a width and presses on
        what it meets before that.
        """
        try:
            if width < self._width - NARROWER:
                self._effort = effort
                self._gripper.grasp(width, self._speed, effort, ANY, ANY)
            else:
                self._gripper.move(width, self._speed)
        except self._failed:
            return  # was stopped, or could not: the state says how the fingers stand

    def stop(self) -> None:
        """Have a motion that is under way end."""
        self._gripper.stop()

    def close(self) -> None:
        """Let go of the hand; what it holds stays held."""
