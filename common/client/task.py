"""The task of a cell, for a program: start, pause, resume, stop, and how far it is."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncGenerator, Awaitable
from dataclasses import replace
from typing import TypeVar

from common import topics
from common.application import find_application
from common.client.joining import newest_interlock
from common.client.part import Part
from common.client.subscriptions import Subscriptions, local_key, topic_of_owner
from common.errors import RequestFailed, UnknownName, ZencellError
from common.messages import MotionStatus, StopRequest, TaskCommand, TaskStatus
from common.topics import Topic

TIMEOUT = 5.0  # [s] wall for an answer
ENDED = ("DONE", "ERROR")
A = TypeVar("A")


async def _answer(asked: Awaitable[A]) -> A | RequestFailed:
    try:
        return await asked
    except RequestFailed as error:
        return error


class TaskStopFailed(ZencellError):
    """The arm was stopped, though the task could not be told."""

    exit_code = 1

    def __init__(self, error: ZencellError) -> None:
        super().__init__(f"the arm is stopped and stays so until a start; the task did not hear of it: {error}")


class ArmStopFailed(ZencellError):
    """The task has stopped; who moves the arm has refused to be told, or not answered."""

    exit_code = 1

    def __init__(self, error: ZencellError) -> None:
        super().__init__(f"the task has stopped; who moves the arm did not take that: {error}")


class TaskControl(Part):
    """What a person may tell the task. `async for status in cell.task` hears of every change, until it is left."""

    def __init__(self, ear: Subscriptions, owner: str, application: str = "") -> None:
        """The task of a cell; of an application of one's own, its dotted module is needed to hear of it."""
        self._ear, self._bus, self._owner, self._application = ear, ear.bus, owner, application
        self._unkept = ""
        self._stopping: asyncio.Future[tuple[MotionStatus | RequestFailed, TaskStatus | RequestFailed]]

    async def start(self, *, override: bool = False) -> TaskStatus:
        """Start it, or start it again; a robot that you hold is let go, with `override` also one that others hold.

        Raises:
            RemoteError: somebody else holds the robot or has its motion. Stops of others are ended by a start.
        """
        return await self._tell("start", override)

    async def pause(self) -> TaskStatus:
        """Bring the robot to rest on its path at once and hold it there."""
        return await self._tell("pause")

    async def resume(self, *, override: bool = False) -> TaskStatus:
        """Let the robot go on along its path after a pause of yours."""
        return await self._tell("resume", override)

    async def stop(self) -> TaskStatus:
        """Stop the robot, give up its motion, and wait for a start, also if the task does not answer.

        Raises:
            TaskStopFailed: the arm is stopped, but the task did not hear of it.
            ArmStopFailed: the task has stopped; who moves the arm has refused to be told, or not answered.
            RequestFailed: neither heard of it.
        """
        stop = StopRequest(owner=self._owner)
        self._stopping = asyncio.gather(
            _answer(self._bus.client(topics.MOTION_STOP).call(stop, TIMEOUT)), _answer(self._tell("stop")))
        arm, told = await asyncio.shield(self._stopping)  # who is cancelled now has asked all the same
        if isinstance(arm, RequestFailed):
            raise told if isinstance(told, RequestFailed) else ArmStopFailed(arm)
        self._note(arm)
        if isinstance(told, RequestFailed):
            raise TaskStopFailed(told)
        return told

    @property
    def unsaved(self) -> str:
        """What the last stop would not outlive, in words."""
        return self._unkept

    def _note(self, answer: MotionStatus) -> None:
        self._unkept = answer.unsaved

    async def _tell(self, command: str, override: bool = False) -> TaskStatus:
        acknowledged = await newest_interlock(self._bus) if command in ("start", "resume") else None
        asked = TaskCommand.model_validate({
            "command": command, "by": self._owner, "override": override, "acknowledged": acknowledged})
        return await self._bus.client(topics.TASK_COMMAND).call(asked, TIMEOUT)

    async def topic(self) -> Topic[TaskStatus]:
        """Where the task says how far it is.

        Raises:
            UnknownName: no task is there, or none that is known here.
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
        raise UnknownName("task (application=MODULE names one of your own, remapped= one of several)",
                          self._bus.cell, found)

    async def status(self) -> TaskStatus:
        """How far it is: its newest status."""
        return await self._ear.newest(await self.topic())

    async def __aiter__(self) -> AsyncGenerator[TaskStatus, None]:
        reader = self._bus.reader(await self.topic())
        try:
            async for status in reader:
                yield status
        finally:
            self._bus.listen(reader, False)

    async def ended(self, timeout: float | None = None) -> TaskStatus:
        """Its last status, once it is DONE or in ERROR.

        Raises:
            TimeoutError: it is not, after so long [s, wall]; without one that is waited for without end.
        """
        async with asyncio.timeout(timeout), contextlib.aclosing(aiter(self)) as statuses:
            async for status in statuses:
                if status.state in ENDED:
                    return status
        raise AssertionError  # it is heard of until the connection ends
