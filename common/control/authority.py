"""Who may move the arm now: what persons decided, whose the motion is, and what a stop, a hold and a hand-over do."""

from __future__ import annotations

from common.control.controller import TrajectoryController
from common.control.interlocks import Interlocks
from common.control.jogging import Jogging
from common.control.ownership import NOT_OWNER, Ownership
from common.errors import Refused
from common.hardware.interface import Vector
from common.messages import (
    UNKNOWN_OPERATOR,
    ExecuteRequest,
    GripperCommand,
    GripperState,
    Header,
    HoldRequest,
    Interlock,
    JogCommand,
    MotionOwner,
    MotionStatus,
    OwnRequest,
    StopRequest,
)
from common.sources import monotonic


class Authority:
    """What keeps the arm from moving, and who has it move."""

    def __init__(self, arm: TrajectoryController, jogging: Jogging, interlocks: Interlocks) -> None:
        """Let persons' decisions of before, as `interlocks` have them, hold the arm from the start."""
        self._arm, self._jogging, self.interlocks = arm, jogging, interlocks
        self._owners = Ownership()
        self._jogged = False  # until the arm rests
        self._told: tuple[MotionOwner, bool] | None = None
        self._held_goal = ""  # that the scene monitor holds
        self._waits = False  # held by ourselves
        self.report_interlocks()

    # --- may it begin ---------------------------------------------------------------------------------------------

    def interlocked(self, request: ExecuteRequest | GripperCommand | JogCommand, goal: str = "") -> Refused | None:
        """What persons decided that speaks against a motion, or None."""
        return self.interlocks.objection(goal, request.owner, request.acknowledged)

    def others(self, owner: str) -> Refused | None:
        """That the motion is somebody else's, or None."""
        return self._owners.objection(owner)

    def use(self, owner: str) -> None:
        """Take note that somebody without an objection begins a motion."""
        self._owners.use(owner, monotonic())

    def refused(self, request: ExecuteRequest | GripperCommand, status: MotionStatus | GripperState) -> None:
        """Take note of how a goal of arm or fingers was answered that was not heard of before.

        A task that was kept from going on by an operator does not do so by itself once the motion is given back. Asked
        for again, when the motion has long been another's, it is answered as before; nothing follows from that.
        """
        if status.error == NOT_OWNER and not request.owner and self._owners.now.asked:
            self.interlocks.stop(StopRequest(reason=status.message, owner=self._owners.now.owner))
            self.report_interlocks()

    def jog(self, request: JogCommand, objection: Refused | None) -> None:
        """Move the arm while that comes again and again, unless there is an objection.

        Raises:
            Refused: with the reason. It counts again after a pause.
        """
        objection = objection or self.interlocked(request)
        if objection is None and self._arm.status.fault:
            objection = Refused("hardware_fault", self._arm.status.fault)
        if objection is None and self._arm.status.held:
            objection = Refused("held", self._arm.status.message or "the robot is held")
        objection = objection or self.others(request.owner)
        if objection is None and self._arm.goal:
            objection = Refused("busy", f"goal {self._arm.goal!r} is still being followed")
        self._jogging.ask(request, monotonic(), objection)
        self.use(request.owner)

    def jog_velocity(self, share: float) -> Vector | None:
        """Velocities at which the arm is jogged now (dof,) [rad/s], at this share of its speed, or None."""
        return self._jogging.velocity(self._arm.set_point, monotonic(), share)

    def interrupt_jogging(self) -> None:
        """End it: who jogs has to let go of the button first."""
        self._jogging.interrupt(monotonic())

    # --- whose it is ----------------------------------------------------------------------------------------------

    @property
    def owner(self) -> MotionOwner:
        """Whose the motion is."""
        return self._owners.now.model_copy(update={"jogging": self._jogged})

    def own(self, request: OwnRequest, now: float) -> MotionOwner:
        """Whose the motion is, after it was asked for or given back; cell time [s].

        What is taken over is brought to rest. A task that lost it waits for a person to start it again, as after a
        stop, so that no restart of anything has it go on.

        Raises:
            Refused: it is somebody else's.
        """
        if request.act == "give":
            self._owners.give(request.owner, bool(self._arm.goal) or not self._arm.at_rest)
            return self.owner
        before = self._owners.take(request, monotonic())
        reason = f"{request.owner} took the motion over{before and f', which was {before}'}"
        if request.over and request.kind != "task":
            self.interlocks.stop(StopRequest(reason=reason, owner=request.owner))  # also of who is just being restarted
        if before or request.over:
            self._end_motion(reason, now)
            self.report_interlocks()
        return self.owner

    def _end_motion(self, reason: str, now: float) -> None:
        """Bring what moves the arm to rest; its goal never moves again."""
        self.interrupt_jogging()
        if goal := self._arm.goal:
            self.interlocks.never([goal])
            self._arm.cancel(goal, reason, now)

    def disown(self) -> None:
        """Have the motion be nobody's once what moves has ended: the task that had it is gone."""
        if self._owners.now.kind == "task":
            self._owners.let_end()

    def look(self, moving: bool) -> None:
        """Let go of what is over; once a cycle."""
        if self._held_goal and self._held_goal != self._arm.goal:  # nothing is in the way of what is over
            self.hold(HoldRequest(hold=False, by="scene_monitor"))
        self._owners.look(moving, monotonic())

    def news(self, header: Header) -> MotionOwner | None:
        """Whose the motion is, if that is new."""
        self._jogged = bool(self._jogging.owner) or (self._jogged and not self._arm.at_rest)
        now = (self._owners.now, self._jogged)
        if now == self._told:
            return None
        self._told = now
        return self.owner.model_copy(update={"header": header})

    # --- stops and holds ------------------------------------------------------------------------------------------

    def stop(self, request: StopRequest, now: float) -> MotionStatus:
        """The state of the goal, which is being brought to rest if it was moving the robot; cell time [s].

        A person's stop keeps every other motion from beginning, until it is let go of.
        """
        running, known = self._arm.goal, not request.id or self._arm.knows(request.id)
        if request.by == "operator":
            self.interlocks.stop(request)
            self._owners.end()
            self.interrupt_jogging()
            if running:
                self._arm.cancel(running, request.reason, now)
        stopped = [goal for goal in (running if request.by == "operator" or not request.id else "", request.id) if goal]
        # One that runs must not come to life again should its request come once more after a restart.
        self.interlocks.never(goal for goal in stopped if goal == running or not self._arm.knows(goal))
        self.report_interlocks()
        status = self._arm.cancel(request.id, request.reason, now)
        if known:
            return status
        return status.model_copy(update={"message": f"{status.message}; it is refused if it comes"})

    def hold(self, request: HoldRequest, now: float = 0.0) -> tuple[MotionStatus, list[Interlock]]:
        """The status, and what was let go of; cell time [s].

        The arm is being brought to rest on its path, or goes on when nobody holds it; the fingers finish their motion.
        """
        if request.by != "operator" and request.hold and request.goal not in ("", self._arm.goal):
            return self._arm.status, []  # that one is over
        let_go = self.interlocks.hold(request)
        if request.hold:
            self.interrupt_jogging()
        elif self._hands_over(request):
            owner = self._owners.now
            if owner.kind not in ("none", "task") and owner.owner != (request.owner or UNKNOWN_OPERATOR):
                starter = request.owner or UNKNOWN_OPERATOR
                self._end_motion(f"{starter} started the task; the motion was {owner.description}", now)
            self._owners.end()  # to whoever moves the robot now: the person, or the task that is started
        if request.by == "scene_monitor":
            self._held_goal = request.goal if request.hold else ""
        if request.by != "operator":
            self._arm.hold(request.hold, request.reason, request.by)
        self.report_interlocks()
        return self._arm.status, let_go

    def _hands_over(self, request: HoldRequest) -> bool:
        """Whether who lets go ends whose the motion was: what another person took stays theirs, if they have a name.

        A start that did not let go of all stops is older than one of them, and starts nothing.
        """
        now = self._owners.now
        own = now.owner == (request.owner or UNKNOWN_OPERATOR)
        if request.into_stop:
            return own or now.kind == "task"
        if not request.stops or self.interlocks.stops:
            return False
        return own or (now.asked and now.owner == UNKNOWN_OPERATOR) or request.override

    def wait(self, wait: bool, reason: str = "") -> None:
        """Bring the arm to rest on its path of our own accord, or let it go on."""
        if wait != self._waits:
            self._waits = wait
            self.interrupt_jogging()
            self.interlocks.hold_ourselves("controller", wait, reason)
            self._arm.hold(wait, reason, "controller")
            self.report_interlocks()

    def report_interlocks(self) -> None:
        """Have the arm held as persons say, and told of all who keep it."""
        reasons = [hold.reason for hold in self.interlocks.holds]
        self._arm.interlocks = self.interlocks.all
        self._arm.hold(bool(reasons), "; ".join(filter(None, reasons)), "operator")
