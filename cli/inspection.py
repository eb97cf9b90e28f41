"""A short visit to the network of a cell that is up."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from common.client.cell import Cell as Client
    from common.messages import SupervisorStatus
    from common.transport.bus import Bus

T = TypeVar("T")



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


def in_cell(
    visit: Callable[[Client], Awaitable[T]], cell: str | None, domain: str | None, connect: str | None
) -> T:
    """What is done in a cell that is up, as a program with the client does it; see `inspect`."""
    from common.client.cell import Cell

    async def joined() -> T:
        async with Cell(cell, domain=domain, connect=connect) as client:
            return await visit(client)

    return asyncio.run(joined())


async def _inspect(
    visit: Callable[[Bus], Awaitable[T]], cell: str | None, any_cell: bool, domain: str | None, connect: str | None,
    identity: str | None,
) -> T:
    from common.client.joining import joined
    from common.transport.credentials import OPERATOR

    async with joined(cell, domain=domain, connect=connect, any_cell=any_cell, identity=identity or OPERATOR) as bus:
        return await visit(bus)


@dataclass(frozen=True)
class Presence:
    """What there is of a cell that is up."""

    ready: frozenset[str]  # services
    status: SupervisorStatus | None  # what its supervisor says, where there is one


def look(domain: str | None, connect: str | None) -> dict[str, Presence]:
    """The cells that are up, by name; none when nothing is up there."""
    return asyncio.run(_look(domain, connect))


async def _look(domain: str | None, connect: str | None) -> dict[str, Presence]:
    from common.client.joining import NothingUp, alive, joined, somebody_listens, supervisor_status
    from common.transport.endpoint import endpoint_of

    if not await asyncio.to_thread(somebody_listens, endpoint_of(domain, connect)):  # nobody is waited for
        return {}
    ready: dict[str, set[str]] = {}
    try:
        async with joined(any_cell=True, domain=domain, connect=connect) as bus:
            for cell, service in await alive(bus):
                ready.setdefault(cell, set()).add(service)
            return {cell: Presence(frozenset(names), await supervisor_status(bus, cell))
                    for cell, names in ready.items()}
    except NothingUp:
        return {}
