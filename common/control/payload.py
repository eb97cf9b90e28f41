"""Has an arm's own controller know what the hand carries: it reckons with it, and stops where it is wrong."""

from __future__ import annotations

from common.config import GripperConfig
from common.hardware.interface import ControlledArm


class Payload:
    """What the controller was told, at rest only: told of something else in motion it may stop for protection."""

    def __init__(self, arm: ControlledArm | None, gripper: GripperConfig | None) -> None:
        """Tell this arm, if it has a controller and the gripper says what it weighs."""
        self._arm, self._mass = arm, gripper.payload if gripper is not None else None
        self._carried: float | None = None  # [kg] that it was told is held
        self._order = 0  # number of that order
        self._untold = False  # whether it came to nothing: it is given again when the arm has moved

    def tell(self, held: float, ready: bool, at_rest: bool) -> None:
        """Tell it of the mass that is held [kg] when that changes, and when the controller is ready anew."""
        if not ready or (self._untold and not at_rest):
            self._carried, self._untold = None, False
        elif at_rest and self._arm is not None and self._mass is not None and held != self._carried and not self._order:
            self._carried = held
            self._order = self._arm.order("payload", *self._mass.with_held(held))

    def news(self) -> str:
        """A line when it could not be told since the last call; else empty."""
        if self._arm is None or not self._order or (outcome := self._arm.outcome(self._order)) is None:
            return ""
        self._order, self._untold = 0, bool(outcome)
        return outcome and f"the arm was not told what it carries: {outcome}"
