"""Everything that the page asks of the cell. Each call ends in an answer or raises a `RequestFailed`."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from typing import TYPE_CHECKING, Any

from pydantic import JsonValue

from common import topics
from common.applications.outlining.messages import OutlineSelect, OutlineSelection
from common.applications.outlining.topics import CONTOUR_PATH, OUTLINE_SELECT, OUTLINE_STATUS
from common.config import Members
from common.errors import RequestFailed
from common.messages import (
    Parameter,
    ParameterReply,
    ParameterRequest,
    StopRequest,
    TaskCommand,
    Vector3,
    WorldEdit,
)
from common.viewer.feeds import Feeds, in_cell

if TYPE_CHECKING:
    from common.transport.bus import Bus
    from common.transport.requests import Client

BY = "page"
SPEED = "services.trajectory_executor.speed_scaling"
EXECUTOR = "trajectory_executor"
_STOP_TIMEOUT = 2.0  # [s] wall
_ASK_TIMEOUT = 2.0  # [s] wall: for parameters, which every service has at hand
_PATH_TIMEOUT = 5.0  # [s] wall: from choosing an object until its path is known
_ENDED = ("IDLE", "DONE", "ERROR")


class Requests:
    """Asks what a person wants of the services of the cell."""

    def __init__(self, bus: Bus, members: Members, feeds: Feeds) -> None:
        """Declare the clients.

        Args:
            bus: of the service.
            members: who is in the cell.
            feeds: tell how far the task is.
        """
        self._feeds = feeds
        self._task = bus.client(topics.TASK_COMMAND)
        self._motion_stop = bus.client(topics.MOTION_STOP)
        self._edit = bus.client(topics.WORLD_EDIT)
        self._select = bus.client(OUTLINE_SELECT) if in_cell(OUTLINE_SELECT, members) else None
        self._parameters: dict[str, Client[ParameterRequest, ParameterReply]] = {
            name: bus.client(topics.parameters_of(name)) for name in members.services
        }

    async def command(self, command: str) -> None:
        """Tell the task to start, pause, resume or stop."""
        await self._task.call(TaskCommand.model_validate({"command": command}))

    async def stop(self) -> None:
        """Bring the arm to rest and end the task, at the same time: one that fails does not hold the other back.

        Raises:
            RequestFailed: the arm could not be told; or it could, but the task could not.
        """
        told = await asyncio.gather(
            self._motion_stop.call(StopRequest(reason="stopped on the page"), _STOP_TIMEOUT),
            self._task.call(TaskCommand(command="stop"), _STOP_TIMEOUT),
            return_exceptions=True,
        )
        for answer in told:
            if isinstance(answer, BaseException):
                raise answer

    async def choose(self, choice: OutlineSelect) -> OutlineSelection:
        """Have an object outlined: it is chosen, and the task starts once its path is known."""
        assert self._select is not None
        chosen = await self._select.call(choice)
        status = self._feeds.latest(OUTLINE_STATUS)
        if status is None or (status.started and status.state not in _ENDED):
            return chosen  # it traces what is chosen by itself
        try:
            async with asyncio.timeout(_PATH_TIMEOUT):
                while (path := self._feeds.latest(CONTOUR_PATH)) is None or path.object != chosen.label:  # noqa: ASYNC110
                    await asyncio.sleep(0.02)  # others read the messages themselves
        except TimeoutError:
            pass  # the task tells what is wrong with the object
        await self.command("start")
        return chosen

    async def move(self, object_id: str, x: float, y: float) -> None:
        """Put an object of the simulated world somewhere [m]."""
        await self._edit.call(WorldEdit(op="move", id=object_id, position=Vector3(x=x, y=y)))

    async def parameters(self) -> dict[str, list[Parameter]]:
        """The parameters of each service that answers."""
        names = [name for name, client in self._parameters.items() if client.available]
        replies = await asyncio.gather(*(self._parameters_of(name) for name in names))
        return {name: reply for name, reply in zip(names, replies, strict=True) if reply is not None}

    async def _parameters_of(self, service: str) -> list[Parameter] | None:
        try:
            return (await self._parameters[service].call(ParameterRequest(), _ASK_TIMEOUT)).parameters
        except RequestFailed:
            return None  # it is shown as gone, or asked again soon

    async def set_parameter(self, services: list[str], path: str, value: JsonValue) -> None:
        """Change a parameter in every service that has it."""
        request = ParameterRequest(set={path: value}, by=BY)
        changing: list[Coroutine[Any, Any, ParameterReply]] = [
            self._parameters[name].call(request, _ASK_TIMEOUT) for name in services
        ]
        await asyncio.gather(*changing)

    async def set_speed(self, scaling: float) -> None:
        """Have trajectories followed at a share of their speed."""
        await self.set_parameter([EXECUTOR], SPEED, scaling)
