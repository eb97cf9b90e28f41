"""A bus for tools: no readiness token, nothing served, closed at the end of the block."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import asynccontextmanager
from pathlib import Path

from common.clock import Clock
from common.errors import NoRouter
from common.transport.bus import Bus
from common.transport.credentials import OPERATOR, common_name, credentials_of, secure_folder
from common.transport.zenoh_session import close_bounded, open_zenoh

_CLOSE_SECONDS = 0.5


@asynccontextmanager
async def connect(
    *, cell: str, service: str, endpoint: str, clock: Clock | None = None, timeout: float | None = 3.0,
    identity: str = OPERATOR, near: Sequence[str] | None = None, remapped: Mapping[str, str] | None = None,
    secure: str | None = None,
) -> AsyncIterator[Bus]:
    """A bus at the router of an endpoint.

    Args:
        cell: name of the cell.
        service: name of the tool, for its log lines.
        endpoint: of the router, from `endpoint_of`.
        clock: the cell's clock; one at speed 1 when not given.
        timeout: how long to wait for the router [s]; None waits for ever.
        identity: whose certificate it shows in a secured cell.
        near: endpoints of the same router to be tried first; those that a supervisor handed down when not given.
        remapped: keys of the cell by the tool's own words for them, as common/remapping.py has it.
        secure: folder of certificates; that of the environment when not given.

    Raises:
        NoRouter: no router was there in time.
    """
    folder = Path(secure) if secure else secure_folder()
    credentials = credentials_of(common_name(cell, identity), folder) if folder else None
    try:
        async with asyncio.timeout(timeout):
            session = await open_zenoh(endpoint, credentials, near)
    except TimeoutError:
        raise NoRouter(endpoint) from None
    bus = Bus(session, service=service, cell=cell, clock=clock or Clock(), topics=remapped)
    try:
        yield bus
    finally:
        await bus.close()
        await close_bounded(session, _CLOSE_SECONDS)
