"""What every bridge needs to know about the topics of a cell."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

from common.application import Application
from common.remapping import Remapping
from common.topics import Topic, platform_topics
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
