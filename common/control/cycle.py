"""One cycle of control: read the joints, move the world on, judge and send set-points. The service gives it time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from common.config import GripperConfig
from common.control.authority import Authority
from common.control.checks import Tolerances
from common.control.controller import PERIOD, TrajectoryController
from common.control.faults import Fault, asked
from common.control.goals import Judged
from common.control.gripper_controller import GripperController
from common.control.interlocks import Interlocks
from common.control.jogging import Jogging, ToolKinematics
from common.control.payload import Payload
from common.control.readings import read_fingers, read_joints
from common.control.waiting_fingers import WaitingFingers
from common.errors import ConfigError, Refused
from common.hardware.interface import (
    ControlledArm,
    Hardware,
    HardwareFault,
    Limits,
    PlaceableGripper,
    SimulatedGripper,
    Vector,
)
from common.messages import (
    CLOSED_BEFORE,
    ExecuteRequest,
    GripperCommand,
    GripperState,
    Header,
    JogCommand,
    JointState,
    MotionOwner,
    MotionStatus,
    RobotCommand,
    RobotStatus,
    SceneUpdate,
    WorldEdit,
    WorldEditReply,
    WorldObjects,
)
from common.robot.finger_joints import finger_positions, finger_velocities
from common.sim.interface import FeltWorld, SimulatedWorld, StandingObject
from common.sim.standing import Standing

PROGRESS_PERIOD = 0.1  # cell time between reports of progress [s]
FINGERS_PERIOD = 0.02  # cell time between reports of fingers that move [s]: by their width one goes on
PRESSES = 1e-3  # [m] by which fingers may be further apart than what they press on
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
        interlocks: Interlocks | None = None,
        period: float = PERIOD,
    ) -> None:
        """Control this hardware every `period` [s], unless `interlocks` keep it.

        `world` comes with simulated hardware only, and then `kinematics` must; without them the tool is not jogged.

        Raises:
            ConfigError: the backend's gripper cannot feel the simulated world, or it has none.
        """
        self._hardware, self._limits = hardware, limits
        self._kinematics, self._world = kinematics, world
        self._felt = world if isinstance(world, FeltWorld) else None
        self._arm = TrajectoryController(limits, start, tolerances, name=controller, period=period)
        self._gripper: GripperController | None = None
        self._waiting = WaitingFingers(self._arm, kinematics)
        self._fingers = gripper
        self._obstructible: SimulatedGripper | None = None
        if gripper is not None:
            backend = type(hardware).__name__
            if hardware.gripper is None:
                raise ConfigError("robot.hardware.backend", backend, "has no gripper, but the robot has one")
            if self._felt is not None:
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
        self._payload = Payload(self._own, gripper)
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
        self.restored = False  # whether fingers and world were found as they were before a restart
        self._stood: tuple[int, dict[str, StandingObject]] | None = None  # the objects, as of a version of the world
        self._followed: ExecuteRequest | None = None  # the newest goal that was accepted
        self._interlocks = interlocks or Interlocks()
        if self._own is not None:
            self._own.stopped = self._own.stopped or self._interlocks.arm_stopped
        self.authority = Authority(self._arm, Jogging(limits, kinematics), self._interlocks)

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
                self.authority.interrupt_jogging()
        if self._gripper is not None:
            self._meet(self._gripper, now)
        if self._own is not None:
            self._interlocks.arm_stopped = self._own.stopped
        report.robot = self._news_of_robot(header)
        report.notes = [*filter(None, (self._arm_fault.news(), self._hand_fault.news(), self._arm.news(),
                                       self._payload.news()))]
        self.authority.look(bool(self._arm.goal) or not self._arm.at_rest or self._fingers_move)
        report.owner = self.authority.news(header)
        report.motion = self.news_of_motion(header)
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
        self._q, dq = read_joints(self._hardware, len(self._q), now)
        self._found = True
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
            held = self._gripper.held_mass if self._gripper is not None else 0.0
            self._payload.tell(held, own.mode == "running", self._arm.at_rest)
            if own.mode != "running":  # there is no need to leave it alone: it says how it is
                self._arm.fault(own.message or own.mode)
                self.authority.interrupt_jogging()
                return self._joint_state(header, dq)
        self._arm.jog(self.authority.jog_velocity(self._arm.speed_scaling))
        set_points = self._arm.update(now, self._q, dq)
        if set_points is not None:
            asked("sending set-points", self._hardware.write, *set_points, now)
            self._arm_fault.works(now)
        return self._joint_state(header, dq)

    def _meet(self, gripper: GripperController, now: float) -> None:
        """Have fingers that wait for the arm begin; one that they closed ahead of is not brought on."""
        waiting = self._waiting.command
        stopped = waiting and self.authority.interlocked(waiting, waiting.id)
        if waiting is not None and stopped:
            self._waiting.drop()
            gripper.call_off(waiting, str(stopped))
        elif waiting is not None and self._waiting.begins(now, self._q, gripper.state.width):
            try:
                gripper.begin(waiting, now)
            except HardwareFault as fault:
                self._hand_fault.failed(str(fault), now)
                self._arm.abort("hardware_fault", str(fault), "hardware")
                gripper.call_off(waiting, str(fault), "hardware_fault")
        if self._waiting.closed_before(now):
            self._arm.abort(CLOSED_BEFORE, "held up or slowed as the fingers began to close")
        if off := self._waiting.called_off():
            gripper.call_off(*off)

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
        # Physics moves things between what it tells of: the hand and what it holds are to be kept as of one moment, or
        # they are within each other when they are found again, and fly apart.
        if self._felt is None or self._stood is None or self._stood[0] != self._world.version:
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
        self.restored = True
        fingers = self._hardware.gripper
        if self._gripper is None or not isinstance(fingers, PlaceableGripper) or state.width is None:
            return
        fingers.place(state.width)
        told = state.told_width
        if self._felt is not None and self._obstructible is not None and self._kinematics is not None:
            between = self._felt.obstruction(self._kinematics.fk(self._q), state.width)
            self._obstructible.obstruct(between)
            holds = told is not None and told < state.width <= between + PRESSES
            if self._interlocks.stops and not holds:  # they go on pressing, and on no way
                told = state.width
        if told is not None:
            self._gripper.resume(told, now, state.told_effort)
        self._gripper.update(fingers.read(now), now)

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
        authority, known = self.authority, self._arm.knows(request.id)
        objection = (authority.interlocked(request, request.id) or objection or authority.others(request.owner)
                     or self._unfit)
        status = self._arm.accept(
            request.id, request.trajectory, now, self._q, objection, judged, request.plan, request.scene_stamp,
        )
        if not known:
            authority.refused(request, status)
        if request.id == self._arm.goal and (self._followed is None or self._followed.id != request.id):
            self._followed = request
            authority.use(request.owner)
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
        self.authority.jog(request, late or self._unfit)

    def followed(self, goal: str) -> ExecuteRequest:
        """What was asked for with the goal that is followed.

        Raises:
            Refused: it is not that one.
        """
        if self._followed is None or not goal == self._followed.id == self._arm.goal:
            raise Refused("unknown_goal", f"goal {goal!r} is not followed now")
        return self._followed

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
        objection = (self.authority.interlocked(request, request.id) or late
                     or self.authority.others(request.owner) or self._hand_fault.objection)
        waits = bool(request.after) and request.after == self._arm.goal
        if request.after and not waits and self._arm.fails(request.after):
            objection = objection or Refused("unknown_goal", f"goal {request.after!r} is not followed now")
        try:
            known = self._gripper.knows(request.id)
            state = self._gripper.command(request, now, objection, waits)
            if not known:
                self.authority.refused(request, state)
            if not known and state.state == "active":
                self._replaced_by(request)
                if waits:
                    self._waiting.wait(request)
            if objection is None:
                self.authority.use(request.owner)
            return state
        except HardwareFault as fault:
            self._hand_fault.failed(str(fault), now)
            self._gripper.fault(str(fault))
            self._replaced_by(request)
            return self._gripper.command(request, now, self._hand_fault.objection)

    def _replaced_by(self, request: GripperCommand) -> None:
        if (replaced := self._waiting.drop()) is not None:
            assert self._gripper is not None
            self._gripper.call_off(replaced, f"replaced by {request.id!r}")

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
        if self._felt is None or self._kinematics is None or self._obstructible is None or self.apart:
            reading = read_fingers(gripper, now)
        else:
            T_world_tcp = self._kinematics.fk(self._q)
            self._obstructible.obstruct(self._felt.obstruction(T_world_tcp, self._gripper.state.width))
            reading = read_fingers(gripper, now)
            tick = partial(self._felt.tick, now, T_world_tcp, reading.width, reading.holding)
            takes_long = getattr(self._felt, "takes_long", None)
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

    def news_of_motion(self, header: Header) -> MotionStatus | None:
        """What the motion's status is, if that is new: also ahead of an answer to who changed it."""
        told, said, now = self._told_motion, self._arm.said, header.stamp * 1e-9
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

    def _news_of_gripper(self, header: Header, now: float) -> GripperState | None:
        if self._gripper is None:
            return None
        state, told = self._gripper.state, self._told_gripper
        if told is state:
            return None
        if told is not None and told.same_but(state, "width", "position") and (
            told.width == state.width or now - self._told_gripper_at < FINGERS_PERIOD
        ):
            return None
        self._told_gripper, self._told_gripper_at = state, now
        return state.model_copy(update={"header": header})
