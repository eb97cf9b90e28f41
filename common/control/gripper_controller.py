"""Gripper goals: one at a time, a new one replaces the running one, a repeated id only returns its state.

A grasp is checked by the width that is held, and a held object is watched until the next command. A command may be
deferred until shortly before the end of a goal of the arm.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from common.config import GripperConfig
from common.control.devices import call_device
from common.control.goals import REMEMBERED, GoalMemory
from common.control.jogging import ToolKinematics
from common.control.trajectory_controller import TrajectoryController
from common.control.vacuum import VacuumCup
from common.errors import Refused
from common.hardware.interface import Gripper, GripperReading, Vector
from common.messages import GripperCommand, GripperState
from common.robot.finger_joints import driven_position

SETTLED = 1e-3  # [m] fingers that stop this close to the commanded width have reached it
SLIPPED = 2e-3  # [m] a held object slips once the fingers are closer by this
LATER = 0.05  # [s] by which an arm may arrive later than expected when the fingers started to close


class GripperController:
    """Commands the fingers and reports the state of each goal."""

    def __init__(self, gripper: Gripper, config: GripperConfig, remember: int = REMEMBERED) -> None:
        """Command this gripper; `remember` so many goals by their ids."""
        self._gripper = gripper
        self._config = config
        self._memory: GoalMemory[GripperState] = GoalMemory(remember)
        self._target: float | None = None  # commanded width [m]
        self._request: GripperCommand | None = None
        self._commanded_at = self._moved_at = -math.inf  # newest command, newest reading of moving fingers [s]
        self._start_width = 0.0  # at the newest command [m]
        self._has_moved = False  # whether fingers were seen moving towards the target since
        self._held: float | None = None  # width of a grasped object [m]
        self._effort = config.effort
        self.state = GripperState(source=config.controller)

    def command(
        self, request: GripperCommand, now: float, refusal: Refused | None = None, deferred: bool = False,
    ) -> GripperState:
        """Return the state of the goal: active, or rejected with the reason; of a known id its present state.

        Args:
            request: for the fingers.
            now: cell time [s].
            refusal: reason to reject a new goal.
            deferred: whether the fingers start at a later call of `start`; until then they continue what they do.

        Raises:
            HardwareFault: the gripper does not work.
        """
        known = self._memory.get(request.id)
        if known is not None:
            return known
        refusal = refusal or self._check(request)
        if refusal is not None:
            rejected = GripperState.model_validate({
                **self._reading, "id": request.id, "state": "rejected", "error": refusal.code, "message": str(refusal)})
            return self._memory.put(request.id, rejected, refused=True)
        if deferred:
            message = f"waits for goal {request.after!r}"
            waiting = {**self._reading, "id": request.id, "state": "active", "message": message}
            return self._memory.put(request.id, GripperState.model_validate(waiting))
        return self.start(request, now)

    def _check(self, request: GripperCommand) -> Refused | None:
        """Return what the gripper cannot do, without an error code."""
        config = self._config
        if request.width > config.max_width:
            return Refused("", f"width {request.width:g} m is more than the fingers open ({config.max_width:g} m)")
        if request.effort > config.max_effort:
            return Refused("", f"effort {request.effort:g} N is more than the fingers have ({config.max_effort:g} N)")
        if (request.expected_width or 0.0) > config.max_width:
            return Refused("", f"expected_width {request.expected_width:g} m is more than the fingers open "
                               f"({config.max_width:g} m)")
        return None

    def start(self, request: GripperCommand, now: float) -> GripperState:
        """Start a valid goal at a time [s] and return its state.

        Raises:
            HardwareFault: the gripper does not work.
        """
        if isinstance(self._gripper, VacuumCup):
            self._gripper.request = request
        self._send(request.width, now, request.effort)
        if self.state.state == "active":
            replaced = {"state": "cancelled", "message": f"replaced by {request.id!r}"}
            self._memory.put(self.state.id, self.state.model_copy(update=replaced))
        self._request = request
        self.state = GripperState.model_validate({**self._reading, "moving": True, "id": request.id, "state": "active"})
        return self._memory.put(request.id, self.state)

    def cancel_deferred(self, request: GripperCommand, why: str, error: str = "") -> None:
        """Cancel a deferred goal, or abort it for an error; the fingers continue what they do."""
        ended = {"id": request.id, "state": "aborted" if error else "cancelled", "error": error, "message": why}
        if self.state.state == "active":
            self._memory.put(request.id, self.state.model_copy(update=ended))
        else:
            self.state = self._memory.put(request.id, self.state.model_copy(update=ended))

    @property
    def _reading(self) -> dict[str, Any]:
        """Measured part of the state."""
        return self.state.model_dump(include={"width", "position", "effort", "holding", "moving", "source"})

    def knows(self, goal: str) -> bool:
        """Return whether a goal is known."""
        return self._memory.get(goal) is not None

    def fault(self, message: str) -> None:
        """Abort the goal: the gripper does not work."""
        if self.state.state == "active":
            failed = {"state": "aborted", "error": "hardware_fault", "message": message}
            self.state = self._memory.put(self.state.id, self.state.model_copy(update=failed))

    @property
    def commanded_width(self) -> float | None:
        """Width of the newest command [m]; None before the first."""
        return self._target

    @property
    def commanded_effort(self) -> float:
        """Effort of the newest command [N]."""
        return self._effort

    @property
    def held_mass(self) -> float:
        """Mass of the grasped object [kg]; 0 without one, or if the command did not give it."""
        return self._request.mass if self._request is not None and self.state.outcome == "grasped" else 0.0

    def resume(self, width: float, now: float, effort: float = 0.0) -> None:
        """Continue moving to the width [m] or pressing with the effort [N] of a command before this process started."""
        self._send(width, now, effort)

    def _send(self, width: float, now: float, effort: float) -> None:
        effort = effort or self._config.effort
        call_device("moving the gripper", self._gripper.command, width, now, effort)
        self._effort = effort
        self._target, self._commanded_at, self._held = width, now, None
        self._start_width, self._has_moved = self.state.width, False

    def update(self, reading: GripperReading, now: float) -> GripperState:
        """Return the state with the newest reading, at a time [s]: a goal is over when the fingers have stopped."""
        state = self.state
        self._moved_at = now if reading.moving else self._moved_at
        self._has_moved = self._has_moved or (
            self._target is not None and reading.moving and self._moves_to_target(reading.width))
        over = state.state == "active" and self._has_stopped(reading, now)
        changes: dict[str, object] = {
            "width": reading.width, "position": driven_position(self._config, reading.width),
            "effort": reading.effort, "holding": reading.holding,
            "moving": reading.moving or (state.state == "active" and not over),
        }
        if over:
            changes |= self._result(reading)
        else:
            if state.state == "none" and self._held is None and reading.holding and not reading.moving:
                self._held = reading.width  # grasped before this process started
            if self._held is not None:
                changes |= self._watch_held(reading, self._held)
        if not changes.items() <= vars(state).items():
            self.state = state.model_copy(update=changes)
        if self.state.id:
            self._memory.put(self.state.id, self.state)
        return self.state

    def _moves_to_target(self, width: float) -> bool:
        """Return whether fingers at a width [m] have moved towards the target since the newest command."""
        assert self._target is not None
        return (width - self._start_width) * math.copysign(1.0, self._target - self._start_width) > SETTLED

    def _has_stopped(self, reading: GripperReading, now: float) -> bool:
        """Return whether the fingers have done what they can.

        Readings may be from before the command, or report late that the fingers press on something, unless the fingers
        were seen moving.
        """
        assert self._target is not None
        if reading.moving:
            return False
        if abs(reading.width - self._target) <= SETTLED or (reading.holding and self._has_moved):
            return True
        since = self._commanded_at if reading.holding else max(self._commanded_at, self._moved_at)
        return now - since >= self._config.latency

    def _result(self, reading: GripperReading) -> dict[str, object]:
        """Return the outcome of the goal, by a reading of fingers that have stopped."""
        assert self._target is not None and self._request is not None
        expected, width = self._request.expected_width, reading.width
        if reading.holding and self._target <= width + SETTLED:
            off = 0.0 if expected is None else width - expected
            if expected is None or abs(off) <= self._request.width_tolerance:
                self._held = width
                return {"state": "succeeded", "outcome": "grasped"}
            found = "wide" if off > 0 else "narrow"
            message = f"the fingers closed on something too {found} ({width:.4f} m, not {expected:.4f} m)"
            return {"state": "aborted", "outcome": f"too_{found}", "message": message}
        if abs(width - self._target) > SETTLED and (reading.message or not reading.holding):
            message = reading.message or f"fingers stopped at {width:.4f} m, not at {self._target:.4f} m"
            return {"state": "aborted", "message": message}
        if expected is not None:
            message = reading.message or "the fingers closed on nothing"
            return {"state": "aborted", "outcome": "empty", "message": message}
        return {"state": "succeeded", "message": reading.message if self._target < self._start_width else ""}

    def _watch_held(self, reading: GripperReading, held: float) -> dict[str, object]:
        """Return whether an object, `held` [m] wide, is still grasped."""
        if reading.holding and reading.width >= held - SLIPPED:
            return {"outcome": "grasped", "message": reading.message}
        if self._config.cup is not None:
            why = f": {reading.message}" if self._config.vacuum is not None and reading.message else ""
            message = f"the held object came off the cup{why}"
        elif reading.holding:
            message = f"the held object slips: it was {held:.4f} m wide, the fingers are {reading.width:.4f} m apart"
        else:
            message = f"the held object slipped out: it was {held:.4f} m wide, nothing is between the fingers now"
        return {"outcome": "slipping", "message": message}


class DeferredCommand:
    """A gripper command that waits for a goal of the arm; and whether the arm arrives in time for closing fingers.

    Attributes:
        command: the waiting command, or None.
    """

    def __init__(self, arm: TrajectoryController, kinematics: ToolKinematics | None) -> None:
        """Wait for this arm; without kinematics, until it has arrived."""
        self._arm, self._kinematics = arm, kinematics
        self.command: GripperCommand | None = None
        self._end: Vector | None = None  # TCP position at the end of the goal, (3,) in world [m]
        self._closing_for = ""  # goal for whose end the fingers started to close
        self._arrival = math.inf  # expected cell time of that end [s]

    def wait(self, command: GripperCommand) -> None:
        """Defer a command until the goal that is followed is about to end."""
        self.command = command
        self._end = self._tcp(self._arm.end) if self._arm.end is not None else None

    def take(self) -> GripperCommand | None:
        """Return the waiting command, and stop waiting."""
        command, self.command = self.command, None
        return command

    def is_due(self, now: float, measured: Vector, width: float) -> bool:
        """Return whether the waiting command is to start, and stop waiting then.

        Args:
            now: cell time [s].
            measured: position of the arm (dof,) [rad].
            width: of the fingers [m].
        """
        command = self.command
        if command is None:
            return False
        left, arrived = self._arm.time_to_end(command.after), self._arm.succeeded(command.after)
        if not arrived and (left > command.lead or not self._is_near(measured, command.within)):
            return False
        self.command = None
        if command.width < width and not arrived:
            self._closing_for, self._arrival = command.after, now + left
        return True

    def take_failed(self) -> tuple[GripperCommand, str] | None:
        """Return the waiting command, and the reason, if the arm does not arrive; and stop waiting."""
        command = self.command
        if command is None or not self._arm.fails(command.after):
            return None
        self.command = None
        return command, f"goal {command.after!r} of the arm ends before it is reached"

    def closed_early(self, now: float) -> bool:
        """Return once whether fingers started to close for an arm that does not arrive in time."""
        if not self._closing_for:
            return False
        if self._arm.fails(self._closing_for):  # it comes to rest already, for a reason of its own
            self._closing_for = ""
            return False
        left = self._arm.time_to_end(self._closing_for)
        late = now + left > self._arrival + LATER
        if left == 0.0 or late:
            self._closing_for = ""
        return late and left > 0.0

    def _tcp(self, q: Vector) -> Vector | None:
        return None if self._kinematics is None else np.array(self._kinematics.fk(q)[:3, 3])

    def _is_near(self, q: Vector, within: float) -> bool:
        tcp = self._tcp(q)
        return tcp is not None and self._end is not None and float(np.linalg.norm(tcp - self._end)) <= within
