"""The Franka Hand by `pylibfranka` (extra `franka`), inside its driver's process. It must have been homed in Desk."""

from __future__ import annotations

from typing import Any

from pydantic import Field

from common.config import GripperConfig, Parameters
from common.hardware.driven_gripper import DrivenGripper, FingerState

ANY_WIDTH = 1.0  # [m] tolerance of a grasp: the controller checks the width
HOMED_OPENING = 0.01  # [m] least maximal width of a homed hand
FINGERS_MEET = 1e-3  # [m] closer fingers touch each other, which the hand reports as a grasp of any width
CLOSING = 5e-4  # [m] a command for a width smaller by more than this closes


class GripperOptions(Parameters):
    """Address of the hand."""

    host: str = Field(description="address of the arm's controller")


def create_gripper(gripper: GripperConfig, options: GripperOptions) -> DrivenGripper:
    """Create the hand, in a process of its own."""
    return DrivenGripper(__name__, options.model_dump(), gripper, name=f"hand at {options.host}")


def connect(options: dict[str, Any], config: GripperConfig) -> FrankaHand:
    """Connect to the hand, inside the driver's process; raise what the library raises when it does not answer."""
    return FrankaHand(options["host"], config.speed)


class FrankaHand:
    """The connection to the hand of an arm: one command at a time, each of which blocks until the fingers stop."""

    def __init__(self, host: str, speed: float) -> None:
        """Connect; nothing moves. `speed` is of the opening between the fingers [m/s]."""
        import pylibfranka

        self._command_failed = pylibfranka.CommandException
        self._gripper = pylibfranka.Gripper(host)
        self._speed = speed
        self._effort = 0.0
        self._width = 0.0
        if self._gripper.read_once().max_width < HOMED_OPENING:
            raise RuntimeError("the hand is not homed: do that in Desk")

    def read(self) -> FingerState:
        """Return the newest state."""
        state = self._gripper.read_once()
        self._width = state.width
        holding = state.is_grasped and state.width > FINGERS_MEET
        return FingerState(state.width, False, holding, self._effort if holding else 0.0)

    def move(self, width: float, effort: float) -> None:
        """Open to a width [m]; or close on the object between the fingers, and press with an effort [N].

        Without an object, closing ends where the fingers meet: the hand has no motion that closes to a width and
        presses on what it meets before.
        """
        try:
            if width < self._width - CLOSING:
                self._effort = effort
                self._gripper.grasp(width, self._speed, effort, ANY_WIDTH, ANY_WIDTH)
            else:
                self._gripper.move(width, self._speed)
        except self._command_failed:
            return  # stopped, or impossible: the state shows where the fingers are

    def stop(self) -> None:
        """End a motion in progress."""
        self._gripper.stop()

    def close(self) -> None:
        """Release the hand; what it holds stays held."""
