"""Runs a task: steps it after each received message, sends its requests, publishes its status, persists its memory."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable, Iterable
from typing import Any, Generic, Protocol, TypeVar

from common import messages as m
from common import topics
from common.atomic_file import AtomicFile, Unreadable, runtime_folder
from common.errors import Refused, RequestFailed
from common.process.task_requests import GOAL_TIMEOUT, SELF_RELEASING, AnswerHandler, TaskRequests
from common.robot.model import RobotModel
from common.robot.transforms import matrix_to_pose
from common.tasks.decisions import TaskConfig
from common.tasks.engine import START, Task
from common.tasks.monitoring import LOOK_PERIOD, LivenessWatchdog
from common.tasks.stages import Command, View, within_range
from common.time_source import monotonic, new_id
from common.topics import Topic
from common.transport.bus import Bus
from common.transport.reader import Reader
from common.transport.writer import Writer

LONGEST_STEP = LOOK_PERIOD  # [s] wall: timeouts of the task need steps without messages too
WAITS = "the arm waits: "
ENDED = ("DONE", "ERROR")
NOT_ANSWERED = "trajectory_executor has not answered yet: until it does, this is lost when the task ends"
OWN_PERIOD = 0.2  # [s] wall between two requests for motion authority, in which the new owner is received
UNNAMED = ("", m.UNKNOWN_OPERATOR, *SELF_RELEASING)  # owners whose holds any operator may release
SAVE_RETRY = 2.0  # [s] wall after the memory could not be written

C = TypeVar("C", bound=TaskConfig)
S = TypeVar("S", bound=m.TaskStatus)
V = TypeVar("V", bound=View)
V_contra = TypeVar("V_contra", bound=View, contravariant=True)


async def run_task(
    bus: Bus, config: C, make: Callable[[C, S, str, float], Task[V]], status: Topic[S], view: Callable[..., V], *,
    runner: Callable[..., TaskRunner[V]] | None = None, memory: Callable[[Bus, Any], TaskMemory] | None = None,
    **reads: Topic[Any],
) -> None:
    """Run the service of a task: step it after each received message, and at least 20 times a second.

    Args:
        bus: of the service.
        config: of the task.
        make: class of the task.
        status: topic of its status.
        view: class of its input: `View`, or a subclass of the application.
        runner: class derived from `TaskRunner` that serves further requests.
        memory: class derived from `TaskMemory`.
        reads: topics whose newest messages the view holds, by the name of its field.
    """
    scene, gripper = bus.reader(topics.PLANNING_SCENE), bus.reader(topics.GRIPPER_STATE)
    motion, joints = bus.reader(topics.MOTION_STATUS), bus.reader(topics.JOINT_STATES)
    own = {name: bus.reader(topic) for name, topic in reads.items()}
    signals = [bus.reader(topics.IO_STATE)] if config.io.signals else []
    outputs = bus.client(topics.IO_SET) if signals else None
    out = bus.writer(status)
    robot = RobotModel.load(config.robot)
    task = make(config, status.message(), new_id(), bus.clock.speed)
    known = view(now=bus.clock.now())
    measured: m.JointState | None = None
    perceived: m.PlanningScene | None = None

    def observe() -> V:
        nonlocal measured, perceived
        known.now = bus.clock.now()
        if scene.latest is not None and scene.latest is not perceived:
            perceived = scene.latest
            known.scene = within_range(perceived)
        known.motion = motion.latest
        known.gripper = gripper.latest if config.robot.gripper is not None else m.GripperState()
        for name, reader in own.items():
            setattr(known, name, reader.latest)
        known.io = signals[0].latest if outputs is not None and outputs.available else None
        known.blocked = task.blocked(known)
        newest = joints.latest
        if newest is not None and newest is not measured:
            measured = newest
            q = robot.order(newest.name, newest.position)
            if q is not None:
                known.q, known.tcp = q.tolist(), matrix_to_pose(robot.fk(q))
        return known

    watchdog = LivenessWatchdog(lambda: joints.received, lambda: config.joint_states_timeout)
    remembers = (memory or TaskMemory)(bus, task)
    steps = (runner or TaskRunner)(bus, task, observe, out, lambda: config.planning_time, watchdog, remembers,
                                   io=bool(signals))
    await remembers.load()
    await bus.ready()
    await steps.run((*own.values(), *signals, scene, gripper, motion))


class Steppable(AnswerHandler[V_contra], Protocol[V_contra]):
    """A state machine that turns what is known into commands; a `Task` is one."""

    @property
    def status(self) -> m.TaskStatus:
        """Its state and progress."""

    def step(self, view: V_contra) -> list[Command]:
        """Return the commands to send now."""

    def command(self, command: str, view: V_contra) -> list[Command]:
        """Handle a command of an operator and return the commands to send."""


class TaskRunner(Generic[V]):
    """Steps a task, sends its commands, serves the operators' commands, and publishes its status."""

    def __init__(
        self, bus: Bus, task: Steppable[V], observe: Callable[[], V], status: Writer[Any],
        planning_time: Callable[[], float], watchdog: LivenessWatchdog | None = None,
        memory: TaskMemory | None = None, *, io: bool = False,
    ) -> None:
        """Declare the requests of a task and the command that it serves.

        Args:
            bus: of the service.
            task: is stepped.
            observe: returns the current view.
            status: publishes the task's status.
            planning_time: returns the planning time that the task requests [s, wall].
            watchdog: holds the arm while services or messages that the task depends on are missing.
            memory: persists what the task has to know after a restart.
            io: whether the cell has inputs and outputs.
        """
        self._task, self._observe, self._status, self._bus = task, observe, status, bus
        self._woken = asyncio.Event()
        self._requests = TaskRequests(bus, task, observe, planning_time, self._report, self._woken.set, io=io)
        self._own, self._owner = bus.client(topics.MOTION_OWN), bus.reader(topics.MOTION_OWNER)
        self._owning: asyncio.Task[None] | None = None
        self._watchdog, self._memory = watchdog, memory
        self._commanded: list[Command] = []  # by an operator, to be sent in the next step
        self._published: m.TaskStatus | None = None
        bus.serve(topics.TASK_COMMAND, self._obey)

    async def run(self, readers: Iterable[Reader[Any]]) -> None:
        """Step after each received message, and at least 20 times a second, until cancelled."""
        async with asyncio.TaskGroup() as group:
            for reader in readers:
                group.create_task(self._wake_on(reader))
            while True:
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(LONGEST_STEP):  # wait_for of Python 3.11 can lose a cancellation
                        await self._woken.wait()
                self._woken.clear()
                commanded, self._commanded = self._commanded, []
                view = self._observe()
                holds = self._check_liveness(view)
                for command in [*commanded, *holds, *self._task.step(view)]:
                    self._requests.begin(group, command)
                self._publish()
                if self._memory is not None:
                    self._memory.save(group)
                self._claim_motion(group, view.motion if view else None)

    def _claim_motion(self, group: asyncio.TaskGroup, motion: m.MotionStatus | None) -> None:
        """Take motion authority from a start until the end or a stop, unless another client has it."""
        now = self._owner.latest
        if now is None or (self._owning is not None and not self._owning.done()):
            return
        needed = self._needs_motion(motion)
        ours = now.kind == "task" and now.owner in ("", self._bus.service)
        if needed == (ours and now.asked) or not (ours or now.kind == "none"):
            return
        request = m.OwnRequest(act="take" if needed else "give", owner=self._bus.service, kind="task")
        self._owning = group.create_task(self._request_authority(request), name="own")

    def _needs_motion(self, motion: m.MotionStatus | None) -> bool:
        status = self._task.status
        return status.started and status.state not in ENDED and not (motion and motion.stopped)

    async def _request_authority(self, request: m.OwnRequest) -> None:
        with contextlib.suppress(RequestFailed):  # the refusals of motions name the owner
            await self._own.call(request, GOAL_TIMEOUT)
        await asyncio.sleep(OWN_PERIOD)

    def _check_liveness(self, view: V) -> list[m.HoldRequest]:
        """Return holds to request or release because of missing messages or services; the view gets the reason."""
        if self._watchdog is None:
            return []
        holds = self._watchdog.update(monotonic(), self._requests.serving, view.motion, view.blocked)
        view.trouble = self._watchdog.trouble
        return holds

    async def _obey(self, command: m.TaskCommand) -> m.TaskStatus:
        self._bus.log.log(  # the executor logs a stop
            logging.DEBUG if command.command == "stop" else logging.INFO, "command %s%s", command.command,
            f" by {command.by}" if command.by else "")
        view = self._observe()
        require_allowed(command, view.motion if view else None, self._owner.latest)
        requests = self._task.command(command.command, view)
        for request in requests:
            if isinstance(request, m.HoldRequest | m.StopRequest) and request.by == "operator":
                request.owner = command.by
            if isinstance(request, m.HoldRequest):
                request.override = command.override and not request.hold
                request.acknowledged = command.acknowledged
        self._commanded += requests
        self._woken.set()
        now, answered = self._task.status, await self._requests.carried_out(requests)
        reported = {name: getattr(now, name) for name in m.TaskStatus.model_fields.keys() - {"plans"}}
        return m.TaskStatus.model_validate(
            {**reported, "header": self._bus.header(), "message": now.message if answered else NOT_ANSWERED})

    def _publish(self) -> None:
        """Publish the status if more than its time has changed."""
        now, before = self._task.status, self._published
        trouble = self._watchdog.trouble if self._watchdog else ""
        if trouble and now.state not in ENDED:
            now.message = f"{WAITS}{trouble}"
        elif now.message.startswith(WAITS):
            now.message = ""
        if before and before.equals_except(now, "task_seconds", "header"):
            return
        if now.state == "ERROR" and (before is None or before.state != "ERROR"):
            self._bus.log.error("%s", now.message)
        elif (now.message not in ("", before.message if before else "") and not now.message.endswith(START)) or (
                before and now.state != before.state):
            self._bus.log.info("%s", f"{now.state} {now.message}".rstrip())
        now.header = self._bus.header()
        self._status.put(now)
        self._published = now.model_copy(deep=True)

    def _report(self, problem: str) -> None:
        self._task.status.message = problem

    async def _wake_on(self, reader: Reader[Any]) -> None:
        async for _ in reader:
            self._woken.set()


def require_allowed(command: m.TaskCommand, motion: m.MotionStatus | None, owner: m.MotionOwner | None) -> None:
    """Check that the operator may give the command.

    Raises:
        Refused: another operator holds the robot or has motion authority, or a stopped robot needs a start.
    """
    if command.command == "resume" and motion is not None and motion.stopped:
        raise Refused("stopped", f"the robot is {motion.stopped}: start the task to continue")
    if command.override or command.command not in ("start", "resume"):
        return
    unnamed = m.UNKNOWN_OPERATOR
    if owner is not None and owner.asked and owner.kind != "task" and owner.owner not in (unnamed, command.by):
        raise Refused("not_owner", f"the motion is {owner.description}: only the owner can release it, or override")
    if motion is None:
        return
    others = [interlock.description for interlock in motion.interlocks
              if interlock.kind == "held" and interlock.by not in (*UNNAMED, command.by)]
    if others:
        raise Refused("held", f"the robot is {'; '.join(others)}: only they can release it, unless you override")


class Remembering(Protocol):
    """A task that continues from its memory after a restart."""

    @property
    def memory(self) -> Any:
        """What it continues with, another object after each change; None: nothing."""

    def remember(self, memory: Any) -> None:
        """Continue from the memory of the task before its restart."""


class TaskMemory:
    """State that a restarted task restores, in a file that is deleted when the cell ends; nothing without a folder."""

    def __init__(self, bus: Bus, task: Remembering) -> None:
        """Start with the memory of a new task; nothing is written yet."""
        self._bus, self._task = bus, task
        self._saved = task.memory
        self._file: AtomicFile[Any] | None = None
        self._saving: asyncio.Task[None] | None = None

    async def load(self) -> None:
        """Restore the saved memory of the task, if it has one."""
        folder = runtime_folder()
        if self._saved is None or folder is None:
            return
        await self._bus.acquire_keys()  # before, another process of this name may still write the file
        self._file = AtomicFile(folder / f"{self._bus.cell}.{self._bus.service}.json", type(self._saved))
        try:
            saved = self._file.find()
        except Unreadable as error:  # the next save replaces it
            self._bus.log.warning("the memory of the task is lost: %s", error)
            return
        if saved is not None:
            self._saved = saved
            self._task.remember(saved)

    def save(self, group: asyncio.TaskGroup) -> None:
        """Write a changed memory in the background; changes during the write are written after it."""
        now = self._task.memory
        if self._file is None or now is None or now is self._saved or (self._saving and not self._saving.done()):
            return
        self._saving = group.create_task(self._write(self._file), name="memory")

    async def _write(self, file: AtomicFile[Any]) -> None:
        """Write the newest memory, retrying until it succeeds."""
        warned = False
        while True:
            memory = self._task.memory
            assert memory is not None
            try:
                await asyncio.to_thread(file.save, memory)
            except OSError as error:
                if not warned:
                    self._bus.log.warning("%s cannot be written (%s): until it can, a restarted task does not know "
                                          "what was done since", file.path, error.strerror or error)
                warned = True
                await asyncio.sleep(SAVE_RETRY)
                continue
            self._saved = memory
            return
