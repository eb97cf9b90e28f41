"""The controller of the arm itself, as the executor uses it: its state, speed slider, payload and orders."""

from __future__ import annotations

from typing import Any

from common.config import GripperConfig
from common.control.interlocks import Interlocks
from common.control.trajectory_controller import TrajectoryController
from common.errors import Refused
from common.hardware.interface import SAFETY_STOPS, ControlledArm, Hardware, SlowedArm, Vector
from common.messages import RobotCommand


class VendorController:
    """Watches and orders the controller of an arm; without one, set-points are always accepted."""

    def __init__(
        self, hardware: Hardware, arm: TrajectoryController, interlocks: Interlocks, gripper: GripperConfig | None
    ) -> None:
        """Use the controller of this hardware, if it has one; a safety stop is one of the `interlocks`."""
        self._controlled = hardware if isinstance(hardware, ControlledArm) else None
        self._slowed = hardware if isinstance(hardware, SlowedArm) else None  # isinstance takes long for a protocol
        self._arm, self._interlocks = arm, interlocks
        self._payload = PayloadReporter(self._controlled, gripper)
        if self._controlled is not None:
            arm.history.delay, arm.gaps.bridges = self._controlled.delay, self._controlled.ahead
            self._controlled.stopped = self._controlled.stopped or interlocks.arm_stopped

    @property
    def slider(self) -> float:
        """Share set by the speed slider of the pendant, 0 to 1."""
        return self._controlled.state.speed if self._controlled is not None else 1.0

    @property
    def late(self) -> float:
        """Longest delay of a cycle of the driver so far [s]."""
        return 0.0 if self._controlled is None else self._controlled.late

    def fields(self, fault: str) -> dict[str, Any]:
        """Return the published state of the arm; one without a controller runs, unless it has a `fault`."""
        if self._controlled is None:
            return {"mode": "fault" if fault else "running", "message": fault}
        state = self._controlled.state
        return {"mode": state.mode, "message": state.message, "speed": state.speed, "inputs": state.inputs,
                "outputs": state.outputs, "controller": True, "resumed": self._arm.gaps.resumed}

    def update(self, held: float, speed_scaling: float) -> bool:
        """Return whether set-points are accepted in this cycle; `held` is the mass in the gripper [kg]."""
        if self._controlled is None:
            return True
        state, self._arm.history.delay = self._controlled.state, self._controlled.delay
        self._arm.reports.speed_scaling = speed_scaling * state.speed
        self._payload.update(held, state.mode == "running", self._arm.at_rest)
        if state.mode == "running":
            return True
        self._arm.fault(state.message or state.mode)  # no pause: its state says when it is over
        return False

    def set_share(self, velocities: Vector, speed_scaling: float) -> None:
        """Set the share of its speed at which the next set-point (dof,) [rad/s] moves an arm with a speed slider."""
        if self._slowed is not None:
            self._slowed.share = self._arm.share_of_speed(velocities, speed_scaling)

    def note_stop(self) -> None:
        """Update the interlock of a safety stop."""
        if self._controlled is not None:
            self._interlocks.arm_stopped = self._controlled.stopped

    def order(self, request: RobotCommand) -> int:
        """Start a function of the arm's own controller; return a number for `outcome`.

        Raises:
            Refused: it has no controller, a goal is being followed, or the arm is in a safety stop (`enable`) or
                without power (`recover`).
        """
        if self._controlled is None:
            raise Refused("no_controller", "this arm has no controller of its own that could do that")
        if request.act == "freedrive" and request.value and self._arm.goal:
            raise Refused("busy", f"goal {self._arm.goal!r} is still being followed: stop it first")
        state = self._controlled.state
        if state.mode in {"enable": SAFETY_STOPS, "recover": ("off",)}.get(request.act, ()):
            raise Refused("robot", f"{request.act}: {state.message or state.mode.replace('_', ' ')}")
        return self._controlled.order(request.act, *request.values)

    def outcome(self, number: int) -> str | None:
        """Return the outcome of an order, once: "" or the reason of its failure; else None."""
        assert self._controlled is not None
        return self._controlled.outcome(number)

    def pop_log_line(self) -> str:
        """Return a line for the log if the payload could not be sent since the last call; else ""."""
        return self._payload.pop_log_line()


class PayloadReporter:
    """Sends the arm's own controller the payload at rest: changed in motion, it may cause a protective stop."""

    def __init__(self, arm: ControlledArm | None, gripper: GripperConfig | None) -> None:
        """Send it to this arm, if it has a controller and the robot file gives the mass of the gripper."""
        self._arm, self._payload = arm, gripper.payload if gripper is not None else None
        self._sent: float | None = None  # held mass that the controller knows [kg]
        self._order = 0  # number of that order
        self._failed = False  # it is sent again after the next motion

    def update(self, held: float, ready: bool, at_rest: bool) -> None:
        """Send the held mass [kg] when it changes, and when the controller has become ready."""
        if not ready or (self._failed and not at_rest):
            self._sent, self._failed = None, False
        elif at_rest and self._arm is not None and self._payload is not None and held != self._sent and not self._order:
            self._sent = held
            self._order = self._arm.order("payload", *self._payload.with_held(held))

    def pop_log_line(self) -> str:
        """Return a line for the log if it could not be sent since the last call; else ""."""
        if self._arm is None or not self._order or (outcome := self._arm.outcome(self._order)) is None:
            return ""
        self._order, self._failed = 0, bool(outcome)
        return outcome and f"the arm did not accept its payload: {outcome}"
