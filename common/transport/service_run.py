"""One run of a service's coroutine: it ends by itself, or is cancelled when a handler crashes or its keys are lost."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any

from common.errors import ConfigError

_END_SECONDS = 1.0  # for a cancelled service to end


class ServiceRun:
    """Runs the coroutine of a bus and ends it after a failure elsewhere."""

    def __init__(self, service: str, log: logging.Logger, withdraw: Callable[[], Awaitable[None]]) -> None:
        """Prepare a run on the running loop.

        Args:
            service: name of the task.
            log: of the service.
            withdraw: awaited when another process has one of the service's keys, before the service is cancelled.
        """
        self._service, self._log, self._withdraw = service, log, withdraw
        self._failure: asyncio.Future[BaseException] = asyncio.get_running_loop().create_future()
        self._running = False
        self._keys_lost = False

    def fail(self, error: BaseException) -> None:
        """End the service because a request handler crashed."""
        if not self._running:  # a tool's bus has no service to end
            self._log.error("the handler of a request crashed", exc_info=error)
        elif not self._failure.done():
            self._failure.set_result(error)

    def lose_keys(self, error: ConfigError) -> None:
        """End the service because another process has one of its keys."""
        self._keys_lost = True
        self.fail(error)

    async def run(self, service: Coroutine[Any, Any, None]) -> None:
        """Run the coroutine to its end or to the first failure, which is raised."""
        self._running = True
        task = asyncio.create_task(service, name=self._service)
        both: set[asyncio.Future[Any]] = {task, self._failure}
        try:
            await asyncio.wait(both, return_when=asyncio.FIRST_COMPLETED)
            if self._keys_lost:
                await self._withdraw()
        finally:
            await self._end(task)
        if self._failure.done():
            raise self._failure.result()
        await task

    async def _end(self, task: asyncio.Task[None]) -> None:
        if task.done():
            return
        task.cancel()
        await asyncio.wait({task}, timeout=_END_SECONDS)
        if not task.done():
            self._log.error("the service ignores its cancellation")
        elif not task.cancelled() and task.exception() is not None:
            self._log.error("crashed while it ended", exc_info=task.exception())
