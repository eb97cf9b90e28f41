"""A short visit to the network of a cell that is up."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, TypeVar

from common.errors import RequestFailed, UnknownName

if TYPE_CHECKING:
    from common.transport.bus import Bus

T = TypeVar("T")

TOOL = "zencell"
CONNECT_TIMEOUT = 2.0  # [s] to reach the router
LOOK_TIMEOUT = 1.0  # [s] to hear who is there


class NothingUp(RequestFailed):
    """There is no cell to look at."""

    def __init__(self, endpoint: str, what: str) -> None:
        super().__init__(
            f"{what} at {endpoint}; is a cell up (`zencell up panda`), and on this --domain or --connect?"
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
