"""Plain `log` and `counters`, as they were called before each service had keys of its own: for one version more.

The supervisor repeats there what services say under their own keys, for plain Zenoh clients; readers of ours leave
these copies out (`common/transport/copies.py`). It says nothing for another: what came under a wrong key is refused.
"""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import Any

from common import topics
from common.supervision.liveness_watchdog import Elsewhere
from common.topics import Topic
from common.transport.bus import Bus
from common.transport.codec import encode, encoding_of
from common.transport.writer import COPY, plain_key

LOOK_PERIOD = 1.0  # [s] between looks whether somebody reads there


async def keep_plain_keys(bus: Bus, elsewhere: Elsewhere) -> None:
    """Copy log lines and counters to their plain keys while somebody reads there; what is `elsewhere` another copies.

    Args:
        bus: of the supervisor.
        elsewhere: knows the services of others.
    """

    async def hear() -> None:
        async for status in bus.reader(topics.SUPERVISOR_STATUS):
            elsewhere.hear(status)

    await asyncio.gather(hear(), *(_copy(bus, topic, elsewhere) for topic in (topics.LOG, topics.COUNTERS)))


async def _copy(bus: Bus, topic: Topic[Any], elsewhere: Elsewhere) -> None:
    out = bus.raw_publisher(f"{bus.cell}/{plain_key(topic)}", encoding_of(topic.message), reliable=True)
    reader = bus.reader(replace(topic, plain=False), listening=False)
    while True:
        bus.listen(reader, out.matched)
        try:
            async with asyncio.timeout(LOOK_PERIOD):
                message = await reader.next()
        except TimeoutError:
            continue
        if elsewhere.is_told_here(message.service):
            out.put(encode(message), COPY)
