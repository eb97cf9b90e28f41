"""One cycle of control: read the joints, move the world on, judge and send set-points. The service gives it time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from common.config import GripperConfig
from common.control.checks import Tolerances
from common.control.controller import PERIOD, TrajectoryController
from common.control.faults import Fault, asked
from common.control.goals import Judged
from common.control.gripper_controller import GripperController
from common.control.inhibits import SOMEBODY, Inhibits
from common.control.jogging import Jogging, ToolKinematics
from common.control.ownership import NOT_OWNER, Ownership
from common.errors import ConfigError, Refused
from common.hardware.interface import ControlledArm, Hardware, HardwareFault, Limits, SimulatedGripper, Vector
from common.messages import (
    ExecuteRequest,
    GripperCommand,
    GripperState,
    Header,
    HoldRequest,
    Inhibit,
    JogCommand,
    JointState,
    MotionOwner,
    MotionStatus,
    OwnRequest,
    RobotCommand,
    RobotStatus,
    SceneUpdate,
    StopRequest,
    WorldEdit,
    WorldEditReply,
    WorldObjects,
)
from common.robot.finger_joints import finger_positions, finger_velocities
from common.sim.interface import SimulatedWorld, StandingObject
from common.sim.standing import Standing
from common.sources import monotonic

PROGRESS_PERIOD = 0.1  # cell time between reports of progress [s]
WORLD_PERIOD = 0.05  # cell time between reports of an object that moves [s]


@dataclass
class Report:
    """What there is to say after a cycle; None where nothing is new."""

    joints: JointState | None = None
    motion: MotionStatus | None = None
    gripper: GripperState | None = None
    objects: WorldObjects | None = None
    updates: list[SceneUpdate] = field(default_factory=list)
    robot: RobotStatus | None = None
    owner: MotionOwner | None = None
    notes: list[str] = field(default_factory=list)  # for the log


class ControlCycle:
    """The arm, its gripper and, with simulated hardware, the world about it."""

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
        world: SimulatedWorld | None = None,
        inhibits: Inhibits | None = None,
        period: float = PERIOD,
    ) -> None:
        """Control this hardware every `period` [s], unless `inhibits` keep it.

        `world` comes with simulated hardware only, and then `kinematics` must; without them the tool is not jogged.

        Raises:
            ConfigError: the backend's gripper cannot feel the simulated world, or it has none.
        """
        self._hardware, self._limits = hardware, limits
        self._kinematics, self._world = kinematics, world
        self._arm = TrajectoryController(limits, start, tolerances, name=controller, period=period)
        self._gripper: GripperController | None = None
        self._fingers = gripper
        self._obstructible: SimulatedGripper | None = None
        if gripper is not None:
            backend = type(hardware).__name__
            if hardware.gripper is None:
                raise ConfigError("robot.hardware.backend", backend, "has no gripper, but the robot has one")
            if world is not None:
                if not isinstance(hardware.gripper, SimulatedGripper):
                    raise ConfigError("robot.hardware.backend", backend, "is simulated: its gripper needs obstruct()")
                self._obstructible = hardware.gripper
            self._gripper = GripperController(hardware.gripper, gripper)
        self._q = start.copy()
        self._found = False  # whether the arm was read
        self._own = hardware if isinstance(hardware, ControlledArm) else None
        if self._own is not None:
            self._arm.delay, self._arm.bridges = self._own.delay, self._own.ahead
        self._cap = 1.0  # of the speed, as persons and programs say
        self._told_robot: dict[str, Any] | None = None
        self._carried: float | None = None  # [kg] that the arm's controller was told is held
        self._payload = 0  # number of that order
        self._untold = False  # whether it came to nothing: it is given again when the arm has moved
        self._arm_fault, self._hand_fault = Fault("the arm"), Fault("the gripper")
        self._width_rate = 0.0
        self._told_motion: MotionStatus | None = None
        self._said: tuple[object, ...] = ()  # by the arm, when that was told
        self._told_motion_at = self._told_gripper_at = self._told_world_at = -np.inf
        self._told_gripper: GripperState | None = None
        self._told_version = -1
        self.beside = False  # whether somebody does what is due
        self.due: Callable[[], None] | None = None  # to be done beside the cycles: the world stands still until then
        self.apart = False  # the world is changed by somebody else, and stands still here
        self._kept: object = None
        self._stood: tuple[int, dict[str, StandingObject]] | None = None  # the objects, as of a version of the world
        self._waits = False  # held by ourselves
        self._jogging = Jogging(limits, kinematics)
        self._owners = Ownership()
        self._jogged = False  # until the arm rests
        self._told_owner: tuple[MotionOwner, bool] | None = None
        self._followed: ExecuteRequest | None = None  # the newest goal that was accepted
        self._held_goal = ""  # that the scene monitor holds
        self._inhibits = inhibits or Inhibits()
        if self._own is not None:
            self._own.stopped = self._own.stopped or self._inhibits.arm_stopped
        self.tell_inhibits()

    def step(self, header: Header) -> Report:
        """Do one cycle at the header's time and say what is new."""
        now = header.stamp * 1e-9
        report = Report()
        if not self._arm_fault.waits(now):
            try:
                report.joints = self._control(header, now)
            except HardwareFault as fault:
                self._arm_fault.failed(str(fault), now)
                self._arm.fault(str(fault))
                self._jogging.interrupt(monotonic())
        if self._own is not None:
            self._inhibits.arm_stopped = self._own.stopped
        report.robot = self._news_of_robot(header)
        report.notes = [*filter(None, (self._arm_fault.news(), self._hand_fault.news(), self._arm.news(),
                                       self._news_of_payload()))]
        if self._held_goal and self._held_goal != self._arm.goal:  # nothing is in the way of what is over
            self.hold(HoldRequest(hold=False, by="scene_monitor"))
        self._owners.look(bool(self._arm.goal) or not self._arm.at_rest or self._fingers_move, monotonic())
        report.owner = self._news_of_owner(header)
        report.motion = self._news_of_motion(header, now)
        report.gripper = self._news_of_gripper(header, now)
        if self._world is not None and not self.apart:
            report.updates = [update.model_copy(update={"header": header}) for update in self._world.take_events()]
            due = now - self._told_world_at >= WORLD_PERIOD or bool(report.updates)
            if self._world.version != self._told_version and due:
                report.objects = self._world.objects(header)
                self._told_version, self._told_world_at = self._world.version, now
        return report

    def _control(self, header: Header, now: float) -> JointState:
        """The joints as they are, after new set-points were sent.

        Raises:
            HardwareFault: the arm does not work.
        """
        q, dq = asked("reading joints", self._hardware.read, now)
        for what, values in (("positions", q), ("velocities", dq)):
            if np.shape(values) != self._q.shape or not np.isfinite(values).all():
                raise HardwareFault(f"reading joints: {what} are not {len(self._q)} finite numbers: {values}")
        self._q, self._found = q, True
        try:
            self._step_gripper(now)
        except HardwareFault as fault:
            self._hand_fault.failed(str(fault), now)
            self._arm.abort("hardware_fault", str(fault), "hardware")
            if self._gripper is not None:
                self._gripper.fault(str(fault))
        if self._own is not None:
            own, self._arm.delay = self._own.state, self._own.delay
            self._arm.speed_scaling = self._cap * own.speed
            self._tell_payload(own.mode == "running")
            if own.mode != "running":  # there is no need to leave it alone: it says how it is
                self._arm.fault(own.message or own.mode)
                self._jogging.interrupt(monotonic())
                return self._joint_state(header, dq)
        self._arm.jog(self._jogging.velocity(self._arm.set_point, monotonic(), self._arm.speed_scaling))
        set_points = self._arm.update(now, self._q, dq)
        if set_points is not None:
            asked("sending set-points", self._hardware.write, *set_points, now)
            self._arm_fault.works(now)
        return self._joint_state(header, dq)

    def _tell_payload(self, ready: bool) -> None:
        """Have the arm's controller know what it carries, at rest: when that changes, and when it is ready anew."""
        if not ready or (self._untold and not self._arm.at_rest):
            self._carried, self._untold = None, False
        elif not self._arm.at_rest or self._own is None:
            return
        elif self._gripper is not None and self._fingers is not None and self._fingers.payload is not None:
            held = self._gripper.held_mass
            if held != self._carried and not self._payload:
                self._carried = held
                self._payload = self._own.order("payload", *self._fingers.payload.with_held(held))

    def _news_of_payload(self) -> str:
        if self._own is None or not self._payload or (outcome := self._own.outcome(self._payload)) is None:
            return ""
        self._payload, self._untold = 0, bool(outcome)
        return outcome and f"the arm was not told what it carries: {outcome}"

    def standing(self) -> Standing | None:
        """What simulated hardware would be found like after a restart, if it has changed since the last call."""
        if self._world is None or self.apart:
            return None
        width = self._gripper.state.width if self._gripper else None
        told = self._gripper.told if self._gripper else None
        effort = self._gripper.effort if self._gripper else 0.0
        mark = (self._q.tobytes(), width, told, effort, self._world.version)
        if mark == self._kept:
            return None
        if self._stood is None or self._stood[0] != self._world.version:
            self._stood = self._world.version, dict(self._world.standing())
        self._kept = mark
        return Standing.model_construct(  # which copies nothing: what is the same object need not be written anew
            layout=self._world.layout, q=self._q.tolist(), width=width, told_width=told,
            told_effort=effort, objects=self._stood[1],
        )

    def restore(self, state: Standing, now: float) -> None:
        """Find fingers and world as they were; the arm was begun where it stood."""
        assert self._world is not None
        self._world.restore(state.objects)
        if self._gripper is None or self._obstructible is None or self._kinematics is None or state.width is None:
            return
        self._obstructible.place(state.width)
        self._obstructible.obstruct(self._world.obstruction(self._kinematics.fk(self._q), state.width))
        if state.told_width is not None:
            self._gripper.resume(state.told_width, now, state.told_effort)
        self._gripper.update(self._obstructible.read(now), now)

    def takes_long(self, request: ExecuteRequest) -> bool:
        """Whether to `judge` the request takes longer than there is time for between two cycles."""
        return self._arm.takes_long(request.id, request.trajectory)

    def judge(self, request: ExecuteRequest) -> Judged:
        """Whether and how the arm can do what is asked; nothing is changed by it: any thread may ask."""
        return self._arm.judge(request.trajectory, self._q)

    def execute(
        self, request: ExecuteRequest, now: float, objection: Refused | None = None, judged: Judged | None = None
    ) -> MotionStatus:
        """The state of the goal: active, or rejected with the reason; for a known id what became of it."""
        inhibited = self._inhibits.objection(request.id, request.owner, request.heard)
        others = self._owners.objection(request.owner)
        status = self._arm.accept(
            request.id, request.trajectory, now, self._q, inhibited or objection or others or self._unfit, judged,
            request.plan, request.scene_stamp,
        )
        if status.error == NOT_OWNER and not request.owner and self._owners.now.asked:
            # A task that was kept from going on does not do so by itself once the motion is given back.
            self._inhibits.stop(StopRequest(reason=str(others), owner=self._owners.now.owner))
            self.tell_inhibits()
        if request.id == self._arm.goal and (self._followed is None or self._followed.id != request.id):
            self._followed = request
            self._owners.use(request.owner, monotonic())
        return status

    @property
    def _unfit(self) -> Refused | None:
        """Why nothing can be moved."""
        if self._hand_fault.objection is None and not self._found and not self._arm_fault.reason:
            return Refused("hardware_fault", "nobody knows yet where the arm is")
        return self._hand_fault.objection

    def jog(self, request: JogCommand, late: Refused | None = None) -> None:
        """Move the arm while that comes again and again, unless it comes too `late`.

        Raises:
            Refused: with the reason. It counts again after a pause.
        """
        objection = late or self._inhibits.objection("", request.owner, request.heard) or self._unfit
        if objection is None and self._arm.status.fault:
            objection = Refused("hardware_fault", self._arm.status.fault)
        if objection is None and self._arm.status.held:
            objection = Refused("held", self._arm.status.message or "the robot is held")
        objection = objection or self._owners.objection(request.owner)
        if objection is None and self._arm.goal:
            objection = Refused("busy", f"goal {self._arm.goal!r} is still being followed")
        self._jogging.ask(request, monotonic(), objection)
        self._owners.use(request.owner, monotonic())

    def own(self, request: OwnRequest, now: float) -> MotionOwner:
        """Whose the motion is, after it was asked for or given back.

        What is taken over is brought to rest. A task that lost it waits for a person to start it again, as after a
        stop, so that no restart of anything has it go on.

        Raises:
            Refused: it is somebody else's.
        """
        if request.act == "give":
            self._owners.give(request.owner)
            return self.owner
        before = self._owners.take(request, monotonic())
        reason = f"{request.owner} took the motion over{before and f', which was {before}'}"
        if request.over and request.kind != "task":
            self._inhibits.stop(StopRequest(reason=reason, owner=request.owner))  # also of who is just being restarted
        if before or request.over:
            self._jogging.interrupt(monotonic())
            if goal := self._arm.goal:
                self._inhibits.never([goal])
                self._arm.cancel(goal, reason, now)
            self.tell_inhibits()
        return self.owner

    def disown(self) -> None:
        """Have the motion be nobody's once what moves has ended: the task that had it is gone."""
        if self._owners.now.kind == "task":
            self._owners.let_end()

    @property
    def owner(self) -> MotionOwner:
        """Whose the motion is."""
        return self._owners.now.model_copy(update={"jogging": self._jogged})

    def followed(self, goal: str) -> ExecuteRequest:
        """What was asked for with the goal that is followed.

        Raises:
            Refused: it is not that one.
        """
        if self._followed is None or not goal == self._followed.id == self._arm.goal:
            raise Refused("unknown_goal", f"goal {goal!r} is not followed now")
        return self._followed

    def stop(self, request: StopRequest, now: float) -> MotionStatus:
        """The state of the goal, which is being brought to rest if it was moving the robot.

        A person's stop keeps every other motion from beginning, until it is let go of.
        """
        running, known = self._arm.goal, not request.id or self._arm.knows(request.id)
        if request.by == "person":
            self._inhibits.stop(request)
            self._owners.end()
            self._jogging.interrupt(monotonic())
            if running:
                self._arm.cancel(running, request.reason, now)
        stopped = [goal for goal in (running if request.by == "person" or not request.id else "", request.id) if goal]
        # One that runs must not come to life again should its request come once more after a restart.
        self._inhibits.never(goal for goal in stopped if goal == running or not self._arm.knows(goal))
        self.tell_inhibits()
        status = self._arm.cancel(request.id, request.reason, now)
        if known:
            return status
        return status.model_copy(update={"message": f"{status.message}; it is refused if it comes"})

    def hold(self, request: HoldRequest) -> tuple[MotionStatus, list[Inhibit]]:
        """The status, and what was let go of.

        The arm is being brought to rest on its path, or goes on when nobody holds it; the fingers finish their motion.
        """
        if request.by != "person" and request.hold and request.goal not in ("", self._arm.goal):
            return self._arm.status, []  # that one is over
        let_go = self._inhibits.hold(request)
        if request.hold:
            self._jogging.interrupt(monotonic())
        elif request.into_stop or (
            request.stops and (request.override or self._owners.now.owner == (request.owner or SOMEBODY))
        ):
            self._owners.end()  # handed over to whoever moves the robot now: the person, or the task that is started
        if request.by == "scene_monitor":
            self._held_goal = request.goal if request.hold else ""
        if request.by != "person":
            self._arm.hold(request.hold, request.reason, request.by)
        self.tell_inhibits()
        return self._arm.status, let_go

    def wait(self, wait: bool, reason: str = "") -> None:
        """Bring the arm to rest on its path of our own accord, or let it go on."""
        if wait != self._waits:
            self._waits = wait
            self._jogging.interrupt(monotonic())
            self._inhibits.hold_ourselves("controller", wait, reason)
            self._arm.hold(wait, reason, "controller")
            self.tell_inhibits()

    def tell_inhibits(self) -> None:
        """Have the arm held as persons say, and told of all who keep it."""
        reasons = [hold.reason for hold in self._inhibits.holds]
        self._arm.inhibits = self._inhibits.all
        self._arm.hold(bool(reasons), "; ".join(filter(None, reasons)), "person")

    @property
    def goal(self) -> str:
        """Id of the goal that is followed; empty when there is none."""
        return self._arm.goal

    @property
    def _fingers_move(self) -> bool:
        return self._gripper is not None and self._gripper.state.moving

    @property
    def at_rest(self) -> bool:
        """Whether nothing moves the arm any more."""
        return self._arm.at_rest

    @property
    def speed_scaling(self) -> float:
        """Share of their speed at which trajectories are followed, 0 to 1."""
        return self._cap

    @speed_scaling.setter
    def speed_scaling(self, share: float) -> None:
        self._cap = share
        self._arm.speed_scaling = share * (self._own.state.speed if self._own is not None else 1.0)

    def command(self, request: GripperCommand, now: float, late: Refused | None = None) -> GripperState:
        """The state of the gripper's goal, unless it comes too `late`.

        Raises:
            Refused: this robot has no gripper.
        """
        if self._gripper is None:
            raise Refused("no_gripper", "this robot has no gripper")
        objection = (self._inhibits.objection(request.id, request.owner, request.heard) or late
                     or self._owners.objection(request.owner) or self._hand_fault.objection)
        try:
            state = self._gripper.command(request, now, objection)
            if objection is None:
                self._owners.use(request.owner, monotonic())
            return state
        except HardwareFault as fault:
            self._hand_fault.failed(str(fault), now)
            self._gripper.fault(str(fault))
            return self._gripper.command(request, now, self._hand_fault.objection)

    @property
    def robot(self) -> RobotStatus:
        """What the arm's own controller says; one that has none runs, unless it does not work."""
        return RobotStatus(**self._robot(), late=self._own.late if self._own is not None else 0.0)

    def _robot(self) -> dict[str, Any]:
        """What is told of it whenever it has changed."""
        if self._own is None:
            fault = self._arm_fault.reason
            return {"mode": "fault" if fault else "running", "message": fault}
        own = self._own.state
        return {"mode": own.mode, "message": own.message, "speed": own.speed, "inputs": own.inputs,
                "outputs": own.outputs, "controller": True}

    def order(self, request: RobotCommand) -> int:
        """A number to ask about what the arm's own controller was told to do.

        Raises:
            Refused: it has none, or the request is none for this moment.
        """
        if self._own is None:
            raise Refused("no_controller", "this arm has no controller of its own that could do that")
        if request.act == "freedrive" and request.value and self._arm.goal:
            raise Refused("busy", f"goal {self._arm.goal!r} is still being followed: stop it first")
        return self._own.order(request.act, *request.values)

    def outcome(self, number: int) -> str | None:
        """None while it is being done; empty once it was; else why not."""
        assert self._own is not None
        return self._own.outcome(number)

    def edit_takes_long(self, request: WorldEdit) -> bool:
        """Whether an edit may take longer than a cycle: it is made beside them then, `apart`."""
        takes_long = getattr(self._world, "edit_takes_long", None)
        return takes_long is not None and bool(takes_long(request))

    def edit(self, request: WorldEdit, now: float) -> WorldEditReply:
        """What was changed in the simulated world.

        Raises:
            Refused: with the reason; nothing has changed then.
        """
        if self._world is None:
            raise Refused("not_simulated", "the world of real hardware cannot be edited")
        return WorldEditReply(id=self._world.edit(request, now), ids=self._world.ids)

    def close(self) -> None:
        """Let go of the hardware."""
        self._hardware.close()

    def _step_gripper(self, now: float) -> None:
        gripper = self._hardware.gripper
        if self._gripper is None or gripper is None or self._hand_fault.waits(now):
            return
        if self._world is None or self._kinematics is None or self._obstructible is None or self.apart:
            reading = asked("reading the gripper", gripper.read, now)
        else:
            T_world_tcp = self._kinematics.fk(self._q)
            self._obstructible.obstruct(self._world.obstruction(T_world_tcp, self._gripper.state.width))
            reading = asked("reading the gripper", gripper.read, now)
            tick = partial(self._world.tick, now, T_world_tcp, reading.width, reading.holding)
            takes_long = getattr(self._world, "takes_long", None)
            if self.beside and takes_long is not None and takes_long(reading.width, reading.holding):
                self.due, self.apart = tick, True
            else:
                tick()
        self._width_rate = reading.velocity
        self._gripper.update(reading, now)
        self._hand_fault.works(now)

    def _joint_state(self, header: Header, dq: Vector) -> JointState:
        names, positions, velocities = list(self._limits.names), self._q.tolist(), dq.tolist()
        if self._gripper is not None and self._fingers is not None:
            width = self._gripper.state.width
            names += self._fingers.joints
            positions += finger_positions(self._fingers, width)
            velocities += finger_velocities(self._fingers, width, self._width_rate)
        return JointState(header=header, name=names, position=positions, velocity=velocities, effort=[])

    def _news_of_motion(self, header: Header, now: float) -> MotionStatus | None:
        told, said = self._told_motion, self._arm.said
        if told is not None and (
            told.progress == self._arm.progress or now - self._told_motion_at < PROGRESS_PERIOD
        ) and (said == self._said or told.same_but(self._arm.status, "progress")):
            self._said = said
            return None
        self._told_motion, self._told_motion_at, self._said = self._arm.status, now, said
        return self._told_motion.model_copy(update={"header": header})

    def _news_of_robot(self, header: Header) -> RobotStatus | None:
        robot = self._robot()
        if robot == self._told_robot:
            return None
        self._told_robot = robot
        return self.robot.model_copy(update={"header": header})

    def _news_of_owner(self, header: Header) -> MotionOwner | None:
        self._jogged = bool(self._jogging.owner) or (self._jogged and not self._arm.at_rest)
        now = (self._owners.now, self._jogged)
        if now == self._told_owner:
            return None
        self._told_owner = now
        return self.owner.model_copy(update={"header": header})

    def _news_of_gripper(self, header: Header, now: float) -> GripperState | None:
        if self._gripper is None:
            return None
        state, told = self._gripper.state, self._told_gripper
        if told is state:
            return None
        if told is not None and told.same_but(state, "width", "position") and (
            told.width == state.width or now - self._told_gripper_at < PROGRESS_PERIOD
        ):
            return None
        self._told_gripper, self._told_gripper_at = state, now
        return state.model_copy(update={"header": header})
