"""Runs a task: steps it whenever something is heard, and asks for what it wants until somebody answers."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Iterable
from typing import Any, Generic, Protocol, TypeVar

from common import messages as m
from common import topics
from common.errors import Refused, RequestFailed
from common.process.orders import BY_THEMSELVES, GOAL_TIMEOUT, Answered, Orders
from common.process.task_memory import Memory
from common.robot.model import RobotModel
from common.robot.transforms import matrix_to_pose
from common.sources import monotonic, new_id
from common.tasks.decisions import TaskConfig
from common.tasks.engine import Task
from common.tasks.monitoring import LOOK_PERIOD, LivenessWatchdog
from common.tasks.stages import Command, View, within_range
from common.topics import Topic
from common.transport.bus import Bus
from common.transport.reader import Reader
from common.transport.writer import Writer

LONGEST_STEP = LOOK_PERIOD  # [s] wall: time passes too
WAITS = "the arm waits: "
ENDED = ("DONE", "ERROR")
NOT_ANSWERED = "trajectory_executor has not answered yet: until it does, this does not outlive the task"
OWN_PERIOD = 0.2  # [s] wall between two times that the motion is asked for: what came of it is heard meanwhile
SHARED_HOLDERS = ("", m.UNKNOWN_OPERATOR, *BY_THEMSELVES)  # whose holds are no named operator's

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
    perceived: m.PlanningScene | None = None

    def look() -> V:
        nonlocal measured, perceived
        known.now = bus.clock.now()
        if scene.latest is not None and scene.latest is not perceived:
            perceived = scene.latest
            known.scene = within_range(perceived)
        known.motion = motion.latest
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
    memory = Memory(bus, task)
    runner = TaskRunner(bus, task, look, out, lambda: config.planning_time, watchdog, memory)
    await memory.begin()
    await bus.ready()
    await runner.run((*own.values(), scene, gripper, motion))


class Stepped(Answered[V_contra], Protocol[V_contra]):
    """A state machine that is fed with what is known and answers with what it wants done, as `Task` is."""

    @property
    def status(self) -> m.TaskStatus:
        """How far it is."""

    def step(self, view: V_contra) -> list[Command]:
        """What to ask for now."""

    def command(self, command: str, view: V_contra) -> list[Command]:
        """Do what a person says."""


class TaskRunner(Generic[V]):
    """Steps a task, has sent what it asks for, and tells it what persons say and how far it is to others."""

    def __init__(
        self, bus: Bus, task: Stepped[V], look: Callable[[], V], status: Writer[Any],
        planning_time: Callable[[], float], watchdog: LivenessWatchdog | None = None, memory: Memory | None = None,
    ) -> None:
        """Declare the requests of a task and the command that it serves.

        Args:
            bus: of the service.
            task: is stepped.
            look: what is known now.
            status: where the task's status goes.
            planning_time: that the task asks for now [s, wall].
            watchdog: holds the arm while those are missing that the task relies on.
            memory: keeps what the task is to know when it is started again.
        """
        self._task, self._look, self._status, self._bus = task, look, status, bus
        self._woken = asyncio.Event()
        self._orders = Orders(bus, task, look, planning_time, self._note, self._woken.set)
        self._own, self._owner = bus.client(topics.MOTION_OWN), bus.reader(topics.MOTION_OWNER)
        self._owning: asyncio.Task[None] | None = None
        self._watchdog, self._memory = watchdog, memory
        self._told: list[Command] = []
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
                    self._orders.begin(group, command)
                self._tell()
                if self._memory is not None:
                    self._memory.keep(group)
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
        holds = self._watchdog.update(monotonic(), self._orders.serving, view.motion)
        view.trouble = self._watchdog.trouble
        return holds

    async def _obey(self, command: m.TaskCommand) -> m.TaskStatus:
        self._bus.log.info("told to %s%s", command.command, f" by {command.by}" if command.by else "")
        view = self._look()
        _require_allowed(command, view.motion if view else None, self._owner.latest)
        asked = self._task.command(command.command, view)
        for request in asked:
            if isinstance(request, m.HoldRequest | m.StopRequest) and request.by == "operator":
                request.owner = command.by
            if isinstance(request, m.HoldRequest):
                request.override = command.override and not request.hold
                request.acknowledged = command.acknowledged
        self._told += asked
        self._woken.set()
        now, answered = self._task.status, await self._orders.carried_out(asked)
        return m.TaskStatus(
            header=self._bus.header(), state=now.state, paused=now.paused, started=now.started, stage=now.stage,
            message=now.message if answered else NOT_ANSWERED,
        )

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


def _require_allowed(command: m.TaskCommand, motion: m.MotionStatus | None, owner: m.MotionOwner | None) -> None:
    """Return when a person may say that.

    Raises:
        Refused: another person holds the robot or has the motion, or it was stopped and can only be started.
    """
    if command.command == "resume" and motion is not None and motion.stopped:
        raise Refused("stopped", f"the robot is {motion.stopped}: start the task to go on")
    if command.override or command.command not in ("start", "resume"):
        return
    unnamed = m.UNKNOWN_OPERATOR
    if owner is not None and owner.asked and owner.kind != "task" and owner.owner not in (unnamed, command.by):
        raise Refused("not_owner", f"the motion is {owner.description}: only the owner gives it back; else override")
    if motion is None:
        return
    others = [interlock.description for interlock in motion.interlocks
              if interlock.kind == "held" and interlock.by not in (*SHARED_HOLDERS, command.by)]
    if others:
        raise Refused("held", f"the robot is {'; '.join(others)}: only they let go of it, unless you override that")
