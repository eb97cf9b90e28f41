"""Motion authority: the owner of the motion, interlocks, and the effects of a stop, a hold and a hand-over.

One task, operator or script owns the motion at a time; motions of all others are refused. A requester of a motion that
has no owner owns it until that motion ends; requested ownership is valid until its release. Stops and holds need no
ownership; an operator's stop ends it.
"""

from __future__ import annotations

import math
from typing import Literal

from common.control.interlocks import Interlocks
from common.control.jogging import Jogging
from common.control.trajectory_controller import TrajectoryController
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
from common.time_source import monotonic, wall_ns

NOT_OWNER = "not_owner"
BOUND: tuple[Literal["scene_monitor", "coordinator"], ...] = ("scene_monitor", "coordinator")  # holds of one goal
STALE, AHEAD = "stale_request", "clock_ahead"
WhenAlone = Literal["finish", "hold"]


def check_age(age: float, longest: float, clock_tolerance: float, uptime: float = math.inf) -> Refused | None:
    """Return why a request is too old or from the future, or None.

    A request from before the start of the executor may have been executed by the one before it, which knew its id.

    Args:
        age: since the request was decided, by the clocks of both hosts; negative in the future [s, wall].
        longest: largest age [s].
        clock_tolerance: largest difference of the clocks [s].
        uptime: since the executor started [s, wall].
    """
    if age > longest:
        what = f"is {age:.1f} s old" if age < 1e6 else "does not say when it was decided (header.stamp)"
        return Refused(STALE, f"the request {what}, but at most {longest:g} s are allowed (or the clocks of the hosts "
                              "differ)")
    if age > uptime:
        return Refused(STALE, f"the request was decided {age - uptime:.1f} s before the executor started: it may have "
                              "been executed already")
    if age < -clock_tolerance:
        return Refused(AHEAD, f"the request is from {-age:.1f} s in the future: set the clocks of both hosts")
    return None


class OrphanPolicy:
    """Decides whether the arm is held because its task vanished during a motion."""

    def __init__(self) -> None:
        """Start without a task: its absence means nothing until it was seen, as an operator may move the arm."""
        self._present = False
        self._orphan = ""  # goal that was followed when the task vanished

    def update(self, present: bool, goal: str, when_alone: WhenAlone) -> bool:
        """Return whether the arm is to be held now.

        Args:
            present: whether the task is ready, by its liveliness token.
            goal: id of the goal that is followed; empty without one.
            when_alone: what is configured.
        """
        if present:
            self._orphan = ""
        elif self._present:
            self._orphan = goal
        self._present = present
        return when_alone == "hold" and bool(goal) and goal == self._orphan


class MotionOwnership:
    """Keeps the owner of the motion. An empty name is that of a task which does not give its own."""

    def __init__(self) -> None:
        """Start without an owner."""
        self.now = MotionOwner()
        self._lease = 0.0  # [s] wall; 0: without end
        self._used = 0.0  # [s] wall: last time it was taken, or moved something

    def check(self, owner: str) -> Refused | None:
        """Return why a motion requested by `owner` is refused, or None."""
        if self.now.kind == "none" or self._is_owner(owner):
            return None
        return Refused(NOT_OWNER, f"the motion is {self.now.description}: take it over first")

    def use(self, owner: str, now: float) -> None:
        """Record that an allowed motion starts; wall time [s]."""
        self._used = now
        if self.now.kind == "none":
            self._put(owner, "operator" if owner else "task", asked=False)

    def take(self, request: OwnRequest, now: float) -> str:
        """Give the motion to the requester; return the description of the owner it was taken from, if any.

        Raises:
            Refused: another one owns it, and the request does not say that it takes it over.
        """
        before = ""
        if self.now.kind != "none" and not self._is_requester(request):
            if not request.over:
                raise Refused(NOT_OWNER, f"the motion is {self.now.description}: take it over, if it must be")
            before = self.now.description
        if before or not self.now.asked:
            self._put(request.owner, request.kind, asked=True)
        self._lease, self._used = request.lease, now
        return before

    def give(self, owner: str, moving: bool) -> None:
        """Give back what `owner` has; while the arm moves, at the end of that motion."""
        if self.now.kind == "none" or self.now.owner != owner:
            return
        if moving:
            self.end_after_motion()
        else:
            self.end()

    def end(self) -> None:
        """End the ownership now."""
        self.now = MotionOwner()

    def end_after_motion(self) -> None:
        """End the ownership as soon as nothing moves."""
        self.now = self.now.model_copy(update={"asked": False})

    def update(self, moving: bool, now: float) -> None:
        """End an ownership for one motion after that motion, and one that was not used for its lease."""
        if moving:
            self._used = now
        elif self.now.kind != "none" and (
            not self.now.asked or (self._lease and now - self._used > self._lease)
        ):
            self.end()

    def _is_owner(self, owner: str) -> bool:
        return self.now.owner == owner or (self.now.kind == "task" and not owner)

    def _is_requester(self, request: OwnRequest) -> bool:
        """Return whether the requester is the owner; a task may start to give its name."""
        return (self.now.kind == "task") == (request.kind == "task") and self.now.owner in (
            request.owner, *(("",) if request.kind == "task" else ()))

    def _put(self, owner: str, kind: str, *, asked: bool) -> None:
        self.now = MotionOwner.model_validate({"owner": owner, "kind": kind, "since": wall_ns(), "asked": asked})
        self._lease = 0.0


class MotionAuthority:
    """Decides whether a motion may start, and ends motions for stops, holds and hand-overs."""

    def __init__(self, arm: TrajectoryController, jogging: Jogging, interlocks: Interlocks) -> None:
        """Hold the arm from the start as persisted `interlocks` require."""
        self._arm, self._jogging, self.interlocks = arm, jogging, interlocks
        self._ownership = MotionOwnership()
        self._jogged = False  # until the arm is at rest
        self._published: tuple[MotionOwner, bool] | None = None
        self._held_goals: dict[str, str] = {}  # by holder: its hold ends with this goal
        self._holding = False  # the controller itself
        self.apply_interlocks()

    # --- may it start ---------------------------------------------------------------------------------------------

    def check_interlocks(self, request: ExecuteRequest | GripperCommand | JogCommand, goal: str = "") -> Refused | None:
        """Return the interlock that blocks a motion, or None."""
        return self.interlocks.check(goal, request.owner, request.acknowledged)

    def check_owner(self, owner: str) -> Refused | None:
        """Return that another one owns the motion, or None."""
        return self._ownership.check(owner)

    def use(self, owner: str) -> None:
        """Record that an allowed motion starts."""
        self._ownership.use(owner, monotonic())

    def note_refusal(self, request: ExecuteRequest | GripperCommand, status: MotionStatus | GripperState) -> None:
        """Stop the robot if a new goal of the task was refused because an operator owns the motion.

        So the task does not continue by itself after the release. A repeated request of that goal gets the
        same answer, and has no effect.
        """
        if status.error == NOT_OWNER and not request.owner and self._ownership.now.asked:
            self.interlocks.stop(StopRequest(reason=status.message, owner=self._ownership.now.owner))
            self.apply_interlocks()

    def jog(self, request: JogCommand, refusal: Refused | None) -> None:
        """Jog the arm until the next command is overdue, unless there is a `refusal` already.

        Raises:
            Refused: with the reason. Commands count again after a pause.
        """
        refusal = refusal or self.check_interlocks(request)
        if refusal is None and self._arm.status.fault:
            refusal = Refused("hardware_fault", self._arm.status.fault)
        if refusal is None and self._arm.status.held:
            refusal = Refused("held", self._arm.status.message or "the robot is held")
        refusal = refusal or self.check_owner(request.owner)
        if refusal is None and self._arm.goal:
            refusal = Refused("busy", f"goal {self._arm.goal!r} is still being followed")
        ended = self._jogging.ended
        self._jogging.command(request, monotonic(), refusal)
        if ended and self._arm.reports.newest.message == ended:
            self._arm.reports.set_message("")
        self.use(request.owner)

    def jog_velocity(self, share: float) -> Vector | None:
        """Return the joint velocities of jogging (dof,) [rad/s] at a share of the speed, or None without jogging."""
        before = self._jogging.ended
        velocity = self._jogging.velocity(self._arm.set_point, monotonic(), share)
        if self._jogging.ended != before:
            self._arm.note(self._jogging.ended)
        return velocity

    def interrupt_jogging(self) -> None:
        """End jogging: the operator must release the button first."""
        self._jogging.interrupt(monotonic())

    # --- the owner ------------------------------------------------------------------------------------------------

    @property
    def owner(self) -> MotionOwner:
        """The owner of the motion."""
        return self._ownership.now.model_copy(update={"jogging": self._jogged})

    def own(self, request: OwnRequest, now: float) -> MotionOwner:
        """Return the owner after a request or release of ownership; cell time [s].

        A motion that is taken over is brought to rest. A task that lost it waits for a start by an operator, as after
        a stop: a restart of any process does not continue it.

        Raises:
            Refused: another one owns the motion.
        """
        if request.act == "give":
            self._ownership.give(request.owner, bool(self._arm.goal) or not self._arm.at_rest)
            return self.owner
        before = self._ownership.take(request, monotonic())
        reason = f"{request.owner} took the motion over{before and f', which was {before}'}"
        if request.over and request.kind != "task":
            # Even without an owner now: the task may just be restarting.
            self.interlocks.stop(StopRequest(reason=reason, owner=request.owner))
        if before or request.over:
            self._end_motion(reason, now)
            self.apply_interlocks()
        return self.owner

    def _end_motion(self, reason: str, now: float) -> None:
        """Bring the arm to rest; its goal never moves again."""
        self.interrupt_jogging()
        if goal := self._arm.goal:
            self.interlocks.block_goals([goal])
            self._arm.cancel(goal, reason, now)

    def disown_task(self) -> None:
        """End the ownership of a task, whose process has ended, after the motion in progress."""
        if self._ownership.now.kind == "task":
            self._ownership.end_after_motion()

    def update(self, moving: bool) -> None:
        """End what is over; once a cycle."""
        for holder in BOUND:  # nothing obstructs a goal that is over
            if self._held_goals.get(holder, self._arm.goal) != self._arm.goal:
                del self._held_goals[holder]
                self._hold_internally(holder, False, "")
        self._ownership.update(moving, monotonic())

    def changed_owner(self, header: Header) -> MotionOwner | None:
        """Return the owner if it has changed since the last call."""
        self._jogged = bool(self._jogging.owner) or (self._jogged and not self._arm.at_rest)
        now = (self._ownership.now, self._jogged)
        if now == self._published:
            return None
        self._published = now
        return self.owner.model_copy(update={"header": header})

    # --- stops and holds ------------------------------------------------------------------------------------------

    def stop(self, request: StopRequest, now: float) -> MotionStatus:
        """Return the state of the goal, which is brought to rest if it moves the robot; cell time [s].

        An operator's stop blocks every other motion until it is released.
        """
        running, known = self._arm.goal, not request.id or self._arm.knows(request.id)
        if request.by == "operator":
            self.interlocks.stop(request)
            self._ownership.end()
            self.interrupt_jogging()
            if running:
                self._arm.cancel(running, request.reason, now)
        stopped = [goal for goal in (running if request.by == "operator" or not request.id else "", request.id) if goal]
        # The running one, too: its request may arrive again after a restart.
        self.interlocks.block_goals(goal for goal in stopped if goal == running or not self._arm.knows(goal))
        self.apply_interlocks()
        status = self._arm.cancel(request.id, request.reason, now)
        if known:
            return status
        return status.model_copy(update={"message": f"{status.message}; it will be refused"})

    def hold(self, request: HoldRequest, now: float = 0.0) -> tuple[MotionStatus, list[Interlock]]:
        """Return the status and the released interlocks; cell time [s].

        The arm is brought to rest on its path, or continues when no hold is left; the gripper finishes its motion.
        """
        if request.by != "operator" and request.hold and request.goal not in ("", self._arm.goal):
            return self._arm.status, []  # that goal is over
        if request.by == "coordinator" and request.goal != self._arm.goal:
            return self._arm.status, []  # it was proved for that goal only
        released = self.interlocks.hold(request)
        if request.hold:
            self.interrupt_jogging()
        elif self._hands_over(request):
            owner = self._ownership.now
            if owner.kind not in ("none", "task") and owner.owner != (request.owner or UNKNOWN_OPERATOR):
                starter = request.owner or UNKNOWN_OPERATOR
                self._end_motion(f"{starter} started the task; the motion was {owner.description}", now)
            self._ownership.end()  # the next to move it is this operator, or the task that is started
        if request.by in BOUND and request.hold and request.goal:
            self._held_goals[request.by] = request.goal
        elif request.by in BOUND:
            self._held_goals.pop(request.by, None)
        if request.by != "operator":
            self._arm.hold(request.hold, request.reason, request.by)
        self.apply_interlocks()
        return self._arm.status, released

    def _hands_over(self, request: HoldRequest) -> bool:
        """Return whether a release ends the ownership; it does not end that of another named operator.

        A start that did not release all stops is older than one of them, and starts nothing.
        """
        now = self._ownership.now
        own = now.owner == (request.owner or UNKNOWN_OPERATOR)
        if request.into_stop:
            return own or now.kind == "task"
        if not request.stops or self.interlocks.stops:
            return False
        return own or (now.asked and now.owner == UNKNOWN_OPERATOR) or request.override

    def continue_hold(self, goal: str, joined: str) -> None:
        """Keep a hold of the scene monitor when a goal is joined, until the monitor has checked the new path."""
        for holder, held in self._held_goals.items():
            if held == goal:
                self._held_goals[holder] = joined

    def hold_at_start(self, goal: str, reason: str) -> None:
        """Hold a goal that is about to be accepted at its start, until the coordinator of the arms releases it."""
        self._held_goals["coordinator"] = goal
        self._hold_internally("coordinator", True, reason)

    def _hold_internally(self, holder: Literal["scene_monitor", "coordinator"], hold: bool, reason: str) -> None:
        self.interlocks.set_internal_hold(holder, hold, reason)
        self._arm.hold(hold, reason, holder)
        self.apply_interlocks()

    def hold_by_controller(self, hold: bool, reason: str = "") -> None:
        """Bring the arm to rest on its path for a reason of the executor itself, or release that hold."""
        if hold != self._holding:
            self._holding = hold
            self.interrupt_jogging()
            self.interlocks.set_internal_hold("controller", hold, reason)
            self._arm.hold(hold, reason, "controller")
            self.apply_interlocks()

    def apply_interlocks(self) -> None:
        """Hold the arm as operators require, and put all interlocks into its status."""
        reasons = [hold.reason for hold in self.interlocks.holds]
        self._arm.reports.interlocks = self.interlocks.all
        self._arm.hold(bool(reasons), "; ".join(filter(None, reasons)), "operator")
