"""Requests of a task: sent until they are answered, executed once, and cancelled by a stop or a newer request."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any, Generic, Protocol, TypeVar

from common import messages as m
from common import topics
from common.process.timing import RETRY_CODES, call_until_answered
from common.tasks.stages import Command, View
from common.time_source import wall_ns
from common.transport.bus import Bus
from common.transport.requests import Client

GOAL_TIMEOUT = 1.0  # [s] wall: for a goal to be accepted
PLAN_OVERTIME = 5.0  # [s] wall: that a plan may take beyond its planning time
REFUSAL_DELAY = 0.1  # [s] wall: after the second refused motion in a row; doubles with each further one
LONGEST_REFUSAL_DELAY = 2.0  # [s] wall
RELEASE = "release"  # kind of a command that ends an operator's hold
SELF_RELEASING = m.SELF_RELEASING  # owners of holds that they release themselves

# Unanswered stops and holds of an operator, each with its interlock's kind and owner.
Pending = dict[asyncio.Task[m.MotionStatus | None], tuple[str, str]]

Q = TypeVar("Q", bound=m.Message)
V = TypeVar("V", bound=View)
V_contra = TypeVar("V_contra", bound=View, contravariant=True)


class AnswerHandler(Protocol[V_contra]):
    """The part of a task that receives answers."""

    def on_plan(self, response: m.PlanResponse, view: V_contra) -> None:
        """Handle a plan or its refusal."""

    def on_goal(self, answer: m.MotionStatus | m.GripperState, view: V_contra) -> None:
        """Handle whether a goal was accepted."""

    def on_output(self, reply: m.IoReply, view: V_contra) -> None:
        """Handle whether an output was set."""


class TaskRequests(Generic[V]):
    """Sends the commands of a task and returns the answers to it."""

    def __init__(
        self, bus: Bus, task: AnswerHandler[V], observe: Callable[[], V], planning_time: Callable[[], float],
        report: Callable[[str], None], wake: Callable[[], None], *, io: bool = False,
    ) -> None:
        """Declare the requests of a task.

        Args:
            bus: of the service.
            task: receives the answers.
            observe: returns the current view.
            planning_time: returns the planning time that the task requests [s, wall].
            report: receives why a request is sent again.
            wake: called after each answer.
            io: whether the cell has outputs to set.
        """
        self._task, self._observe, self._bus = task, observe, bus
        self._planning_time, self._report, self._wake = planning_time, report, wake
        self._plan, self._execute = bus.client(topics.MOTION_PLAN), bus.client(topics.MOTION_EXECUTE)
        self._force = bus.client(topics.MOTION_FORCE)
        self._stop, self._grip = bus.client(topics.MOTION_STOP), bus.client(topics.GRIPPER_COMMAND)
        self._hold = bus.client(topics.MOTION_HOLD)
        self._output = bus.client(topics.IO_SET) if io else None
        self._sending: dict[str, asyncio.Task[m.MotionStatus | None]] = {}  # the newest of each kind
        self._pending: Pending = {}
        self._finished: dict[int, asyncio.Event] = {}  # by id() of a command: set when it is answered or cancelled
        self._refused = 0  # motions in a row
        self._newest = 0  # `since` of the newest interlock in an answer

    @property
    def serving(self) -> dict[str, bool]:
        """Whether the services that plan and move are available, by name."""
        return {client.server: client.available for client in (self._plan, self._execute)}

    def begin(self, group: asyncio.TaskGroup, command: Command) -> None:
        """Send a command, and stop sending unanswered ones that it makes void."""
        if isinstance(command, m.ExecuteRequest | m.GripperCommand | m.IoSet):
            command.header = self._bus.header()  # time of the decision, also when it is sent again
        pending = {sending: owner for sending, owner in self._pending.items() if not sending.done()}
        self._sending = {kind: sending for kind, sending in self._sending.items() if not sending.done()}
        releases = isinstance(command, m.HoldRequest) and command.by == "operator" and not command.hold
        for kind in _voided(command):
            void = self._sending.pop(kind, None)
            if void is not None:
                void.cancel()
        sending = self._sending[_kind(command)] = group.create_task(
            self._send_after(command, pending if releases else {}, self._newest_seen() if releases else None))
        sending.add_done_callback(lambda _: self._finish(command))
        if not releases and isinstance(command, m.HoldRequest | m.StopRequest) and command.by == "operator":
            interlock = "stopped" if isinstance(command, m.StopRequest) else "held"
            self._pending = {**pending, sending: (interlock, command.owner or m.UNKNOWN_OPERATOR)}

    async def carried_out(self, commands: list[Command]) -> bool:
        """Return whether the commands were answered in time; does not wait while no executor is available."""
        if not self._hold.available:
            return not commands
        events = {id(command): asyncio.Event() for command in commands}
        self._finished |= events
        try:
            async with asyncio.timeout(GOAL_TIMEOUT):
                for event in events.values():
                    await event.wait()
            return True
        except TimeoutError:
            return False
        finally:
            for number in events:
                self._finished.pop(number, None)

    async def _send_after(self, command: Command, before: Pending, seen: int | None) -> m.MotionStatus | None:
        """Send a command once the stops and holds before it are answered; a refusal is an answer too.

        A release ends the interlocks that were `seen` when it was requested, and those of this task before it.
        """
        seen = wall_ns() if seen is None else seen  # executor unknown: interlocks set from now on stay
        if before:  # a release must not overtake what it releases
            await asyncio.wait(before)
        if isinstance(command, m.HoldRequest) and command.by == "operator" and not command.hold:
            command.acknowledged = _release_until(seen, before) if command.acknowledged is None else min(
                command.acknowledged, max(seen, self._newest_seen() or 0))
        return await self._send(command)

    def _finish(self, command: Command) -> None:
        """Record that a command was answered or cancelled, which may be before it was sent."""
        if event := self._finished.get(id(command)):
            event.set()

    async def _send(self, command: Command) -> m.MotionStatus | None:
        """Send a command until it is answered, and return the answer to a hold or stop."""
        if isinstance(command, m.PlanRequest):
            planned = await call_until_answered(
                self._plan, command, self._planning_time() + PLAN_OVERTIME, lambda error: m.PlanResponse(
                    id=command.id, ok=False, error=error.code, message=error.message), self._report)
            self._task.on_plan(planned, self._observe())
            self._wake()
        elif isinstance(command, m.GripperCommand):
            gripped = await call_until_answered(self._grip, command, GOAL_TIMEOUT, lambda error: m.GripperState(
                id=command.id, state="rejected", error=error.code, message=error.message), self._report)
            await self._deliver(gripped)
        elif isinstance(command, m.ExecuteRequest):
            client: Client[Any, m.MotionStatus] = (
                self._force if isinstance(command, m.ForceMotion) else self._execute)
            moved = await call_until_answered(client, command, GOAL_TIMEOUT, lambda error: m.MotionStatus(
                id=command.id, state="rejected", error=error.code, message=error.message), self._report)
            await self._deliver(moved)
        elif isinstance(command, m.IoSet):
            await self._set_output(command)
        elif isinstance(command, m.HoldRequest):
            return await self._set_interlock(self._hold, command)
        else:
            return await self._set_interlock(self._stop, command)
        return None

    async def _set_output(self, command: m.IoSet) -> None:
        assert self._output is not None, "a task sets outputs only in a cell that has some"
        reply = await call_until_answered(self._output, command, GOAL_TIMEOUT, lambda error: m.IoReply(
            id=command.id, signal=command.signal, error=error.code, message=error.message), self._report)
        if reply.error:  # the reason is published, too: do not request again before it is received
            await asyncio.sleep(REFUSAL_DELAY)
        self._task.on_output(reply, self._observe())
        self._wake()

    async def _deliver(self, answer: m.MotionStatus | m.GripperState) -> None:
        """Pass the reply to a goal to the task; delay it more and more after repeated rejections."""
        self._refused = self._refused + 1 if answer.state == "rejected" else 0
        if self._refused > 1:
            await asyncio.sleep(min(REFUSAL_DELAY * 2 ** min(self._refused - 2, 10), LONGEST_REFUSAL_DELAY))
        self._task.on_goal(answer, self._observe())
        self._wake()

    async def _set_interlock(self, client: Client[Q, m.MotionStatus], request: Q) -> m.MotionStatus:
        """Send a stop or hold until the executor has accepted it, and return the answer."""
        answer = await call_until_answered(
            client, request, GOAL_TIMEOUT, lambda error: m.MotionStatus(message=error.message), self._report,
            RETRY_CODES)
        self._newest = max(self._newest, answer.newest)
        self._wake()
        return answer

    def _newest_seen(self) -> int | None:
        """Return `since` of the newest known interlock; None if the state of the robot is unknown."""
        view = self._observe()
        motion = view.motion if view else None
        return self._newest or None if motion is None else max(self._newest, motion.newest)


def _kind(command: Command) -> str:
    """Return the kind of a command, of which only the newest counts; each owner's holds are a kind of their own."""
    if isinstance(command, m.ExecuteRequest):  # force motions, too
        return f"{m.ExecuteRequest.__name__} "
    if not isinstance(command, m.HoldRequest):
        return f"{type(command).__name__} "
    if command.by == "operator":
        return f"{type(command).__name__} operator {command.owner}" if command.hold else RELEASE
    return f"{type(command).__name__} {command.by}"


def _release_until(seen: int, before: Pending) -> int:
    """Return `since` of the newest interlock to release: one that was seen, or set by an answer since.

    An interlock that another operator set in between stays, and so do all later ones.
    """
    answers = [sending.result() for sending in before if not sending.cancelled() and sending.exception() is None]
    interlocks = {one.since: one for answer in answers if answer is not None for one in answer.interlocks
                if one.kind == "stopped" or one.by not in SELF_RELEASING}
    for since in sorted(interlocks):
        if since > seen:
            if (interlocks[since].kind, interlocks[since].by) not in before.values():
                break
            seen = since
    return seen


def _voided(command: Command) -> tuple[str, ...]:
    """Return the kinds of unanswered commands that a command makes void.

    A stop voids the motion and the output before it, an operator's stop also a release; a hold voids the earlier one
    of the same owner.
    """
    if isinstance(command, m.StopRequest):
        release = (RELEASE,) if command.by == "operator" else ()
        return f"{m.ExecuteRequest.__name__} ", f"{m.IoSet.__name__} ", *release
    if not isinstance(command, m.HoldRequest):
        return ()
    return _kind(command), *((RELEASE,) if command.by == "operator" else ())
