"""Join the running cell that the options of a verb name."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from common.client.cell import Cell

T = TypeVar("T")


def join(visit: Callable[[Cell], Awaitable[T]], cell: str | None, domain: str | None, connect: str | None) -> T:
    """Return the result of `visit` in the cell of the options --cell, --domain and --connect."""
    from common.client.cell import Cell

    async def visited() -> T:
        async with Cell(cell, domain=domain, connect=connect) as joined:
            return await visit(joined)

    return asyncio.run(visited())
