"""Runs a task: steps it whenever something is heard, and asks for what it wants until somebody answers."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Iterable
from typing import Any, Generic, Protocol, TypeVar

from common import messages as m
from common import topics
from common.errors import Refused, RequestFailed
from common.process.persist import NOT_TAKEN, persist
from common.robot.model import RobotModel
from common.robot.transforms import matrix_to_pose
from common.sources import monotonic, new_id, wall_ns
from common.tasks.deciding import TaskConfig
from common.tasks.engine import Task
from common.tasks.stages import Command, View
from common.tasks.watchdogs import LOOK_PERIOD, LivenessWatchdog
from common.topics import Topic
from common.transport.bus import Bus
from common.transport.reader import Reader
from common.transport.requests import Client
from common.transport.writer import Writer

Q = TypeVar("Q", bound=m.Message)

GOAL_TIMEOUT = 1.0  # [s] wall: for a goal to be accepted
PLAN_OVERTIME = 5.0  # [s] wall: that a plan may take beyond its planning time
REFUSED_AGAIN = 0.1  # [s] wall: what is told of the second refusal of a motion in a row; it doubles with each
LONGEST_REFUSED = 2.0  # [s] wall
LONGEST_STEP = LOOK_PERIOD  # [s] wall: time passes too
WAITS = "the arm waits: "
ENDED = ("DONE", "ERROR")
NOT_ANSWERED = "trajectory_executor has not answered yet: until it does, this does not outlive the task"
OWN_PERIOD = 0.2  # [s] wall between two times that the motion is asked for: what came of it is heard meanwhile
SOMEBODY = ("", "person", "watchdog", "controller", "scene_monitor")  # whose holds are nobody's own

LETS_GO = "lets go"  # of what a person said

# A person's stops and holds that were not answered yet, as kind and name of who said so.
Keeping = dict[asyncio.Task[m.MotionStatus | None], tuple[str, str]]

C = TypeVar("C", bound=TaskConfig)
S = TypeVar("S", bound=m.TaskStatus)
V = TypeVar("V", bound=View)
V_contra = TypeVar("V_contra", bound=View, contravariant=True)


async def run_task(
    bus: Bus, config: C, make: Callable[[C, S, str, float], Task[V]], status: Topic[S], view: Callable[..., V],
    **reads: Topic[Any],
) -> None:
    """Be the service of a task: step it whenever something is heard, and at least 20 times a second.

    Args:
        bus: of the service.
        config: of the task.
        make: the class of the task.
        status: where it says how far it is.
        view: the class of what it knows: `View`, or one of the application's own.
        reads: by the name of a field of that view, the topic whose newest message stands in it.
    """
    scene, gripper = bus.reader(topics.PLANNING_SCENE), bus.reader(topics.GRIPPER_STATE)
    motion, joints = bus.reader(topics.MOTION_STATUS), bus.reader(topics.JOINT_STATES)
    own = {name: bus.reader(topic) for name, topic in reads.items()}
    out = bus.writer(status)
    robot = RobotModel.load(config.robot)
    task = make(config, status.message(), new_id(), bus.clock.speed)
    known = view(now=bus.clock.now())
    measured: m.JointState | None = None

    def look() -> V:
        nonlocal measured
        known.now = bus.clock.now()
        known.scene, known.motion = scene.latest, motion.latest
        known.gripper = gripper.latest if config.robot.gripper is not None else m.GripperState()
        for name, reader in own.items():
            setattr(known, name, reader.latest)
        newest = joints.latest
        if newest is not None and newest is not measured:
            measured = newest
            q = robot.order(newest.name, newest.position)
            if q is not None:
                known.q, known.tcp = q.tolist(), matrix_to_pose(robot.fk(q))
        return known

    watchdog = LivenessWatchdog(lambda: joints.received, lambda: config.joint_states_timeout)
    runner = TaskRunner(bus, task, look, out, lambda: config.planning_time, watchdog)
    await bus.ready()
    await runner.run((*own.values(), scene, gripper, motion))


class Stepped(Protocol[V_contra]):
    """A state machine that is fed with what is known and answers with what it wants done, as `Task` is."""

    @property
    def status(self) -> m.TaskStatus:
        """How far it is."""

    def step(self, view: V_contra) -> list[Command]:
        """What to ask for now."""

    def command(self, command: str, view: V_contra) -> list[Command]:
        """Do what a person says."""

    def on_plan(self, response: m.PlanResponse, view: V_contra) -> None:
        """Take in a plan."""

    def on_goal(self, answer: m.MotionStatus | m.GripperState, view: V_contra) -> None:
        """Take in whether a goal was accepted."""


class TaskRunner(Generic[V]):
    """Steps a task, sends what it asks for and brings the answers back."""

    def __init__(
        self, bus: Bus, task: Stepped[V], look: Callable[[], V], status: Writer[Any],
        planning_time: Callable[[], float], watchdog: LivenessWatchdog | None = None,
    ) -> None:
        """Declare the requests of a task and the command that it serves.

        Args:
            bus: of the service.
            task: is stepped.
            look: what is known now.
            status: where the task's status goes.
            planning_time: that the task asks for now [s, wall].
            watchdog: holds the arm while those are missing that the task relies on.
        """
        self._task, self._look, self._status, self._bus = task, look, status, bus
        self._plan, self._execute = bus.client(topics.MOTION_PLAN), bus.client(topics.MOTION_EXECUTE)
        self._stop, self._grip = bus.client(topics.MOTION_STOP), bus.client(topics.GRIPPER_COMMAND)
        self._hold, self._own = bus.client(topics.MOTION_HOLD), bus.client(topics.MOTION_OWN)
        self._owner = bus.reader(topics.MOTION_OWNER)
        self._owning: asyncio.Task[None] | None = None
        self._planning_time, self._watchdog = planning_time, watchdog
        self._woken = asyncio.Event()
        self._told: list[Command] = []
        self._asking: dict[str, asyncio.Task[m.MotionStatus | None]] = {}  # the newest of each kind
        self._keeping: Keeping = {}
        self._ended: dict[int, asyncio.Event] = {}  # by the identity of a command: whether it was answered, or is void
        self._refused = 0  # motions in a row
        self._newest = 0  # `since` of the newest inhibit that we were answered with
        self._before: m.TaskStatus | None = None
        bus.serve(topics.TASK_COMMAND, self._obey)

    async def run(self, heard: Iterable[Reader[Any]]) -> None:
        """Step whenever something is heard, and at least 20 times a second, until cancelled."""
        async with asyncio.TaskGroup() as group:
            for reader in heard:
                group.create_task(self._wake_on(reader))
            while True:
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(LONGEST_STEP):  # wait_for of Python 3.11 can lose a cancellation
                        await self._woken.wait()
                self._woken.clear()
                told, self._told = self._told, []
                view = self._look()
                holds = self._mind(view)
                for command in [*told, *holds, *self._task.step(view)]:
                    self._begin(group, command)
                self._tell()
                self._have_motion(group, view.motion if view else None)

    def _have_motion(self, group: asyncio.TaskGroup, motion: m.MotionStatus | None) -> None:
        """Have the motion of the robot from a start to the end or a stop, if it is nobody else's."""
        now, status = self._owner.latest, self._task.status
        if now is None or (self._owning is not None and not self._owning.done()):
            return
        wanted = status.started and status.state not in ENDED and not (motion and motion.stopped)
        ours = now.kind == "task" and now.owner in ("", self._bus.service)
        if wanted == (ours and now.asked) or not (ours or now.kind == "none"):
            return
        asked = m.OwnRequest(act="take" if wanted else "give", owner=self._bus.service, kind="task")
        self._owning = group.create_task(self._ask_for(asked), name="own")

    async def _ask_for(self, request: m.OwnRequest) -> None:
        with contextlib.suppress(RequestFailed):  # of who has it then the motions that are refused tell
            await self._own.call(request, GOAL_TIMEOUT)
        await asyncio.sleep(OWN_PERIOD)

    def _mind(self, view: V) -> list[m.HoldRequest]:
        """The holds to ask for, because something is missing or is back again; the view has what is missing."""
        if self._watchdog is None:
            return []
        serving = {client.server: client.available for client in (self._plan, self._execute)}
        holds = self._watchdog.look(monotonic(), serving, view.motion)
        view.trouble = self._watchdog.trouble
        return holds

    async def _obey(self, command: m.TaskCommand) -> m.TaskStatus:
        self._bus.log.info("told to %s%s", command.command, f" by {command.by}" if command.by else "")
        view = self._look()
        _require_allowed(command, view.motion if view else None, self._owner.latest)
        asked = self._task.command(command.command, view)
        for request in asked:
            if isinstance(request, m.HoldRequest | m.StopRequest) and request.by == "person":
                request.owner = command.by
            if isinstance(request, m.HoldRequest):
                request.override = command.override and not request.hold
                request.heard = command.heard
        self._told += asked
        self._woken.set()
        now, answered = self._task.status, await self._carried_out(asked)
        return m.TaskStatus(
            header=self._bus.header(), state=now.state, paused=now.paused, started=now.started, stage=now.stage,
            message=now.message if answered else NOT_ANSWERED,
        )

    async def _carried_out(self, asked: list[Command]) -> bool:
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

    def _tell(self) -> None:
        """Publish the status when more of it has changed than the time."""
        now, before = self._task.status, self._before
        trouble = self._watchdog.trouble if self._watchdog else ""
        if trouble and now.state not in ENDED:
            now.message = f"{WAITS}{trouble}"
        elif now.message.startswith(WAITS):
            now.message = ""
        if before and before.same_but(now, "task_seconds", "header"):
            return
        if now.state == "ERROR" and (before is None or before.state != "ERROR"):
            self._bus.log.error("%s", now.message)
        elif now.message not in ("", before.message if before else "") or (before and now.state != before.state):
            self._bus.log.info("%s", f"{now.state} {now.message}".rstrip())
        now.header = self._bus.header()
        self._status.put(now)
        self._before = now.model_copy(deep=True)

    def _note(self, problem: str) -> None:
        self._task.status.message = problem

    async def _wake_on(self, reader: Reader[Any]) -> None:
        async for _ in reader:
            self._woken.set()

    def _begin(self, group: asyncio.TaskGroup, command: Command) -> None:
        """Send a command; what it makes void is not asked for again, should it still be without an answer."""
        if isinstance(command, m.ExecuteRequest | m.GripperCommand):
            command.header = self._bus.header()  # of the decision, however often it is sent
        keeps = {keeping: said for keeping, said in self._keeping.items() if not keeping.done()}
        lets_go = isinstance(command, m.HoldRequest) and command.by == "person" and not command.hold
        for kind in _voided(command):
            void = self._asking.pop(kind, None)
            if void is not None:
                void.cancel()
        doing = self._asking[_kind(command)] = group.create_task(
            self._do(command, keeps if lets_go else {}, self._heard_of() if lets_go else None))
        if not lets_go and isinstance(command, m.HoldRequest | m.StopRequest) and command.by == "person":
            kept = "stopped" if isinstance(command, m.StopRequest) else "held"
            self._keeping = {**keeps, doing: (kept, command.owner or SOMEBODY[1])}

    async def _do(self, command: Command, before: Keeping, heard: int | None) -> m.MotionStatus | None:
        """Send what a command stands for, after what was said before it; what is refused is an answer too.

        What lets go does so of what was `heard` of until it was said, and of what was said here before it.
        """
        heard = wall_ns() if heard is None else heard  # of a robot that is away: what is said while it is asked stays
        try:
            if before:  # what lets go must not be overtaken by what it lets go of
                await asyncio.wait(before)
            if isinstance(command, m.HoldRequest) and command.by == "person" and not command.hold:
                command.heard = _until(heard, before) if command.heard is None else min(
                    command.heard, max(heard, self._heard_of() or 0))
            return await self._send(command)
        finally:
            if ended := self._ended.get(id(command)):
                ended.set()

    async def _send(self, command: Command) -> m.MotionStatus | None:
        """The answer to a hold or stop, else None."""
        if isinstance(command, m.PlanRequest):
            planned = await persist(
                self._plan, command, self._planning_time() + PLAN_OVERTIME, lambda error: m.PlanResponse(
                    id=command.id, ok=False, error=error.code, message=error.message), self._note)
            self._task.on_plan(planned, self._look())
            self._woken.set()
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
        self._woken.set()

    async def _keep(self, client: Client[Q, m.MotionStatus], request: Q) -> m.MotionStatus:
        """The answer to a stop or hold, which is asked for until it was taken."""
        answer = await persist(client, request, GOAL_TIMEOUT, lambda error: m.MotionStatus(message=error.message),
                               self._note, NOT_TAKEN)
        self._newest = max(self._newest, answer.newest)
        self._woken.set()
        return answer

    def _heard_of(self) -> int | None:
        """`since` of the newest inhibit that we know of; None when we know nothing of the robot."""
        view = self._look()
        motion = view.motion if view else None
        return self._newest or None if motion is None else max(self._newest, motion.newest)


def _kind(command: Command) -> str:
    """What a command is of which only the newest counts; a watchdog's hold is not a person's."""
    if isinstance(command, m.HoldRequest) and command.by == "person" and not command.hold:
        return LETS_GO
    return f"{type(command).__name__} {command.by if isinstance(command, m.HoldRequest) else ''}"


def _until(heard: int, before: Keeping) -> int:
    """`since` of the newest inhibit to let go of: one that was heard of, or that was answered meanwhile.

    What somebody else said before those were answered, and all later than that, stays.
    """
    answers = [doing.result() for doing in before if not doing.cancelled() and doing.exception() is None]
    inhibits = {one.since: one for answer in answers if answer is not None for one in answer.inhibits}
    for since in sorted(inhibits):
        if since > heard:
            if (inhibits[since].kind, inhibits[since].by) not in before.values():
                break
            heard = since
    return heard


def _voided(command: Command) -> tuple[str, ...]:
    """The kinds of command that are void from now on.

    By a stop the motion before it, by a person's also what was to let go; by a hold the one before it.
    """
    if isinstance(command, m.StopRequest):
        return f"{m.ExecuteRequest.__name__} ", *((LETS_GO,) if command.by == "person" else ())
    if not isinstance(command, m.HoldRequest):
        return ()
    return _kind(command), *((LETS_GO,) if command.by == "person" else ())


def _require_allowed(command: m.TaskCommand, motion: m.MotionStatus | None, owner: m.MotionOwner | None) -> None:
    """Return when a person may say that.

    Raises:
        Refused: another person holds the robot or has the motion, or it was stopped and can only be started.
    """
    if command.command == "resume" and motion is not None and motion.stopped:
        raise Refused("stopped", f"the robot is {motion.stopped}: start the task to go on")
    if command.override or command.command not in ("start", "resume"):
        return
    if owner is not None and owner.asked and owner.kind != "task" and owner.owner not in (SOMEBODY[1], command.by):
        raise Refused("not_owner", f"the motion is {owner.told}: only they hand it over, unless you override that")
    if motion is None:
        return
    others = [inhibit.told for inhibit in motion.inhibits
              if inhibit.kind == "held" and inhibit.by not in (*SOMEBODY, command.by)]
    if others:
        raise Refused("held", f"the robot is {'; '.join(others)}: only they let go of it, unless you override that")
