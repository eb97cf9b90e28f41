"""What a tool can learn of a cell that is up: its supervisor's status, its clock, and who is alive."""

from __future__ import annotations

import asyncio
import socket
from dataclasses import dataclass
from typing import TYPE_CHECKING

from common.errors import DecodeError

if TYPE_CHECKING:
    from common.clock import Clock
    from common.messages import SupervisorStatus
    from common.transport.bus import Bus

ASK_TIMEOUT = 1.0  # [s]
PROBE_TIMEOUT = 0.5  # [s] to see whether anything listens where a router would
CONNECT_TIMEOUT = 1.0  # [s]


async def supervisor_status(bus: Bus) -> SupervisorStatus | None:
    """What the cell's supervisor says now; None without one, as in containers."""
    return await _status(bus, bus.cell)


async def _status(bus: Bus, cell: str) -> SupervisorStatus | None:
    from common import topics
    from common.messages import SupervisorStatus
    from common.transport.codec import decode

    for sample in await bus.raw_get(f"{cell}/{topics.SUPERVISOR_STATUS.key}", ASK_TIMEOUT):
        try:
            return decode(SupervisorStatus, sample.payload)
        except DecodeError as error:
            bus.log.warning("%s: %s", sample.key, error)
    return None


async def cell_clock(bus: Bus) -> Clock:
    """The clock that the cell runs by; the environment's where no supervisor tells."""
    from common.clock import Clock

    status = await supervisor_status(bus)
    return Clock(status.speed, status.epoch) if status is not None and status.epoch else bus.clock


@dataclass(frozen=True)
class Presence:
    """What there is of a cell that is up."""

    ready: frozenset[str]  # services
    status: SupervisorStatus | None  # what its supervisor says, where there is one


def look(domain: str | None, connect: str | None) -> dict[str, Presence]:
    """The cells that are up, by name; none when nothing is up there."""
    return asyncio.run(_look(domain, connect))


async def _look(domain: str | None, connect: str | None) -> dict[str, Presence]:
    from common.transport.endpoint import endpoint_of

    endpoint = endpoint_of(domain, connect)
    if not await asyncio.to_thread(somebody_listens, endpoint):  # Zenoh itself would try for longer
        return {}
    from cli.inspection import TOOL, alive
    from common.errors import NoRouter
    from common.transport.connect import connect as connect_to

    ready: dict[str, set[str]] = {}
    try:
        async with connect_to(cell="_", service=TOOL, endpoint=endpoint, timeout=CONNECT_TIMEOUT) as bus:
            for cell, service in await alive(bus):
                ready.setdefault(cell, set()).add(service)
            return {cell: Presence(frozenset(names), await _status(bus, cell)) for cell, names in ready.items()}
    except NoRouter:
        return {}


def somebody_listens(endpoint: str) -> bool:
    """Whether something takes connections at an endpoint; True where that can not be told without Zenoh."""
    protocol, _, address = endpoint.partition("/")
    if protocol in ("udp", "quic"):
        return True
    host, _, port = address.split("?")[0].split("#")[0].rpartition(":")
    try:
        with socket.create_connection((host.strip("[]"), int(port)), timeout=PROBE_TIMEOUT):
            return True
    except OSError:
        return False
