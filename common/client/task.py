"""The task of a cell, for a program: start, pause, resume, stop, and its status."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncGenerator, Awaitable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from common import topics
from common.application import find_application
from common.client.arguments import require_seconds
from common.client.joining import newest_interlock, supervisor_status
from common.client.subscriptions import Part, Subscriptions, local_key, topic_of_owner
from common.config import check
from common.errors import NoResponder, RequestFailed, UnknownName, ZencellError
from common.messages import HoldRequest, MotionStatus, StopRequest, TaskCommand, TaskStatus
from common.topics import Topic
from common.transport.requests import Client

TIMEOUT = 5.0  # [s] wall for an answer
ENDED = ("DONE", "ERROR")
A = TypeVar("A")
Answer = TaskStatus | MotionStatus  # the latter in a cell without a task

_stopping: set[asyncio.Future[Any]] = set()  # keeps stops alive whose caller was cancelled


class TaskStopFailed(ZencellError):
    """The arm was stopped, but the task did not confirm the stop."""

    exit_code = 1

    def __init__(self, error: ZencellError) -> None:
        super().__init__(f"the arm is stopped and stays so until a start; the task did not confirm the stop: {error}")


class ArmStopFailed(ZencellError):
    """The task has stopped, but the executor of the arm did not confirm the stop."""

    exit_code = 1

    def __init__(self, error: ZencellError) -> None:
        super().__init__(f"the task has stopped; the executor of the arm did not confirm the stop: {error}")


async def send_task_command(
    client: Client[TaskCommand, TaskStatus], command: str, operator: str, *, override: bool = False,
    acknowledged: int | None = None, timeout: float = TIMEOUT,
) -> TaskStatus:
    """Send start, pause, resume or stop to the task.

    Args:
        client: of task/command.
        command: to send.
        operator: name of the sender.
        override: also release holds of other operators.
        acknowledged: `since` of the newest interlock that the operator knows; a start or resume releases no newer one.
        timeout: [s, wall].
    """
    request = check(
        TaskCommand, {"command": command, "by": operator, "override": override, "acknowledged": acknowledged}, command)
    return await client.call(request, timeout)


@dataclass(frozen=True)
class StopResult:
    """The replies of arm and task to a stop, or the errors instead."""

    arm: MotionStatus | RequestFailed
    task: TaskStatus | RequestFailed


async def stop_arm_and_task(
    arm: Client[StopRequest, MotionStatus], task: Client[TaskCommand, TaskStatus], operator: str, reason: str = "",
    timeout: float = TIMEOUT,
) -> StopResult:
    """Stop arm and task concurrently, so that a task that hangs cannot delay the stop of the arm.

    Both requests are completed even if the caller is cancelled.

    Args:
        arm: client of motion/stop.
        task: client of task/command.
        operator: name of the sender.
        reason: for the log and the motion status.
        timeout: [s, wall].
    """
    both = asyncio.gather(
        _answer(arm.call(StopRequest(reason=reason, owner=operator), timeout)),
        _answer(send_task_command(task, "stop", operator, timeout=timeout)))
    _stopping.add(both)
    both.add_done_callback(_stopping.discard)
    return StopResult(*await asyncio.shield(both))


async def _answer(request: Awaitable[A]) -> A | RequestFailed:
    try:
        return await request
    except RequestFailed as error:
        return error


class TaskControl(Part):
    """Commands of an operator to the task. `async for status in cell.task` yields its status after each change."""

    def __init__(self, subscriptions: Subscriptions, owner: str, application: str = "") -> None:
        """The task of a cell.

        Args:
            subscriptions: of the cell.
            owner: name of this client in its commands.
            application: dotted module of a custom application, needed for its status.
        """
        self._subscriptions, self._bus = subscriptions, subscriptions.bus
        self._owner, self._application = owner, application
        self._unsaved = ""

    async def start(self, *, override: bool = False) -> Answer:
        """Start the task, or restart it; releases your own holds, and with `override` those of others too.

        In a cell without a task, this and the other commands only release, hold or stop the arm.

        Raises:
            RemoteError: another operator holds the robot or has motion authority. A start ends stops of others.
        """
        return await self._send("start", override)

    async def pause(self) -> Answer:
        """Stop the robot on its path at once and hold it there."""
        return await self._send("pause")

    async def resume(self, *, override: bool = False) -> Answer:
        """Let the robot continue along its path after your pause."""
        return await self._send("resume", override)

    async def stop(self) -> Answer:
        """Stop the robot, abandon its motion, and wait for a start; works also if the task does not answer.

        Raises:
            TaskStopFailed: the arm is stopped, but the task did not confirm the stop.
            ArmStopFailed: the task has stopped, but the executor refused the stop or did not answer.
            RequestFailed: neither confirmed the stop.
        """
        result = await stop_arm_and_task(
            self._bus.client(topics.MOTION_STOP), self._bus.client(topics.TASK_COMMAND), self._owner)
        if isinstance(result.arm, RequestFailed):
            raise result.task if isinstance(result.task, RequestFailed) else ArmStopFailed(result.arm)
        self._unsaved = result.arm.unsaved
        if isinstance(result.task, RequestFailed):
            if isinstance(result.task, NoResponder) and not await self._exists():
                return result.arm
            raise TaskStopFailed(result.task)
        return result.task

    @property
    def unsaved(self) -> str:
        """Warning about the last stop if it could not be saved and would be lost at a restart; else empty."""
        return self._unsaved

    async def _send(self, command: str, override: bool = False) -> Answer:
        acknowledged = await newest_interlock(self._bus) if command in ("start", "resume") else None
        try:
            return await send_task_command(self._bus.client(topics.TASK_COMMAND), command, self._owner,
                                           override=override, acknowledged=acknowledged)
        except NoResponder:
            if await self._exists():
                raise
        request = HoldRequest(hold=command == "pause", stops=command == "start", owner=self._owner, override=override,
                              acknowledged=acknowledged, reason=f"{command} in a cell without a task")
        return await self._bus.client(topics.MOTION_HOLD).call(request, TIMEOUT)

    async def _exists(self) -> bool:
        """Return whether the cell has a task, which may be down; without one, commands go to the executor."""
        supervisor = await supervisor_status(self._bus)
        return supervisor is None or supervisor.has_task

    async def topic(self) -> Topic[TaskStatus]:
        """Return the topic of the task's status.

        Raises:
            UnknownName: no task is running, or only unknown ones or several.
        """
        if self._application:
            return find_application(self._application).status
        found: dict[str, Topic[TaskStatus]] = {}
        for owner in await self._bus.owners():
            topic = topic_of_owner(owner)
            if isinstance(topic, Topic) and issubclass(topic.message, TaskStatus):
                if local_key(self._bus, owner) is not None:
                    return replace(topic, key=owner.own)
                found[owner.key] = topic
        if len(found) == 1:
            return found.popitem()[1]
        raise UnknownName("task (application=MODULE names a custom one, remapped= one of several)",
                          self._bus.cell, found)

    async def status(self) -> TaskStatus:
        """Return its newest status."""
        return await self._subscriptions.latest(await self.topic())

    async def __aiter__(self) -> AsyncGenerator[TaskStatus, None]:
        reader = self._bus.reader(await self.topic())
        try:
            async for status in reader:
                yield status
        finally:
            self._bus.listen(reader, False)

    async def ended(self, timeout: float | None = None) -> TaskStatus:
        """Wait until the task is DONE or in ERROR, and return its last status.

        Raises:
            TimeoutError: it is not after `timeout` [s, wall]; without one this waits forever.
        """
        if timeout is not None:
            require_seconds("timeout", timeout)
        async with asyncio.timeout(timeout), contextlib.aclosing(aiter(self)) as statuses:
            async for status in statuses:
                if status.state in ENDED:
                    return status
        raise AssertionError  # the iterator ends only with the connection
