"""A short visit to the network of a cell that is up."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

from common.errors import DecodeError, RequestFailed, UnknownName

if TYPE_CHECKING:
    from common.clock import Clock
    from common.messages import SupervisorStatus
    from common.transport.bus import Bus

T = TypeVar("T")

TOOL = "zencell"
CONNECT_TIMEOUT = 2.0  # [s] to reach the router
PRESENCE_TIMEOUT = 1.0  # [s] the same, where only one of many is looked at
LOOK_TIMEOUT = 1.0  # [s] to hear who is there


class NothingUp(RequestFailed):
    """There is no cell to look at."""

    def __init__(self, endpoint: str, what: str) -> None:
        from cli.completion import default_cell

        super().__init__(
            f"{what} at {endpoint}; is a cell up (`zencell up {default_cell()}`), and on this --domain or --connect?"
        )
        self.endpoint = endpoint


def inspect(
    visit: Callable[[Bus], Awaitable[T]], *, cell: str | None = None, any_cell: bool = False,
    domain: str | None, connect: str | None, identity: str | None = None,
) -> T:
    """What a visit to a cell's network returns.

    Args:
        visit: is called with a bus in the cell.
        cell: its name; when not given, the one cell that is up.
        any_cell: the visit is to the network, no cell needs to be up.
        domain: where, as given to `--domain`.
        connect: where, as given to `--connect`.
        identity: whose certificate is shown in a secured cell; the operator's if not given.

    Raises:
        NothingUp: there is no router, or no cell.
        UnknownName: several cells are up and none was named, or another one was.
    """
    return asyncio.run(_inspect(visit, cell, any_cell, domain, connect, identity))


async def _inspect(
    visit: Callable[[Bus], Awaitable[T]], cell: str | None, any_cell: bool, domain: str | None, connect: str | None,
    identity: str | None,
) -> T:
    from common.clock import Clock
    from common.errors import NoRouter
    from common.transport.connect import connect as connect_to
    from common.transport.credentials import OPERATOR
    from common.transport.endpoint import endpoint_of

    endpoint = endpoint_of(domain, connect)
    clock = Clock.from_environment()
    shown = identity or OPERATOR
    try:
        if cell is None and not any_cell:
            async with connect_to(cell="_", service=TOOL, endpoint=endpoint, timeout=CONNECT_TIMEOUT,
                                  identity=shown) as bus:
                cell = _only({name for name, _ in await alive(bus)}, endpoint)
        async with connect_to(
            cell=cell or "_", service=TOOL, endpoint=endpoint, clock=clock, timeout=CONNECT_TIMEOUT, identity=shown,
        ) as bus:
            return await visit(bus)
    except NoRouter:
        raise NothingUp(endpoint, "no router") from None


async def alive(bus: Bus) -> list[tuple[str, str]]:
    """Cell and name of every service on the network that is ready."""
    tokens = [token.split("/") for token in await bus.raw_tokens("*/alive/*", LOOK_TIMEOUT)]
    return [(token[0], token[2]) for token in tokens]


def _only(cells: set[str], endpoint: str) -> str:
    if not cells:
        raise NothingUp(endpoint, "there is a router and no service")
    if len(cells) > 1:
        raise UnknownName("cell (name one with --cell)", "", cells)
    return cells.pop()


ASK_TIMEOUT = 1.0  # [s]
PROBE_TIMEOUT = 0.5  # [s] to see whether anything listens where a router would


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
    import socket

    from common.clock import Clock

    status = await supervisor_status(bus)
    if status is None or not status.epoch:
        return bus.clock
    here = status.host == socket.gethostname()  # another host has a clock of its own
    return Clock(status.speed, status.epoch, status.booted if here and status.booted else None)


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
        async with connect_to(cell="_", service=TOOL, endpoint=endpoint, timeout=PRESENCE_TIMEOUT) as bus:
            for cell, service in await alive(bus):
                ready.setdefault(cell, set()).add(service)
            return {cell: Presence(frozenset(names), await _status(bus, cell)) for cell, names in ready.items()}
    except NoRouter:
        return {}


def somebody_listens(endpoint: str) -> bool:
    """Whether something takes connections at an endpoint; True where that cannot be told without Zenoh."""
    protocol, _, address = endpoint.partition("/")
    if protocol in ("udp", "quic"):
        return True
    host, _, port = address.split("?")[0].split("#")[0].rpartition(":")
    try:
        with socket.create_connection((host.strip("[]"), int(port)), timeout=PROBE_TIMEOUT):
            return True
    except OSError:
        return False
