"""The gripper in the control cycle: reads the device, runs commands by the rules of motion, some as the arm arrives."""

from __future__ import annotations

from common.control.devices import DeviceFault, read_gripper
from common.control.gripper_controller import DeferredCommand, GripperController
from common.control.motion_authority import MotionAuthority
from common.control.trajectory_controller import TrajectoryController
from common.control.vacuum import VacuumCup
from common.errors import Refused
from common.hardware.interface import Gripper, HardwareFault, Vector, WorldBackend
from common.messages import CLOSED_BEFORE, GripperCommand, GripperState


class GripperCommands:
    """Runs commands on a gripper next to its arm.

    Attributes:
        fault: whether the gripper works.
        width_rate: of the fingers [m/s].
    """

    def __init__(
        self, device: Gripper, gripper: GripperController, deferred: DeferredCommand, arm: TrajectoryController,
        authority: MotionAuthority, world: WorldBackend | None, vacuum: VacuumCup | None = None,
    ) -> None:
        """Command this gripper, whose fingers objects of a simulated world block; I/O may drive a simulated cup."""
        self._device, self._gripper, self._deferred = device, gripper, deferred
        self._arm, self._authority, self._world, self._vacuum = arm, authority, world, vacuum
        self.fault = DeviceFault("the gripper")
        self.width_rate = 0.0

    def read(self, now: float, q: Vector) -> None:
        """Read the fingers at a time [s], with the arm at q (dof,) [rad]; the simulated world advances."""
        if self.fault.is_paused(now):
            return
        try:
            if self._world is not None:
                self._world.obstruct(q)
            reading = read_gripper(self._device, now)
            if self._world is not None:
                self._world.step(now, q, reading)
            if self._vacuum is not None and self._vacuum is not self._device:
                self._vacuum.sense(reading)
                reading = self._vacuum.read(now)
            self.width_rate = reading.velocity
            self._gripper.update(reading, now)
            self.fault.clear(now)
        except HardwareFault as fault:
            self._fail(fault, now)
            self._gripper.fault(str(fault))

    def _fail(self, fault: HardwareFault, now: float) -> None:
        """Brake the arm along its path: the gripper does not work."""
        self.fault.set(str(fault), now)
        self._arm.abort("hardware_fault", str(fault), "hardware")

    def update_deferred(self, now: float, q: Vector) -> None:
        """Start or cancel a deferred command; stop an arm that arrives late for closing fingers."""
        waiting = self._deferred.command
        blocked = waiting and self._authority.check_interlocks(waiting, waiting.id)
        if waiting is not None and blocked:
            self._deferred.take()
            self._gripper.cancel_deferred(waiting, str(blocked))
        elif waiting is not None and self._deferred.is_due(now, q, self._gripper.state.width):
            try:
                self._gripper.start(waiting, now)
            except HardwareFault as fault:
                self._fail(fault, now)
                self._gripper.cancel_deferred(waiting, str(fault), "hardware_fault")
        if self._deferred.closed_early(now):
            self._arm.abort(CLOSED_BEFORE, "held up or slowed as the fingers began to close")
        if failed := self._deferred.take_failed():
            self._gripper.cancel_deferred(*failed)

    def command(self, request: GripperCommand, now: float, refusal: Refused | None) -> GripperState:
        """Return the state of a goal, which is rejected if there is a `refusal` already."""
        refusal = (self._authority.check_interlocks(request, request.id) or refusal
                   or self._authority.check_owner(request.owner) or self.fault.check()
                   or (self._vacuum.check() if self._vacuum is not None else None))
        deferred = bool(request.after) and request.after == self._arm.goal
        if request.after and not deferred and self._arm.fails(request.after):
            refusal = refusal or Refused("unknown_goal", f"goal {request.after!r} is not followed now")
        try:
            known = self._gripper.knows(request.id)
            state = self._gripper.command(request, now, refusal, deferred)
            if not known:
                self._authority.note_refusal(request, state)
            if not known and state.state == "active":
                self._replace_deferred(request)
                if deferred:
                    self._deferred.wait(request)
            if refusal is None:
                self._authority.use(request.owner)
            return state
        except HardwareFault as fault:
            self.fault.set(str(fault), now)
            self._gripper.fault(str(fault))
            self._replace_deferred(request)
            return self._gripper.command(request, now, self.fault.check())

    def _replace_deferred(self, request: GripperCommand) -> None:
        if (replaced := self._deferred.take()) is not None:
            self._gripper.cancel_deferred(replaced, f"replaced by {request.id!r}")
