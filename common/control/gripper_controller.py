"""Gripper goals: one at a time, a new one replaces the running one, a repeated id is only answered."""

from __future__ import annotations

from common.config import GripperConfig
from common.control.goals import REMEMBERED, GoalMemory
from common.errors import Refused
from common.hardware.interface import Gripper, GripperReading
from common.messages import GripperCommand, GripperState
from common.robot.finger_joints import driven_position

SETTLED = 1e-3  # fingers that stop this near to the width they were told are there [m]


class GripperController:
    """Commands the fingers and reports what became of it."""

    def __init__(self, gripper: Gripper, config: GripperConfig, remember: int = REMEMBERED) -> None:
        """Command this gripper; `remember` so many goals by their ids."""
        self._gripper = gripper
        self._config = config
        self._memory: GoalMemory[GripperState] = GoalMemory(remember)
        self._target: float | None = None  # [m]; of whoever asked last
        self.state = GripperState(source=config.controller)

    def command(self, request: GripperCommand, now: float, objection: Refused | None = None) -> GripperState:
        """The state of the goal: active, or rejected with the reason; for a known id what became of it.

        Args:
            request: for the fingers.
            now: cell time [s].
            objection: what speaks against a new goal from the start.
        """
        known = self._memory.get(request.id)
        if known is not None:
            return known
        reading = self.state.model_dump(include={"width", "position", "effort", "holding", "moving", "source"})
        message, code = "", ""
        if objection is not None:
            message, code = str(objection), objection.code
        elif request.width > self._config.max_width:
            message = f"width {request.width:g} m is more than the fingers open ({self._config.max_width:g} m)"
        elif request.effort > self._config.max_effort:
            message = f"effort {request.effort:g} N is more than the fingers have ({self._config.max_effort:g} N)"
        if message:
            rejected = GripperState.model_validate(
                {**reading, "id": request.id, "state": "rejected", "error": code, "message": message})
            return self._memory.put(request.id, rejected, refused=True)
        if self.state.state == "active":
            replaced = {"state": "cancelled", "message": f"replaced by {request.id!r}"}
            self._memory.put(self.state.id, self.state.model_copy(update=replaced))
        self._gripper.command(request.width, now, request.effort or self._config.max_effort)
        self._target = request.width
        self.state = GripperState.model_validate({**reading, "moving": True, "id": request.id, "state": "active"})
        return self._memory.put(request.id, self.state)

    @property
    def told(self) -> float | None:
        """Width that the fingers were told last [m]; None when nobody has told them anything."""
        return self._target

    def resume(self, width: float, now: float) -> None:
        """Go on pressing or moving to the width [m] that was told before this process began."""
        self._gripper.command(width, now, self._config.max_effort)
        self._target = width

    def update(self, reading: GripperReading) -> GripperState:
        """The state with the newest reading: a goal is over when the fingers have stopped."""
        state = self.state
        changes: dict[str, object] = {
            "width": reading.width, "position": driven_position(self._config, reading.width),
            "effort": reading.effort, "holding": reading.holding, "moving": reading.moving,
        }
        if state.state == "active" and not reading.moving:
            changes["state"] = "succeeded"
            assert self._target is not None
            if abs(reading.width - self._target) > SETTLED and not reading.holding:
                changes["state"] = "aborted"
                changes["message"] = f"fingers stopped at {reading.width:.4f} m, not at {self._target:.4f} m"
        if not changes.items() <= vars(state).items():
            self.state = state.model_copy(update=changes)
        if self.state.id:
            self._memory.put(self.state.id, self.state)
        return self.state
