"""Print motion states, target counts and liveliness changes that a host receives, with their times."""

import asyncio
import json
import sys
import time
from typing import Any

from applications.pick_place.topics import VALIDATED_TARGETS
from common import topics
from common.transport.bus import Bus
from common.transport.endpoint import endpoint_of
from common.transport.zenoh_session import connect


def write(what: str, **values: Any) -> None:
    """Write an event; the clock is the same in all network namespaces."""
    sys.stdout.write(json.dumps({"what": what, "at": time.monotonic(), **values}) + "\n")
    sys.stdout.flush()


async def motions(bus: Bus) -> None:
    """Write each motion status."""
    async for status in bus.reader(topics.MOTION_STATUS):
        write("motion", id=status.id, state=status.state, progress=status.progress, held=status.held_by,
            error=status.error)


async def targets(bus: Bus) -> None:
    """Write each message of targets."""
    async for seen in bus.reader(VALIDATED_TARGETS):
        write("targets", count=len(seen.poses))


async def main(domain: str) -> None:
    """Observe until interrupted."""
    async with connect(cell="panda", service="observer", endpoint=endpoint_of(domain), timeout=60) as bus:
        bus.alive.on_change(lambda name, there: write("there" if there else "gone", service=name))
        await asyncio.gather(motions(bus), targets(bus))


if __name__ == "__main__":
    try:
        asyncio.run(main(sys.argv[1]))
    except KeyboardInterrupt:
        sys.exit(0)
