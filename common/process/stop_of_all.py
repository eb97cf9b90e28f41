"""STOP of a cell with several arms: an operator who stops one of them stops all."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Sequence

from common import topics
from common.control.request_handlers import RequestHandlers
from common.errors import RequestFailed
from common.messages import MotionStatus, StopRequest
from common.transport.bus import Bus

RELAYED = "stop-of-another-arm"  # id of a relayed request, which is not relayed again
TIMEOUT = 1.0  # [s] wall time for the answer of another process


class StopOfAllArms:
    """Stops the arms of this process, and asks other processes to stop theirs.

    Attributes:
        hosted: handlers of the arms of this process, by name.
    """

    def __init__(self, bus: Bus, others: Sequence[str]) -> None:
        """Declare the requests to the processes of the `others`."""
        self.hosted: dict[str, RequestHandlers] = {}
        self._log = bus.log
        self._others = {arm: bus.of_arm(arm).client(topics.MOTION_STOP) for arm in others}
        self._relaying: set[asyncio.Task[None]] = set()

    async def stop(self, arm: str, request: StopRequest) -> MotionStatus:
        """Stop an arm, and all others if an operator requests it; return the status of this arm.

        All arms of this process brake before anything is awaited.
        """
        handlers = self.hosted[arm]
        if request.by != "operator" or request.id == RELAYED:
            return await handlers.stop(request)
        relayed = request.model_copy(update={"id": RELAYED})
        for name, client in self._others.items():
            task = asyncio.create_task(self._relay(name, client.call(relayed, TIMEOUT)), name=f"stop {name}")
            self._relaying.add(task)
            task.add_done_callback(self._relaying.discard)
        own, *_ = await asyncio.gather(
            handlers.stop(request), *(each.stop(relayed) for each in self.hosted.values() if each is not handlers))
        return own

    async def _relay(self, arm: str, answer: Awaitable[MotionStatus]) -> None:
        try:
            await answer
        except RequestFailed as problem:
            self._log.error("%s was not stopped: %s", arm, problem)

    def stop_for_unread(self) -> str:
        """Stop all arms of this process, as one of too many unread requests to stop may be an operator's."""
        return next(iter([handlers.stop_for_unread() for handlers in self.hosted.values()]))
