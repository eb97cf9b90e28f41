"""What every bridge needs to know about the topics of a cell."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Coroutine, Iterable
from dataclasses import replace
from typing import Any

from common.application import Application
from common.remapping import Remapping
from common.topics import Topic, platform_topics
from common.transport.bus import Bus
from common.transport.reader import Reader


def topics_of(application: Application, keys: Iterable[dict[str, str]]) -> list[Topic[Any]]:
    """Return all topics that a cell may have, under the keys that they have there.

    Args:
        application: of the cell.
        keys: remapping tables of its services.
    """
    found: dict[str, Topic[Any]] = {}
    tables = [Remapping(table) for table in keys]
    for topic in [*platform_topics().values(), *application.topics_by_key.values()]:
        if isinstance(topic, Topic):
            for key in (topic.key, *(table.key(topic.key) for table in tables)):
                found.setdefault(key, replace(topic, key=key))
    return list(found.values())


async def drain(reader: Reader[Any]) -> None:
    """Discard what a stream received before it was last unsubscribed."""
    if reader.topic.kind == "state":
        return
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(0):
            while True:
                await reader.next()


class Pumps:
    """The running work of a bridge, one task for each name. An error is logged with its traceback."""

    def __init__(self, bus: Bus, bridge: str) -> None:
        self._bus, self._bridge = bus, bridge
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self._unfit: set[str] = set()

    def __contains__(self, name: str) -> bool:
        return name in self._tasks

    def start(self, name: str, work: Coroutine[Any, Any, None]) -> None:
        """Run `work` under a name."""
        task = self._tasks[name] = asyncio.create_task(work, name=f"{self._bridge} {name}")
        task.add_done_callback(lambda ended: self._ended(name, ended))

    def stop(self, name: str) -> bool:
        """Cancel what runs under a name; return whether something did."""
        if (task := self._tasks.pop(name, None)) is None:
            return False
        task.cancel()
        return True

    def close(self) -> None:
        """Cancel everything."""
        for name in list(self._tasks):
            self.stop(name)

    def report(self, key: str, why: str) -> None:
        """Log once for each topic why messages are left out."""
        if key not in self._unfit:
            self._unfit.add(key)
            self._bus.log.warning("%s: messages are left out: %s", key, why)

    def _ended(self, name: str, task: asyncio.Task[None]) -> None:
        if self._tasks.get(name) is task:
            del self._tasks[name]
        if not task.cancelled() and (error := task.exception()) is not None:
            self._bus.log.error("%s has ended by an error", name, exc_info=error)
