"""Gripper goals: one at a time, a new one replaces the running one, a repeated id is only answered.

A grasp is judged by the width that is held, and what is held is watched until the next command.
"""

from __future__ import annotations

import math
from typing import Any

from common.config import GripperConfig
from common.control.faults import asked
from common.control.goals import REMEMBERED, GoalMemory
from common.errors import Refused
from common.hardware.interface import Gripper, GripperReading
from common.messages import GripperCommand, GripperState
from common.robot.finger_joints import driven_position

SETTLED = 1e-3  # fingers that stop this near to the width they were told are there [m]
SLIPPED = 2e-3  # what is held slips once the fingers are so much closer than they were [m]


class GripperController:
    """Commands the fingers and reports what became of it."""

    def __init__(self, gripper: Gripper, config: GripperConfig, remember: int = REMEMBERED) -> None:
        """Command this gripper; `remember` so many goals by their ids."""
        self._gripper = gripper
        self._config = config
        self._memory: GoalMemory[GripperState] = GoalMemory(remember)
        self._target: float | None = None  # [m]; of whoever asked last
        self._asked: GripperCommand | None = None
        self._began = self._moved = -math.inf  # the newest command, the newest reading of fingers that move [s]
        self._from = 0.0  # width at the newest command [m]
        self._went = False  # whether fingers were seen on their way since
        self._held: float | None = None  # width of what was grasped [m]
        self._effort = config.effort
        self.state = GripperState(source=config.controller)

    def command(
        self, request: GripperCommand, now: float, objection: Refused | None = None, waits: bool = False,
    ) -> GripperState:
        """The state of the goal: active, or rejected with the reason; for a known id what became of it.

        Args:
            request: for the fingers.
            now: cell time [s].
            objection: what speaks against a new goal from the start.
            waits: whether the fingers go on with what they do until `begin` or `call_off`.

        Raises:
            HardwareFault: the fingers do not work.
        """
        known = self._memory.get(request.id)
        if known is not None:
            return known
        reading = self._reading
        message, code = "", ""
        if objection is not None:
            message, code = str(objection), objection.code
        elif request.width > self._config.max_width:
            message = f"width {request.width:g} m is more than the fingers open ({self._config.max_width:g} m)"
        elif request.effort > self._config.max_effort:
            message = f"effort {request.effort:g} N is more than the fingers have ({self._config.max_effort:g} N)"
        elif (request.expected_width or 0.0) > self._config.max_width:
            message = (f"expected_width {request.expected_width:g} m is more than the fingers open "
                       f"({self._config.max_width:g} m)")
        if message:
            rejected = GripperState.model_validate(
                {**reading, "id": request.id, "state": "rejected", "error": code, "message": message})
            return self._memory.put(request.id, rejected, refused=True)
        if waits:
            waiting = {**reading, "id": request.id, "state": "active", "message": f"waits for goal {request.after!r}"}
            return self._memory.put(request.id, GripperState.model_validate(waiting))
        return self.begin(request, now)

    def begin(self, request: GripperCommand, now: float) -> GripperState:
        """The state of a goal that nothing speaks against, at a time [s].

        Raises:
            HardwareFault: the fingers do not work.
        """
        self._tell(request.width, now, request.effort)
        if self.state.state == "active":
            replaced = {"state": "cancelled", "message": f"replaced by {request.id!r}"}
            self._memory.put(self.state.id, self.state.model_copy(update=replaced))
        self._asked = request
        begun = {**self._reading, "moving": True, "id": request.id, "state": "active"}
        self.state = GripperState.model_validate(begun)
        return self._memory.put(request.id, self.state)

    def call_off(self, request: GripperCommand, why: str, error: str = "") -> None:
        """Have a goal that waits be cancelled, or aborted for an error; the fingers go on with what they do."""
        off = {"id": request.id, "state": "aborted" if error else "cancelled", "error": error, "message": why}
        if self.state.state == "active":
            self._memory.put(request.id, self.state.model_copy(update=off))
        else:
            self.state = self._memory.put(request.id, self.state.model_copy(update=off))

    @property
    def _reading(self) -> dict[str, Any]:
        """What was read of the fingers."""
        return self.state.model_dump(include={"width", "position", "effort", "holding", "moving", "source"})

    def knows(self, goal: str) -> bool:
        """Whether a goal was heard of."""
        return self._memory.get(goal) is not None

    def fault(self, message: str) -> None:
        """End the goal of the fingers, which do not work."""
        if self.state.state == "active":
            failed = {"state": "aborted", "error": "hardware_fault", "message": message}
            self.state = self._memory.put(self.state.id, self.state.model_copy(update=failed))

    @property
    def told(self) -> float | None:
        """Width that the fingers were told last [m]; None when nobody has told them anything."""
        return self._target

    @property
    def effort(self) -> float:
        """What the fingers were told last to press with [N]."""
        return self._effort

    @property
    def held_mass(self) -> float:
        """Of what was grasped, as the command said [kg]; 0 where nothing is held, or nobody said."""
        return self._asked.mass if self._asked is not None and self.state.outcome == "grasped" else 0.0

    def resume(self, width: float, now: float, effort: float = 0.0) -> None:
        """Go on moving to the width [m] or pressing with the effort [N] that was told before this process began."""
        self._tell(width, now, effort)

    def _tell(self, width: float, now: float, effort: float) -> None:
        effort = effort or self._config.effort
        asked("moving the gripper", self._gripper.command, width, now, effort)
        self._effort = effort
        self._target, self._began, self._held = width, now, None
        self._from, self._went = self.state.width, False

    def update(self, reading: GripperReading, now: float) -> GripperState:
        """The state with the newest reading, at a time [s]: a goal is over when the fingers have stopped."""
        state = self.state
        self._moved = now if reading.moving else self._moved
        self._went = self._went or (self._target is not None and reading.moving and self._on_the_way(reading.width))
        over = state.state == "active" and self._has_stopped(reading, now)
        changes: dict[str, object] = {
            "width": reading.width, "position": driven_position(self._config, reading.width),
            "effort": reading.effort, "holding": reading.holding,
            "moving": reading.moving or (state.state == "active" and not over),
        }
        if over:
            changes |= self._judged(reading)
        else:
            if state.state == "none" and self._held is None and reading.holding and not reading.moving:
                self._held = reading.width  # by a process before this one
            if self._held is not None:
                changes |= self._watched(reading, self._held)
        if not changes.items() <= vars(state).items():
            self.state = state.model_copy(update=changes)
        if self.state.id:
            self._memory.put(self.state.id, self.state)
        return self.state

    def _on_the_way(self, width: float) -> bool:
        """Whether fingers that are so far apart [m] have moved to where they were told last."""
        assert self._target is not None
        return (width - self._from) * math.copysign(1.0, self._target - self._from) > SETTLED

    def _has_stopped(self, reading: GripperReading, now: float) -> bool:
        """Whether the fingers have done what they could; readings may be of before the command, or say late that they
        press on something. Those of fingers that were seen on their way are of after it."""
        assert self._target is not None
        if reading.moving:
            return False
        if abs(reading.width - self._target) <= SETTLED or (reading.holding and self._went):
            return True
        since = self._began if reading.holding else max(self._began, self._moved)
        return now - since >= self._config.latency

    def _judged(self, reading: GripperReading) -> dict[str, object]:
        """What became of the goal, by a reading of fingers that have stopped."""
        assert self._target is not None and self._asked is not None
        expected, width = self._asked.expected_width, reading.width
        if reading.holding and self._target <= width + SETTLED:
            off = 0.0 if expected is None else width - expected
            if expected is None or abs(off) <= self._asked.width_tolerance:
                self._held = width
                return {"state": "succeeded", "outcome": "grasped"}
            found = "wide" if off > 0 else "narrow"
            message = f"the fingers closed on something too {found} ({width:.4f} m, not {expected:.4f} m)"
            return {"state": "aborted", "outcome": f"too_{found}", "message": message}
        if abs(width - self._target) > SETTLED and not reading.holding:
            message = f"fingers stopped at {width:.4f} m, not at {self._target:.4f} m"
            return {"state": "aborted", "message": message}
        if expected is not None:
            return {"state": "aborted", "outcome": "empty", "message": "the fingers closed on nothing"}
        return {"state": "succeeded"}

    def _watched(self, reading: GripperReading, held: float) -> dict[str, object]:
        """What has become of what was grasped, `held` [m] wide."""
        if reading.holding and reading.width >= held - SLIPPED:
            return {"outcome": "grasped", "message": ""}
        if reading.holding:
            message = f"what is held slips: it was {held:.4f} m wide, the fingers are {reading.width:.4f} m apart now"
        else:
            message = f"what was held slipped out: it was {held:.4f} m wide, nothing is between the fingers now"
        return {"outcome": "slipping", "message": message}
