"""What a task asks for: sent until somebody answers, nothing twice, void when a stop or what follows makes it so."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Generic, Protocol, TypeVar

from common import messages as m
from common import topics
from common.process.persist import NOT_TAKEN, persist
from common.sources import wall_ns
from common.tasks.stages import Command, View
from common.transport.bus import Bus
from common.transport.requests import Client

GOAL_TIMEOUT = 1.0  # [s] wall: for a goal to be accepted
PLAN_OVERTIME = 5.0  # [s] wall: that a plan may take beyond its planning time
REFUSED_AGAIN = 0.1  # [s] wall: what is told of the second refusal of a motion in a row; it doubles with each
LONGEST_REFUSED = 2.0  # [s] wall
LETS_GO = "lets go"  # of what a person said
BY_THEMSELVES = ("watchdog", "controller", "scene_monitor")  # let go of their holds: no person does

# A person's stops and holds that were not answered yet, as kind and name of who said so.
Keeping = dict[asyncio.Task[m.MotionStatus | None], tuple[str, str]]

Q = TypeVar("Q", bound=m.Message)
V = TypeVar("V", bound=View)
V_contra = TypeVar("V_contra", bound=View, contravariant=True)


class Answered(Protocol[V_contra]):
    """What asked, as far as it is told the answers."""

    def on_plan(self, response: m.PlanResponse, view: V_contra) -> None:
        """Take in a plan."""

    def on_goal(self, answer: m.MotionStatus | m.GripperState, view: V_contra) -> None:
        """Take in whether a goal was accepted."""


class Orders(Generic[V]):
    """Sends what a task asks for and brings the answers back."""

    def __init__(
        self, bus: Bus, task: Answered[V], look: Callable[[], V], planning_time: Callable[[], float],
        note: Callable[[str], None], wake: Callable[[], None],
    ) -> None:
        """Declare the requests of a task.

        Args:
            bus: of the service.
            task: is told the answers.
            look: what is known now.
            planning_time: that the task asks for now [s, wall].
            note: is told why something has to be asked again.
            wake: is called when an answer came.
        """
        self._task, self._look, self._bus = task, look, bus
        self._planning_time, self._note, self._wake = planning_time, note, wake
        self._plan, self._execute = bus.client(topics.MOTION_PLAN), bus.client(topics.MOTION_EXECUTE)
        self._stop, self._grip = bus.client(topics.MOTION_STOP), bus.client(topics.GRIPPER_COMMAND)
        self._hold = bus.client(topics.MOTION_HOLD)
        self._asking: dict[str, asyncio.Task[m.MotionStatus | None]] = {}  # the newest of each kind
        self._keeping: Keeping = {}
        self._ended: dict[int, asyncio.Event] = {}  # by the identity of a command: whether it was answered, or is void
        self._refused = 0  # motions in a row
        self._newest = 0  # `since` of the newest interlock that we were answered with

    @property
    def serving(self) -> dict[str, bool]:
        """Whether those are there that plan and move, by service."""
        return {client.server: client.available for client in (self._plan, self._execute)}

    def begin(self, group: asyncio.TaskGroup, command: Command) -> None:
        """Send a command; what it makes void is not asked for again, should it still be without an answer."""
        if isinstance(command, m.ExecuteRequest | m.GripperCommand):
            command.header = self._bus.header()  # of the decision, however often it is sent
        keeps = {keeping: said for keeping, said in self._keeping.items() if not keeping.done()}
        self._asking = {kind: doing for kind, doing in self._asking.items() if not doing.done()}
        lets_go = isinstance(command, m.HoldRequest) and command.by == "operator" and not command.hold
        for kind in _voided(command):
            void = self._asking.pop(kind, None)
            if void is not None:
                void.cancel()
        doing = self._asking[_kind(command)] = group.create_task(
            self._do(command, keeps if lets_go else {}, self._heard_of() if lets_go else None))
        doing.add_done_callback(lambda _: self._over(command))
        if not lets_go and isinstance(command, m.HoldRequest | m.StopRequest) and command.by == "operator":
            kept = "stopped" if isinstance(command, m.StopRequest) else "held"
            self._keeping = {**keeps, doing: (kept, command.owner or m.UNKNOWN_OPERATOR)}

    async def carried_out(self, asked: list[Command]) -> bool:
        """Whether that was answered, which is not waited for while nobody is there to answer."""
        if not self._hold.available:
            return not asked
        events = {id(command): asyncio.Event() for command in asked}
        self._ended |= events
        try:
            async with asyncio.timeout(GOAL_TIMEOUT):
                for event in events.values():
                    await event.wait()
            return True
        except TimeoutError:
            return False
        finally:
            for number in events:
                self._ended.pop(number, None)

    async def _do(self, command: Command, before: Keeping, acknowledged: int | None) -> m.MotionStatus | None:
        """Send what a command stands for, after what was said before it; what is refused is an answer too.

        What lets go does so of what was `heard` of until it was said, and of what was said here before it.
        """
        if acknowledged is None:  # a robot that is away: interlocks set while it is asked stay
            acknowledged = wall_ns()
        if before:  # what lets go must not be overtaken by what it lets go of
            await asyncio.wait(before)
        if isinstance(command, m.HoldRequest) and command.by == "operator" and not command.hold:
            command.acknowledged = _until(acknowledged, before) if command.acknowledged is None else min(
                command.acknowledged, max(acknowledged, self._heard_of() or 0))
        return await self._send(command)

    def _over(self, command: Command) -> None:
        """Take note that a command was answered, or is void: that may be so before its first turn."""
        if ended := self._ended.get(id(command)):
            ended.set()

    async def _send(self, command: Command) -> m.MotionStatus | None:
        """The answer to a hold or stop, else None."""
        if isinstance(command, m.PlanRequest):
            planned = await persist(
                self._plan, command, self._planning_time() + PLAN_OVERTIME, lambda error: m.PlanResponse(
                    id=command.id, ok=False, error=error.code, message=error.message), self._note)
            self._task.on_plan(planned, self._look())
            self._wake()
        elif isinstance(command, m.GripperCommand):
            gripped = await persist(self._grip, command, GOAL_TIMEOUT, lambda error: m.GripperState(
                id=command.id, state="rejected", error=error.code, message=error.message), self._note)
            await self._answered(gripped)
        elif isinstance(command, m.ExecuteRequest):
            moved = await persist(self._execute, command, GOAL_TIMEOUT, lambda error: m.MotionStatus(
                id=command.id, state="rejected", error=error.code, message=error.message), self._note)
            await self._answered(moved)
        elif isinstance(command, m.HoldRequest):
            return await self._keep(self._hold, command)
        else:
            return await self._keep(self._stop, command)
        return None

    async def _answered(self, answer: m.MotionStatus | m.GripperState) -> None:
        """Tell how a goal was answered; what is refused again and again is not asked for as fast as one can."""
        self._refused = self._refused + 1 if answer.state == "rejected" else 0
        if self._refused > 1:
            await asyncio.sleep(min(REFUSED_AGAIN * 2 ** min(self._refused - 2, 10), LONGEST_REFUSED))
        self._task.on_goal(answer, self._look())
        self._wake()

    async def _keep(self, client: Client[Q, m.MotionStatus], request: Q) -> m.MotionStatus:
        """The answer to a stop or hold, which is asked for until it was taken."""
        answer = await persist(client, request, GOAL_TIMEOUT, lambda error: m.MotionStatus(message=error.message),
                               self._note, NOT_TAKEN)
        self._newest = max(self._newest, answer.newest)
        self._wake()
        return answer

    def _heard_of(self) -> int | None:
        """`since` of the newest interlock that we know of; None when we know nothing of the robot."""
        view = self._look()
        motion = view.motion if view else None
        return self._newest or None if motion is None else max(self._newest, motion.newest)


def _kind(command: Command) -> str:
    """What a command is of which only the newest counts; a watchdog's hold is not a person's, nor that another's."""
    if not isinstance(command, m.HoldRequest):
        return f"{type(command).__name__} "
    if command.by == "operator":
        return f"{type(command).__name__} person {command.owner}" if command.hold else LETS_GO
    return f"{type(command).__name__} {command.by}"


def _until(acknowledged: int, before: Keeping) -> int:
    """`since` of the newest interlock to let go of: one that was heard of, or that was answered meanwhile.

    What somebody else said before those were answered, and all later than that, stays.
    """
    answers = [doing.result() for doing in before if not doing.cancelled() and doing.exception() is None]
    interlocks = {one.since: one for answer in answers if answer is not None for one in answer.interlocks
                if one.kind == "stopped" or one.by not in BY_THEMSELVES}
    for since in sorted(interlocks):
        if since > acknowledged:
            if (interlocks[since].kind, interlocks[since].by) not in before.values():
                break
            acknowledged = since
    return acknowledged


def _voided(command: Command) -> tuple[str, ...]:
    """The kinds of command that are void from now on.

    By a stop the motion before it, by a person's also what was to let go; by a hold that person's one before it.
    """
    if isinstance(command, m.StopRequest):
        return f"{m.ExecuteRequest.__name__} ", *((LETS_GO,) if command.by == "operator" else ())
    if not isinstance(command, m.HoldRequest):
        return ()
    return _kind(command), *((LETS_GO,) if command.by == "operator" else ())
