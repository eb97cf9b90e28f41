"""Topics of ROS 2 as inputs of a cell: the newest message of a subscription, and a line for what is unusable."""

from __future__ import annotations

import asyncio
import importlib.util
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

from pydantic import Field

from bridges.ros2.option import EXTRA, OPEN_ONLY, PACKAGES
from common.config import Parameters
from common.errors import ConfigError, NoRouter
from common.transport.bus import Bus
from common.transport.credentials import secure_folder
from common.transport.endpoint import LARGE_BYTES, endpoint_of
from common.transport.foreign import ForeignSession, open_foreign
from common.transport.session import LoopNotifier, RawSample

SILENCE = 5.0  # [s] wall without a message until a line says so
RETRY_PERIOD = 1.0  # [s] wall between two attempts to connect
CLOCK_TOLERANCE = 1.0  # [s] between stamps and cell time until a line says so


class InputConfig(Parameters):
    """Where the nodes of ROS 2 are."""

    domain: int = Field(0, ge=0, le=232, description="ROS_DOMAIN_ID of the nodes")
    endpoint: str = Field("", max_length=200, description="router that the nodes use, such as tcp/192.168.1.5:7447 of "
                                                          "their rmw_zenohd; empty: that of the cell")


def usable_endpoint(bus: Bus, config: InputConfig, topic: str) -> str:
    """Return the router of the nodes, if a topic is named and the packages of the extra are there.

    Raises:
        ConfigError: otherwise; or the endpoint is malformed, or is that of a secured cell.
    """
    field = f"services.{bus.service}"
    if not topic.startswith("/") or "//" in topic or topic.endswith("/"):
        raise ConfigError(f"{field}.topic", topic, "must name a topic of ROS, such as /camera/image_raw")
    if any(importlib.util.find_spec(name) is None for name in PACKAGES):
        raise ConfigError(field, ..., EXTRA)
    if config.endpoint:
        return endpoint_of(connect=config.endpoint)
    if secure_folder() is not None:
        raise ConfigError(f"{field}.endpoint", config.endpoint, OPEN_ONLY)
    return bus.endpoint or endpoint_of()


class Input:
    """A subscription whose newest message can be awaited; older ones are dropped unread."""

    def __init__(self, name: str, type_name: str) -> None:
        """Await messages of a type on a topic; used by `inputs`."""
        self.name, self.type_name = name, type_name
        self._newest: RawSample | None = None
        self._arrived = asyncio.Event()
        self._notifier = LoopNotifier(asyncio.get_running_loop(), self._arrived.set)

    def arrive(self, sample: RawSample) -> None:
        """Take a message over; on any thread."""
        self._newest = sample
        self._notifier.notify()

    async def next(self) -> Any:
        """Return the newest message, once there is one that was not returned before.

        Raises:
            ValueError: it is not valid CDR of the type.
        """
        from bridges.ros2.types import decode

        await self._arrived.wait()
        self._arrived.clear()
        assert self._newest is not None
        payload = self._newest.payload
        if len(payload) < LARGE_BYTES:
            return decode(payload, self.type_name)
        return await asyncio.to_thread(decode, payload, self.type_name)


@asynccontextmanager
async def inputs(bus: Bus, endpoint: str, domain: int, *wanted: tuple[str, str]) -> AsyncIterator[list[Input]]:
    """Subscribe to topics, pairs of name and type, as a node of the service's name; wait for the router."""
    from bridges.ros2 import keys
    from bridges.ros2.graph import Graph

    session = await _connected(bus, endpoint)
    try:
        graph = Graph(session, domain, "/" + keys.ros_name(bus.cell), keys.ros_name(bus.service), bus.log)
        found = [Input(name, type_name) for name, type_name in wanted]
        for each in found:
            graph.subscribe(each.name, each.type_name, keys.SENSOR, each.arrive)
        yield found
    finally:
        await asyncio.to_thread(session.close)


async def _connected(bus: Bus, endpoint: str) -> ForeignSession:
    warned = False
    while True:
        try:
            return await open_foreign(endpoint)
        except NoRouter:
            if not warned:
                bus.log.warning("no router of ROS 2 at %s yet, waiting for it", endpoint)
            warned = True
        await asyncio.sleep(RETRY_PERIOD)


class ProblemLog:
    """Logs why messages of a topic are left out: a line for each new reason, and one when they are used again."""

    def __init__(self, bus: Bus, topic: str, domain: int) -> None:
        """Log as the service of the bus."""
        self._bus, self._where = bus, f"{topic} in domain {domain} of ROS 2"
        self._reason = self._clock = ""

    def left_out(self, reason: str) -> None:
        """Log a reason unless it is the last one."""
        if reason != self._reason:
            self._reason = reason
            self._bus.log.warning("%s: %s", self._where, reason)

    def used(self, stamp: int) -> None:
        """Log the end of a problem, and a stamp [ns] that is not cell time."""
        if self._reason:
            self._bus.log.info("%s: messages are used", self._where)
            self._reason = ""
        late = (self._bus.clock.now_ns() - stamp) * 1e-9
        clock = "" if abs(late) <= CLOCK_TOLERANCE else "behind" if late > 0 else "ahead of"
        if clock and clock != self._clock:
            self._bus.log.warning("%s: stamps are %.1f s %s cell time, and used as they are: set the clocks of both "
                                  "hosts, and run the cell at speed 1", self._where, abs(late), clock)
        self._clock = clock


def stamp_of(header: Any) -> int:
    """Return the stamp of a header of ROS [ns]."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)
