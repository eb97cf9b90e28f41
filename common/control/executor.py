"""The executor: requests in, one control cycle at a time, status out. It has no clock, no network and no files.

A cycle reads arm and gripper, advances the simulated world where there is one, sends set-points and reports what has
changed. Requests are checked by the motion authority, which knows interlocks and the owner of the motion.
"""

from __future__ import annotations

from collections.abc import Callable

from common.config import GripperConfig
from common.control.devices import DeviceFault, call_device, read_joints
from common.control.force_requests import FORCE_LIMITS, ForceLimits, ForceRequests
from common.control.force_sensing import ForceSensing
from common.control.goals import Assessment, ForceControl
from common.control.gripper_commands import GripperCommands
from common.control.gripper_controller import DeferredCommand, GripperController
from common.control.interlocks import Interlocks
from common.control.jogging import Jogging, ToolKinematics
from common.control.joining import Join
from common.control.motion_authority import MotionAuthority
from common.control.status import ChangeDetector, Report, joint_state
from common.control.trajectory import Tolerances, Trajectory
from common.control.trajectory_controller import PERIOD, TrajectoryController
from common.control.vacuum import VacuumCup
from common.control.vendor_controller import VendorController
from common.errors import ConfigError, Refused
from common.hardware.interface import (
    Hardware,
    HardwareFault,
    Interrupted,
    Limits,
    PersistedState,
    Vector,
    WorldBackend,
)
from common.messages import (
    ConveyorSet,
    ConveyorState,
    ExecuteRequest,
    ForceMotion,
    GripperCommand,
    GripperState,
    Header,
    JogCommand,
    JointState,
    MotionStatus,
    RobotStatus,
    SetPoints,
)


class Executor:
    """Controls an arm, its gripper and, with simulated hardware, the world around them.

    Attributes:
        arm: follows trajectories.
        gripper: commands the fingers; None without a gripper.
        authority: decides which motions may start.
        force: the wrench at the tool in this cycle.
        world: the simulated world; None with real hardware.
        force_motions: checks force motions and watches their requester.
        vendor: the arm's own controller, which only real arms have.
        vacuum: the gripper, if it is a cup that the cell's I/O drives.
    """

    def __init__(
        self,
        hardware: Hardware,
        limits: Limits,
        start: Vector,
        *,
        tolerances: Tolerances | None = None,
        gripper: GripperConfig | None = None,
        controller: str = "controller",
        kinematics: ToolKinematics | None = None,
        world: WorldBackend | None = None,
        vacuum: VacuumCup | None = None,
        interlocks: Interlocks | None = None,
        force: ForceSensing | None = None,
        period: float = PERIOD,
        force_limits: ForceLimits = FORCE_LIMITS,
    ) -> None:
        """Control this hardware every `period` [s], subject to `interlocks`; jog the tool if there are kinematics.

        Raises:
            ConfigError: the robot has a gripper, but the hardware has none.
        """
        if gripper is not None and hardware.gripper is None:
            raise ConfigError("robot.hardware.backend", type(hardware).__name__,
                              "has no gripper, but the robot has one: name its backend in robot.gripper.hardware")
        self._hardware, self._limits, self._gripper_config = hardware, limits, gripper
        self.world, self.force, self.vacuum = world, force or ForceSensing(hardware), vacuum
        self.arm = TrajectoryController(limits, start, tolerances, name=controller, period=period)
        self._q = start.copy()
        self._was_read = False  # whether the position of the arm is known
        self._speed_scaling = 1.0  # as operators and programs set it
        self._followed: ExecuteRequest | None = None  # newest accepted goal
        self._arm_fault = DeviceFault("the arm")
        self._changes = ChangeDetector(self.arm)
        self._interlocks = interlocks or Interlocks()
        self.force_motions = ForceRequests(limits, kinematics, force_limits, period)
        self.vendor = VendorController(hardware, self.arm, self._interlocks, gripper)
        self.authority = MotionAuthority(self.arm, Jogging(limits, kinematics), self._interlocks)
        self.gripper, self._commands = None, None
        if gripper is not None and hardware.gripper is not None:
            self.gripper = GripperController(vacuum or hardware.gripper, gripper)
            self._commands = GripperCommands(
                hardware.gripper, self.gripper, DeferredCommand(self.arm, kinematics), self.arm, self.authority, world,
                vacuum)

    # --- the cycle ------------------------------------------------------------------------------------------------

    def cycle(self, header: Header) -> Report:
        """Do one cycle at the header's time; return what has changed."""
        now = header.stamp * 1e-9
        report = Report()
        if not self._arm_fault.is_paused(now):
            try:
                report.joints = self._control_devices(header, now)
            except HardwareFault as fault:
                self._arm_fault.set(str(fault), now)
                self.arm.fault(str(fault))
                self.force.lose(str(fault))
                self.authority.interrupt_jogging()
        if self._commands is not None:
            self._commands.update_deferred(now, self._q)
        self.vendor.note_stop()
        moving = self.gripper is not None and self.gripper.state.moving
        self.authority.update(bool(self.arm.goal) or not self.arm.at_rest or moving)
        self._report_changes(report, header)
        return report

    def _control_devices(self, header: Header, now: float) -> JointState:
        """Read the devices and send set-points; return the joint state.

        Raises:
            HardwareFault: the arm does not work.
        """
        self._q, dq = read_joints(self._hardware, len(self._q), now)
        self._was_read = True
        if self._commands is not None:
            self._commands.read(now, self._q)
        held = self.gripper.held_mass if self.gripper is not None else 0.0
        self.force.update(now, self._q, dq, held, self.arm.at_rest)
        if self.vendor.update(held, self._speed_scaling):
            self.arm.jog(self.authority.jog_velocity(self._speed_scaling), self.vendor.slider)
            if gone := self.force_motions.sense(self.arm, self._q, self.force):
                self.arm.abort("requester_gone", gone)
            set_points = self.arm.update(now, self._q, dq)
            if set_points is not None:
                self._send(*set_points, now)
        else:
            self.authority.interrupt_jogging()
        width = self.gripper.state.width if self.gripper is not None else 0.0
        rate = self._commands.width_rate if self._commands is not None else 0.0
        return joint_state(header, self._limits.names, self._q, dq, self._gripper_config, width, rate)

    def _send(self, positions: Vector, velocities: Vector, now: float) -> None:
        self.vendor.set_share(velocities, self._speed_scaling)
        try:
            call_device("sending set-points", self._hardware.write, positions, velocities, now)
            self._arm_fault.clear(now)
        except Interrupted as reason:
            self.arm.interrupt(str(reason), now)

    def _report_changes(self, report: Report, header: Header) -> None:
        report.wrench = self.force.due(header)
        report.robot = self._changes.robot(header, self.vendor.fields(self._arm_fault.reason), self.vendor.late)
        gripper_line = self._commands.fault.pop_log_line() if self._commands is not None else ""
        report.notes = [*filter(None, (self._arm_fault.pop_log_line(), gripper_line, self.arm.pop_log_line(),
                                       self.vendor.pop_log_line()))]
        report.owner = self.authority.changed_owner(header)
        report.motion = self.changed_motion(header)
        if self.gripper is not None:
            report.gripper = self._changes.gripper(header, self.gripper.state)
        if self.world is not None:
            report.updates, report.objects = self.world.updates(header)
            report.conveyors = self.world.conveyors(header, max((s.since for s in self._interlocks.stops), default=0))
            self.world.save(PersistedState(self._q, *(
                (self.gripper.state.width, self.gripper.commanded_width, self.gripper.commanded_effort)
                if self.gripper is not None else ())))

    def changed_motion(self, header: Header) -> MotionStatus | None:
        """Return the status of the motion if it has changed since it was last returned."""
        return self._changes.motion(header)

    # --- requests -------------------------------------------------------------------------------------------------

    def takes_long(self, request: ExecuteRequest) -> bool:
        """Return whether assessing the request takes longer than there is time between two cycles."""
        return self.arm.takes_long(request.id, request.trajectory)

    def assess(self, request: ExecuteRequest) -> Assessment:
        """Return whether and how the arm can follow the trajectory; any thread may call it."""
        return self.arm.assess(request.trajectory, self._q)

    def move_by_force(self, request: ForceMotion, now: float, refusal: Refused | None = None) -> MotionStatus:
        """Return the state of a force motion, as `execute` does. A request without points repeats a known one."""
        if not request.trajectory.points:
            self.force_motions.seen(request, self.arm.goal)
            return self.arm.reports.get(request.id) or self.arm.reports.unknown(request.id)
        followed = ExecuteRequest(**{name: getattr(request, name) for name in ExecuteRequest.model_fields})
        refusal = refusal or self.force_motions.check(request, self.force.reason)
        status = self.execute(followed, now, refusal, force=self.force_motions.follower(request))
        self.force_motions.seen(request, self.arm.goal)
        return status

    def execute(self, request: ExecuteRequest, now: float, refusal: Refused | None = None,
                assessment: Assessment | None = None,
                force: Callable[[Trajectory, Vector], ForceControl] | None = None) -> MotionStatus:
        """Return the state of the goal: active, or rejected with the reason; of a known id its present state."""
        authority, known = self.authority, self.arm.knows(request.id)
        refusal = (authority.check_interlocks(request, request.id) or refusal or authority.check_owner(request.owner)
                   or self._check_devices())
        join = Join(request.joins, request.join_time) if request.joins else None
        status = self.arm.accept(request.id, request.trajectory, now, self._q, refusal, assessment, request.plan,
                                 request.scene_stamp, join, force, request.start_at * 1e-9)
        if not known:
            authority.note_refusal(request, status)
        if request.id == self.arm.goal and (self._followed is None or self._followed.id != request.id):
            self._followed = request
            authority.use(request.owner)
            if request.joins:
                authority.continue_hold(request.joins, request.id)
        return status

    def _check_devices(self) -> Refused | None:
        fault = self._commands.fault.check() if self._commands is not None else None
        if fault is None and not self._was_read and not self._arm_fault.reason:
            return Refused("hardware_fault", "no joint reading received yet")
        return fault

    def jog(self, request: JogCommand, refusal: Refused | None = None) -> None:
        """Jog the arm until the next command is overdue, unless there is a `refusal` already.

        Raises:
            Refused: with the reason. Commands count again after a pause.
        """
        self.authority.jog(request, refusal or self._check_devices())

    def followed(self, goal: str) -> ExecuteRequest:
        """Return the request of the goal that is followed; after a join, with the complete path.

        Raises:
            Refused: another goal, or none, is followed.
        """
        if self._followed is None or not goal == self._followed.id == self.arm.goal:
            raise Refused("unknown_goal", f"goal {goal!r} is not followed now")
        if self._followed.joins:
            return self._followed.model_copy(update={"trajectory": self.arm.path})
        return self._followed

    def command_gripper(self, request: GripperCommand, now: float, refusal: Refused | None = None) -> GripperState:
        """Return the state of the gripper's goal, which is rejected if there is a `refusal` already.

        Raises:
            Refused: this robot has no gripper.
        """
        if self._commands is None:
            raise Refused("no_gripper", "this robot has no gripper")
        return self._commands.command(request, now, refusal)

    def set_conveyor(self, request: ConveyorSet, header: Header, refusal: Refused | None = None) -> ConveyorState:
        """Start or stop a belt, by the rules of motion; stopping is open to everyone.

        Raises:
            Refused: a `refusal` already, an interlock, another owner, or the belt cannot do that.
        """
        if self.world is None:
            raise Refused("not_simulated", "the belts of this cell are not simulated")
        if request.running is not False or request.speed is not None:
            interlock = self.authority.interlocks.check("", request.owner, request.acknowledged)
            if refusal := interlock or refusal or self.authority.check_owner(request.owner):
                raise refusal
        return self.world.set_conveyor(request, header)

    @property
    def robot(self) -> RobotStatus:
        """State of the arm."""
        return RobotStatus(**self.vendor.fields(self._arm_fault.reason), late=self.vendor.late)

    @property
    def speed_scaling(self) -> float:
        """Share of their speed at which trajectories are followed, 0 to 1; the arm's slider reduces it further."""
        return self._speed_scaling

    @speed_scaling.setter
    def speed_scaling(self, share: float) -> None:
        self._speed_scaling = share
        self.arm.reports.speed_scaling = share * self.vendor.slider

    def set_points(self, header: Header) -> SetPoints:
        """Return what was commanded last."""
        return SetPoints(header=header, name=list(self._limits.names), position=self.arm.set_point.tolist(),
                         width=self.gripper.commanded_width if self.gripper is not None else None)

    def restore(self, now: float) -> None:
        """Continue what simulated hardware did before a restart, at a time [s]."""
        state = self.world.restore(stopped=bool(self._interlocks.stops)) if self.world is not None else None
        gripper = self._hardware.gripper
        if state is None or self.gripper is None or gripper is None:
            return
        if self.vacuum is not None:
            self.vacuum.restore(state.width or 0.0, now)
        elif state.commanded_width is not None:
            self.gripper.resume(state.commanded_width, now, state.commanded_effort)
        self.gripper.update((self.vacuum or gripper).read(now), now)

    def close(self) -> None:
        """Release the hardware, and close the world."""
        self._hardware.close()
        if self.world is not None:
            self.world.close()
