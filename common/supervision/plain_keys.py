"""Copies of log lines and counters on the plain keys `log` and `counters`, their names before each service had its own.

The supervisor publishes them for plain Zenoh clients, for one version more. Our readers skip these copies
(`common/transport/copies.py`). A message under the key of another service is not copied.
"""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import Any

from common import topics
from common.supervision.liveness_watchdog import RemoteServices
from common.topics import Topic
from common.transport.bus import Bus
from common.transport.codec import encode, encoding_of
from common.transport.writer import COPY, plain_key

MATCH_PERIOD = 1.0  # [s] between checks for subscribers of a plain key


async def copy_to_plain_keys(bus: Bus, remote: RemoteServices) -> None:
    """Copy log lines and counters to their plain keys while those have subscribers.

    Args:
        bus: of the supervisor.
        remote: services whose messages another supervisor copies.
    """

    async def follow_supervisors() -> None:
        async for status in bus.reader(topics.SUPERVISOR_STATUS):
            remote.update(status)

    await asyncio.gather(follow_supervisors(), *(_copy(bus, topic, remote) for topic in (topics.LOG, topics.COUNTERS)))


async def _copy(bus: Bus, topic: Topic[Any], remote: RemoteServices) -> None:
    out = bus.raw_publisher(f"{bus.cell}/{plain_key(topic)}", encoding_of(topic.message), reliable=True)
    reader = bus.reader(replace(topic, plain=False), listening=False)
    while True:
        bus.listen(reader, out.matched)
        try:
            async with asyncio.timeout(MATCH_PERIOD):
                message = await reader.next()
        except TimeoutError:
            continue
        if remote.is_copied_here(message.service):
            out.put(encode(message), COPY)
